"""Folders of photographs: pictures that are cut, huge or none are refused by name."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.synth.textures.photographs import folder_photographs


def coded(suffix: str, height: int = 40, width: int = 60) -> bytes:
    image = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    return bytes(cv2.imencode(suffix, image)[1])


def huge_png() -> bytes:
    head = b"IHDR" + struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head)) + b"IEND"


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp", ".ppm"])
def test_whole_pictures_of_every_format(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"a{suffix}").write_bytes(coded(suffix))
    ((image, tag),) = folder_photographs(tmp_path, 0)
    assert image.shape == (40, 60, 3) and tag == "photo"


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.95])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_cut_pictures(tmp_path: Path, suffix: str, share: float) -> None:
    data, file = coded(suffix), tmp_path / f"a{suffix}"
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DvoError, match="cannot be read as a picture, or cut short") as error:
        folder_photographs(tmp_path, 0)
    assert str(error.value).startswith(f"{file}: textures: ")


@pytest.mark.parametrize("content", [b"text", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xd9"])
def test_files_that_are_no_pictures(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(DvoError, match="cannot be read as a picture"):
        folder_photographs(tmp_path, 0)


def test_a_huge_picture_is_not_decoded(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(huge_png())
    with pytest.raises(DvoError, match="huge: 30000x30000 pixels, 64 million at most"):
        folder_photographs(tmp_path, 0)


def test_a_file_of_4_gb_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(coded(".jpg"))
    with (tmp_path / "a.jpg").open("r+b") as file:
        file.truncate(4 * 1024**3)  # without taking the place on the disk
    with pytest.raises(DvoError, match="cannot be read as a picture"):
        folder_photographs(tmp_path, 0)
