"""EXIF orientation of folders of image files."""

import json
import struct
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest

from dvo.cli import main
from dvo.core.errors import DvoError
from dvo.data import Calibration, open_source
from dvo.data.companions.right_source import with_right
from dvo.data.images import exif
from dvo.data.recording import ImageRecording, Log
from dvo.data.sensors.sensors import Sensors

WIDTH, HEIGHT = 64, 48
TURNED = {1: 0, 2: 0, 3: 180, 4: 180, 5: 270, 6: 90, 7: 90, 8: 270}
SENSOR = Calibration(50, 51, 33, 20)
UPRIGHT = Calibration(51, 50, 27, 33)


def with_orientation(jpeg, orientation, order="<"):
    """The image with an EXIF segment that states an orientation."""
    entry = struct.pack(f"{order}HHIH2x", 0x0112, 3, 1, orientation)
    tiff = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}IH", 8, 1) + entry + bytes(4)
    body = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


def folder(make, orientations, name="images", order="<"):
    path = make.root / name
    path.mkdir()
    for index, orientation in enumerate(orientations):
        jpeg = cv2.imencode(".jpg", make.image(index))[1].tobytes()
        data = jpeg if orientation is None else with_orientation(jpeg, orientation, order)
        (path / f"{index}.jpg").write_bytes(data)
    return path


def shown(path):
    """Images as OpenCV turns them for display, RGB."""
    return [cv2.imread(str(file))[..., ::-1] for file in sorted(path.iterdir())]


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("order", ["<", ">"])
def test_images_stand_upright(make, orientation, order):
    path = folder(make, [orientation] * 3, order=order)
    source = open_source(path, calib=UPRIGHT if orientation > 4 else SENSOR, fps=10)
    frames = list(source)
    size = (WIDTH, HEIGHT) if orientation > 4 else (HEIGHT, WIDTH)
    assert [frame.image.shape for frame in frames] == [(*size, 3)] * 3
    for frame, image in zip(frames, shown(path), strict=True):
        assert np.array_equal(frame.image, image) and frame.image.flags.carray
    assert source.turned == TURNED[orientation]
    assert ["mirrored" in warning for warning in source.warnings] == [True] * (orientation in (2, 4, 5, 7))
    assert exif.orientation(path / "0.jpg") == orientation


@pytest.mark.parametrize("orientation", [1, 2, 6, 8])
@pytest.mark.parametrize("suffix", [".png", ".webp"])
def test_png_and_webp_stand_upright(make, suffix, orientation):
    """As programs write that convert photographs and keep their EXIF data."""
    image = make.image(0)
    code = cv2.imencode(suffix, image, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()  # lossless
    segment = with_orientation(b"\xff\xd8", orientation)
    tiff = segment[segment.index(b"II*\0") :]
    if suffix == ".png":
        chunk = b"eXIf" + tiff
        code = code[:33] + struct.pack(">I", len(tiff)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + code[33:]
    else:
        code += b"EXIF" + struct.pack("<I", len(tiff)) + tiff + bytes(len(tiff) % 2)
        code = code[:4] + struct.pack("<I", len(code) - 8) + code[8:]
    (make.root / "images").mkdir()
    for index in range(3):
        (make.root / "images" / f"{index}{suffix}").write_bytes(code)
    source = open_source(make.root / "images", calib=UPRIGHT if orientation > 4 else SENSOR, fps=10)
    assert source.turned == TURNED[orientation]
    expected = {1: image, 2: image[:, ::-1], 6: np.rot90(image, -1), 8: np.rot90(image)}[orientation]
    assert all(np.array_equal(frame.image, expected[..., ::-1]) for frame in source)


@pytest.mark.parametrize("stated", [0, 9, 65535, None])
def test_no_orientation(make, stated):
    source = open_source(folder(make, [stated]), calib=SENSOR, fps=10)
    assert source.turned == 0 and next(iter(source)).image.shape == (HEIGHT, WIDTH, 3) and source.warnings == []


@pytest.mark.parametrize("orientations", [(6, 6, 6, 1), (6, 1, 6, 6, 6), (1, 1, 6), (None, 3, 3)])
def test_images_that_do_not_agree_are_read_as_stored(make, orientations):
    path = folder(make, orientations)
    source = open_source(path, calib=SENSOR, fps=10)
    assert {frame.image.shape for frame in source} == {(HEIGHT, WIDTH, 3)} and source.turned == 0
    assert "different orientations" in source.warnings[0]


def test_the_calibration_of_the_sensor_is_told(make):
    """As of a video that is turned."""
    path = folder(make, [6] * 2)
    with pytest.raises(DvoError) as caught:
        open_source(path, calib=replace(SENSOR, width=WIDTH, height=HEIGHT), fps=10)
    assert "the images stand upright, the calibration is that of the sensor" in caught.value.remedy
    source = open_source(path, calib=Calibration(50, 50, 32, 24), fps=10)
    assert "the images stand upright, the calibration is that of the sensor" in source.warnings[0]


def test_turned_images_have_no_rows_to_read_out(make):
    source = open_source(folder(make, [8] * 2), calib=replace(UPRIGHT, readout=0.02), fps=10)
    assert source.camera.readout == 0
    assert source.warnings == ["the images are turned by 270 degrees: the readout of the calibration was not used"]


def test_turned_and_reduced(make):
    path = folder(make, [6] * 2)
    source = open_source(path, calib=UPRIGHT, fps=10, max_pixels=WIDTH * HEIGHT // 4)
    assert source.recorded_camera.width == HEIGHT and source.camera == source.recorded_camera.resized(24, 32)
    averaged = shown(path)[0].reshape(32, 2, 24, 2, 3).mean(axis=(1, 3))
    assert np.abs(next(iter(source)).image - averaged).mean() < 2.5
    assert np.abs(next(iter(source)).image[::-1, ::-1] - averaged).mean() > 5


def test_right_images_are_turned_along(make):
    path, right = folder(make, [6] * 2), folder(make, [6] * 2, name="right")
    frame = next(iter(with_right(open_source(path, calib=UPRIGHT, fps=10), right, baseline=0.1)))
    assert np.array_equal(frame.right.image, frame.image)


def test_data_sets_with_depth_are_read_as_stored(make):
    images = sorted(folder(make, [6] * 2).iterdir())
    recording = ImageRecording("mine", make.root, images, np.arange(2.0), sensors=Sensors(depth=lambda image: None))
    assert recording.turned == 0 and recording.frame(0, Log()).image.shape == (HEIGHT, WIDTH, 3)


def test_run_json_tells(make, given):
    given()
    out = make.root / "out"
    calib = make.text("calib.txt", "51 50 23.5 31.5\n")
    line = ["run", str(folder(make, [6] * 4)), "--calib", str(calib), "--fps", "10", "--out", str(out)]
    assert main(line) == 0
    camera = json.loads((out / "run.json").read_text())["camera"]
    assert (camera["turned"], camera["width"], camera["height"]) == (90, HEIGHT, WIDTH)


def with_focal(jpeg, millimetres, order):
    """The image with an EXIF segment that states a focal length, in tenths of a millimetre."""
    first = struct.pack(f"{order}H", 1) + struct.pack(f"{order}HHII", 0x8769, 4, 1, 26) + bytes(4)
    inner = struct.pack(f"{order}H", 1) + struct.pack(f"{order}HHII", 0x920A, 5, 1, 44) + bytes(4)
    tiff = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8) + first + inner
    body = b"Exif\0\0" + tiff + struct.pack(f"{order}II", round(10 * millimetres), 10)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("focals", "zooms"), [([18, 18.1, 18], False), ([24, 24, 35, 70], True)])
def test_optical_zoom_is_said(make, order, focals, zooms):
    path = make.root / "zoom"
    path.mkdir()
    for index, focal in enumerate(focals):
        jpeg = cv2.imencode(".jpg", make.image(index))[1].tobytes()
        (path / f"{index}.jpg").write_bytes(with_focal(jpeg, focal, order))
    assert exif.focal_length(path / "0.jpg") == focals[0]
    warnings = open_source(path, calib=SENSOR, fps=10).warnings
    assert any("from 24 to 70 mm" in text for text in warnings) == zooms and len(warnings) == zooms
