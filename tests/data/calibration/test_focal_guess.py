"""Guess of the focal length: metadata of images and videos, and the usual angle of view."""

import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data import open_source
from dvo.data.calibration import quicktime
from dvo.data.calibration.focal_guess import FocalGuess, guess_focal, guess_from_angle, guess_from_metadata
from dvo.data.images import exif

KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"


def with_exif(jpeg: bytes, focal: int, order: str = "<", kind: int = 3) -> bytes:
    """The image with an EXIF segment behind one of another program."""
    value = struct.pack(f"{order}H2x" if kind == 3 else f"{order}I", focal)
    directory = struct.pack(f"{order}HHHI", 1, 0xA405, kind, 1) + value + struct.pack(f"{order}I", 0)
    tiff = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8)
    tiff += struct.pack(f"{order}HHHII", 1, 0x8769, 4, 1, 26) + struct.pack(f"{order}I", 0) + directory
    segments = b"".join(
        struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body
        for marker, body in ((0xE0, b"JFIF\0"), (0xE1, b"Exif\0\0" + tiff))
    )
    return jpeg[:2] + segments + jpeg[2:]


@pytest.fixture(scope="module")
def jpeg() -> bytes:
    return cv2.imencode(".jpg", np.full((48, 64, 3), 128, np.uint8))[1].tobytes()


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


def movie(value: bytes, kind: int, *, of_track: bool = True, version: bytes = b"", wide: bool = False) -> bytes:
    """QuickTime boxes with two keys, the second one that of the focal length; media before them."""
    keys = struct.pack(">II", 0, 2) + box(b"mdta", b"com.apple.quicktime.make") + box(b"mdta", KEY)
    items = [(1, 1, b"Apple"), (2, kind, value)]
    ilst = b"".join(box(struct.pack(">I", n), box(b"data", struct.pack(">II", k, 0) + v)) for n, k, v in items)
    meta = box(b"meta", version + box(b"hdlr", bytes(25)) + box(b"keys", keys) + box(b"ilst", ilst))
    moov = box(b"moov", box(b"mvhd", bytes(100)) + (box(b"trak", box(b"tkhd", bytes(84)) + meta) if of_track else meta))
    media = struct.pack(">I4sQ", 1, b"mdat", 16 + 99) + bytes(99) if wide else box(b"mdat", bytes(99))
    return box(b"ftyp", b"qt  " + bytes(8)) + media + moov


@pytest.mark.parametrize(("order", "kind"), [("<", 3), (">", 3), (">", 4)])
def test_exif_of_a_jpeg(tmp_path, jpeg, order, kind):
    file = tmp_path / "a.jpg"
    file.write_bytes(with_exif(jpeg, 26, order, kind))
    assert exif.equivalent_focal(file) == 26
    assert cv2.imread(str(file)).shape == (48, 64, 3)
    found = guess_focal(file, 4000, 3000)
    assert found.source == "exif" and found.focal == pytest.approx(26 / 43.2666 * 5000, rel=1e-4)


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xd8", b"\xff\xd8\xff\xe1\x00\x20Exif\0\0II*\0\xff\xff\xff\xff", b"\x89PNG"]
)
def test_files_without_exif(tmp_path, jpeg, content):
    file = tmp_path / "a.jpg"
    for data in (content, jpeg, with_exif(jpeg, 0), with_exif(jpeg, 26)[:48]):
        file.write_bytes(data)
        assert exif.equivalent_focal(file) is None
        assert guess_focal(file, 640, 480).source == "prior"


@pytest.mark.parametrize(
    ("value", "kind", "found"),
    [
        (struct.pack(">I", 27), 22, 27), (struct.pack(">H", 27), 21, 27), (struct.pack(">f", 26.5), 23, 26.5),
        (struct.pack(">d", 26.5), 24, 26.5), (b"27", 1, 27), (b"wide", 1, None), (b"123", 21, None), (b"27", 13, None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("place", [{}, {"of_track": False, "version": bytes(4)}, {"wide": True}])
def test_metadata_of_a_video(tmp_path, value, kind, found, place):
    file = tmp_path / "a.mov"
    file.write_bytes(movie(value, kind, **place))
    assert quicktime.equivalent_focal(file) == found


@given(st.binary(max_size=80), st.integers(0, 400))
def test_damaged_metadata_give_a_number_or_nothing(tmp_path_factory, noise, at):
    file = tmp_path_factory.mktemp("noise") / "a.mov"
    whole = movie(b"27", 1)
    file.write_bytes(whole[:at] + noise + whole[at + len(noise) :])
    assert isinstance(quicktime.equivalent_focal(file), float | None)
    file.write_bytes(b"\xff\xd8\xff\xe1\x00\x50Exif\0\0" + noise)
    assert isinstance(exif.equivalent_focal(file), float | None)


@pytest.mark.parametrize(("width", "height"), [(1920, 1080), (1080, 1920)])
def test_a_portrait_image_has_the_focal_length_of_a_landscape_one(width, height):
    assert guess_from_angle(width, height).focal == pytest.approx(1536, rel=1e-3)
    found = guess_from_metadata(26.0, "exif", width, height)
    assert found is not None and found.focal == pytest.approx(1323.8, rel=1e-3)
    camera = found.calibration.camera(width, height)
    assert (camera.cx, camera.cy) == ((width - 1) / 2, (height - 1) / 2) and camera.fx == camera.fy


@pytest.mark.parametrize("millimetres", [None, 0.0, 1.0, 1e4, float("nan")])
def test_numbers_that_no_lens_has_are_not_believed(millimetres):
    assert guess_from_metadata(millimetres, "exif", 640, 480) is None


def test_a_guess_is_a_positive_number():
    with pytest.raises(DvoError, match="focal"):
        FocalGuess(0.0, 1.0, "given", 640, 480)


def test_a_source_is_opened_with_a_guess_and_gets_a_calibration(make):
    folder = make.images("clip", ["0.png", "1.png"])
    with pytest.raises(DvoError, match="no calibration"):
        open_source(folder)
    source = open_source(folder, guess=True, fps=10)
    assert source.guess.source == "prior" and source.camera.fx == source.guess.focal
    again = source.recalibrated(guess_from_metadata(20.0, "given", 64, 48).calibration)
    assert again.guess is None and [f.camera.fx for f in again] == pytest.approx([20 / 43.2666 * 80] * 2, rel=1e-4)
    assert source.recalibrated(source.guess.calibration, source.guess).guess == source.guess
    assert open_source(folder, guess=True, calib=make.calib(), fps=10).guess is None
