"""Sizes by the headers of image files."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import open_source
from dvo.data.images.image_header import holds_several, image_size
from dvo.data.images.images import is_complete, read_image


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp", ".pgm", ".ppm", ".pam"])
@pytest.mark.parametrize("channels", [1, 3])
def test_size_of_what_opencv_writes(tmp_path: Path, suffix: str, channels: int) -> None:
    if (suffix, channels) in ((".pgm", 3), (".ppm", 1)):
        pytest.skip("not a combination of this format")
    file = tmp_path / f"image{suffix}"
    assert cv2.imwrite(str(file), np.zeros((37, 53, channels), np.uint8))
    assert image_size(file) == (53, 37)
    assert image_size(file.read_bytes()) == (53, 37)


def test_size_behind_other_segments_of_a_jpeg() -> None:
    code = cv2.imencode(".jpg", np.zeros((37, 53, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    thumbnail = b"\xff\xe1" + struct.pack(">H", 60_002) + b"\xff\xc0" * 30_000  # holds marks of a frame header
    assert image_size(code[:2] + thumbnail + b"\xff\xff" + code[2:]) == (53, 37)


@pytest.mark.parametrize("order", ["<", ">"])
def test_size_of_a_tiff_of_either_byte_order(order: str) -> None:
    mark = b"II*\0" if order == "<" else b"MM\0*"
    entries = struct.pack(f"{order}HHIHH", 256, 3, 1, 53, 0) + struct.pack(f"{order}HHII", 257, 4, 1, 37)
    assert image_size(mark + struct.pack(f"{order}IH", 8, 2) + entries) == (53, 37)


def test_size_of_a_huge_image_without_its_pixels(tmp_path: Path) -> None:
    head = b"IHDR" + struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    file = tmp_path / "huge.png"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head)))
    assert image_size(file) == (30_000, 30_000)
    assert image_size(b"P6\n# made by hand\n30000 30000\n255\n") == (30_000, 30_000)
    assert image_size(b"BM" + bytes(12) + struct.pack("<Iii", 40, 30_000, -30_000)) == (30_000, 30_000)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp", ".ppm"])
def test_cut_headers_have_no_size(suffix: str) -> None:
    code = cv2.imencode(suffix, np.zeros((37, 53, 3), np.uint8))[1].tobytes()
    for length in range(10):
        assert image_size(code[:length]) is None


@pytest.mark.parametrize("content", [b"", b"GIF89a", b"text", b"P6\nx y\n", b"P7\nWIDTH", b"\xff\xd8" + b"\xff" * 99])
def test_no_image(tmp_path: Path, content: bytes) -> None:
    assert image_size(content) is None
    assert image_size(tmp_path) is None
    assert image_size(tmp_path / "missing.png") is None


def test_damaged_headers_never_raise() -> None:
    generator = np.random.default_rng(0)
    for suffix in (".png", ".jpg", ".bmp", ".tif", ".webp", ".ppm"):
        code = cv2.imencode(suffix, np.zeros((37, 53, 3), np.uint8))[1].tobytes()
        for _ in range(200):
            damaged = bytearray(code)
            for place in generator.integers(0, min(len(code), 400), 8):
                damaged[place] = generator.integers(0, 256)
            found = image_size(bytes(damaged))
            assert found is None or (len(found) == 2 and min(found) >= 0)


def test_a_png_whose_chunk_is_longer_than_the_file_is_not_complete() -> None:
    """The decoder would allocate what a chunk states, up to 4 GB."""
    code = bytearray(cv2.imencode(".png", np.zeros((37, 53, 3), np.uint8))[1].tobytes())
    at = code.index(b"IDAT") - 4
    assert is_complete(bytes(code)) and is_complete(bytes(code) + b"text behind the end")
    for length in (len(code), 2**31 + 5, 2**32 - 1):
        code[at : at + 4] = struct.pack(">I", length)
        assert not is_complete(bytes(code))


def test_files_of_several_images(tmp_path: Path) -> None:
    images = [np.full((37, 53, 3), 40 * k, np.uint8) for k in range(3)]
    for name in ("pages.tif", "animated.png", "animated.webp"):
        assert not holds_several(tmp_path / name)
        assert cv2.imwrite(str(tmp_path / name), images[0])
        assert not holds_several(tmp_path / name)
    assert cv2.imwritemulti(str(tmp_path / "pages.tif"), images)
    for name in ("animated.png", "animated.webp"):
        animation = cv2.Animation()
        animation.frames, animation.durations = images, [100] * 3
        assert cv2.imwriteanimation(str(tmp_path / name), animation)
    for name in ("pages.tif", "animated.png", "animated.webp"):
        assert holds_several(tmp_path / name)
        with pytest.raises(DvoError, match="an animated image, or one of several pages, is no video"):
            open_source(tmp_path / name)


@pytest.mark.parametrize(("kind", "several"), [(0, True), (1, False), (4, False)])
@pytest.mark.parametrize("big", [False, True])
def test_reduced_copies_and_masks_in_a_tiff_are_no_pages(tmp_path: Path, kind: int, several: bool, big: bool) -> None:
    file, offset, counts = tmp_path / "a.tif", "<Q" if big else "<I", "<Q" if big else "<H"
    size, start = (20, 16) if big else (12, 8)
    directory = struct.calcsize(counts) + size + struct.calcsize(offset)

    def page(kind: int, following: int) -> bytes:
        row = struct.pack("<HHQQ", 254, 4, 1, kind) if big else struct.pack("<HHII", 254, 4, 1, kind)
        return struct.pack(counts, 1) + row + struct.pack(offset, following)

    head = struct.pack("<4sHHQ", b"II+\0", 8, 0, start) if big else struct.pack("<4sI", b"II*\0", start)
    file.write_bytes(head + page(0, start + directory) + page(kind, 0))
    assert holds_several(file) is several
    file.write_bytes(head + page(0, start))  # a directory that follows itself
    assert holds_several(file)
    file.write_bytes((head + page(0, start + directory))[:-1])
    assert not holds_several(file)


@pytest.mark.parametrize("white", [31, 100, 255, 1023, 4095, 65535])
@pytest.mark.parametrize("kind", ["P2", "P3", "P5", "P6"])
def test_the_value_of_white_of_a_pgm(tmp_path: Path, white: int, kind: str) -> None:
    """OpenCV leaves most of them as they are stored; text need not end with a line."""
    channels = 3 if kind in ("P3", "P6") else 1
    levels = np.linspace(0, white / 2, 37 * 53 * channels).round().astype(int).reshape(37, 53, channels)
    pixels = " ".join(map(str, levels.ravel())).encode()
    if kind in ("P5", "P6"):
        pixels = levels.astype(">u2" if white > 255 else np.uint8).tobytes()
    file = tmp_path / ("a.ppm" if channels == 3 else "a.pgm")
    file.write_bytes(f"{kind}\n# a comment 7\n53 37\n{white}\n".encode() + pixels)
    image = read_image(file)
    assert image is not None and np.abs(image - levels * (255 / white)).max() <= 1
