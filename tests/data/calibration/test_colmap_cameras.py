"""Cameras of COLMAP models as calibrations."""

import struct

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import Calibration, read_calibration
from dvo.export.colmap import write_colmap, write_colmap_text
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import distort
from tests.support.reconstructions import one_view

# Number of the model and parameters in COLMAP's files; expected: fx fy cx cy with pixel centres at integers.
MODELS = {
    "SIMPLE_PINHOLE": (0, (500, 320, 240), (500, 500, 319.5, 239.5), "none", ()),
    "PINHOLE": (1, (500, 510, 320, 240), (500, 510, 319.5, 239.5), "none", ()),
    "SIMPLE_RADIAL": (2, (500, 320, 240, -0.1), (500, 500, 319.5, 239.5), "radtan", (-0.1, 0, 0, 0)),
    "RADIAL": (3, (500, 320, 240, -0.1, 0.02), (500, 500, 319.5, 239.5), "radtan", (-0.1, 0.02, 0, 0)),
    "OPENCV": (
        4, (500, 510, 320, 240, -0.1, 0.02, 0.001, 0.002), (500, 510, 319.5, 239.5), "radtan",
        (-0.1, 0.02, 0.001, 0.002),
    ),
    "OPENCV_FISHEYE": (
        5, (500, 510, 320, 240, 0.1, 0.02, 0.03, 0.04), (500, 510, 319.5, 239.5), "fisheye", (0.1, 0.02, 0.03, 0.04),
    ),
    "FULL_OPENCV": (
        6, (500, 510, 320, 240, -0.1, 0.02, 0.001, 0.002, 0.3, 0, 0, 0), (500, 510, 319.5, 239.5), "radtan",
        (-0.1, 0.02, 0.001, 0.002, 0.3),
    ),
    "FULL_OPENCV of eight": (
        6, (500, 510, 320, 240, -0.1, 0.02, 0.001, 0.002, 0.3, 0.1, 0, 0.2), (500, 510, 319.5, 239.5), "radtan",
        (-0.1, 0.02, 0.001, 0.002, 0.3, 0.1, 0, 0.2),
    ),
    "FOV": (7, (500, 510, 320, 240, 0.9), (500, 510, 319.5, 239.5), "fov", (0.9,)),
    "THIN_PRISM_FISHEYE": (
        10, (500, 510, 320, 240, 0.1, 0.02, 0.001, 0.002, 0.03, 0.04, 0.005, 0.006), (500, 510, 319.5, 239.5),
        "thin_prism_fisheye", (0.1, 0.02, 0.001, 0.002, 0.03, 0.04, 0.005, 0.006),
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        11, (500, 510, 320, 240, *(0.001 * n for n in range(12))), (500, 510, 319.5, 239.5), "fisheye624",
        tuple(0.001 * n for n in range(12)),
    ),
    "SIMPLE_FISHEYE": (14, (500, 320, 240), (500, 500, 319.5, 239.5), "fisheye", (0, 0, 0, 0)),
    "FISHEYE": (15, (500, 510, 320, 240), (500, 510, 319.5, 239.5), "fisheye", (0, 0, 0, 0)),
    "EUCM": (16, (500, 510, 320, 240, 0.6, 1.1), (500, 510, 319.5, 239.5), "eucm", (0.6, 1.1)),
    "SIMPLE_RADIAL_FISHEYE": (8, (500, 320, 240, 0.1), (500, 500, 319.5, 239.5), "fisheye", (0.1, 0, 0, 0)),
    "RADIAL_FISHEYE": (9, (500, 320, 240, 0.1, 0.02), (500, 500, 319.5, 239.5), "fisheye", (0.1, 0.02, 0, 0)),
}  # fmt: skip


def row(identifier, name, values):
    return f"{identifier} {name} 640 480 {' '.join(map(str, values))}\n"


def binary(*cameras):
    parts = [struct.pack("<Q", len(cameras))]
    for identifier, name, values in cameras:
        parts.append(struct.pack(f"<iiQQ{len(values)}d", identifier, MODELS[name][0], 640, 480, *values))
    return b"".join(parts)


@pytest.mark.parametrize("name", MODELS)
def test_models_in_text_and_binary_files(name, make):
    _, values, numbers, model, coefficients = MODELS[name]
    head = "# Camera list with one line of data per camera:\n#\n"
    text = make.text("cameras.txt", head + row(3, name.split()[0], values))
    assert read_calibration(text) == Calibration(*numbers, model, coefficients, 640, 480, text)
    file = make.root / "cameras.bin"
    file.write_bytes(binary((3, name, values)))
    assert read_calibration(file) == Calibration(*numbers, model, coefficients, 640, 480, file)
    assert read_calibration(f"{file}:3").file == file


def colmap_pixel(name, values, x, y):
    """Pixel of a ray ``(x, y, 1)`` as COLMAP defines it, the corner of the first pixel at 0."""
    r2 = x * x + y * y
    if name == "OPENCV":
        fx, fy, cx, cy, k1, k2, p1, p2 = values
        radial = k1 * r2 + k2 * r2 * r2
        u = x + x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y + y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    else:
        fx, fy, cx, cy, k1, k2, k3, k4 = values
        theta = np.arctan(np.sqrt(r2))
        t2 = theta * theta
        scale = theta * (1 + k1 * t2 + k2 * t2**2 + k3 * t2**3 + k4 * t2**4) / np.sqrt(r2)
        u, v = x * scale, y * scale
    return fx * u + cx, fy * v + cy


@pytest.mark.parametrize("name", ["OPENCV", "OPENCV_FISHEYE"])
def test_a_ray_falls_on_the_same_place_of_the_image(name, make):
    values = MODELS[name][1]
    camera = read_calibration(make.text("cameras.txt", row(1, name, values))).camera(640, 480)
    for x, y in ((0.3, -0.2), (-0.1, 0.25)):
        u, v = distort(np.array([x, y]), camera) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        assert (u + 0.5, v + 0.5) == pytest.approx(colmap_pixel(name, values, x, y), abs=1e-9)


def test_an_exported_model_gives_the_camera_back(tmp_path):
    camera = Camera(50.5, 51.25, 31.0, 23.0, 64, 48)
    model, _ = one_view(np.eye(4), camera, (31.0, 23.0), 2.0)
    for write, name in ((write_colmap, "cameras.bin"), (write_colmap_text, "cameras.txt")):
        (folder := tmp_path / name).mkdir()
        write(model, folder)
        assert read_calibration(folder / "sparse" / "0" / name).camera(64, 48) == camera


def test_a_camera_by_its_number(make):
    file = make.text("cameras.txt", row(2, "SIMPLE_PINHOLE", (500, 320, 240)) + row(5, "PINHOLE", (101, 102, 300, 200)))
    assert read_calibration(f"{file}:2").fx == 500 and read_calibration(f"{file}:5").fy == 102
    with pytest.raises(DvoError, match=r"2 cameras in it: 2, 5. Name one: cameras.txt:2"):
        read_calibration(file)
    with pytest.raises(DvoError, match="no camera 3 in it. Name one of 2, 5"):
        read_calibration(f"{file}:3")
    with pytest.raises(DvoError, match=r"no numbered cameras in it. Leave out :1"):
        read_calibration(f"{make.calib()}:1")
    with pytest.raises(DvoError, match="no such file"):
        read_calibration(make.root / "nowhere.txt:1")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("1 DIVISION 640 480 500 500 320 240 0.1", "no lens model for DIVISION"),
        ("1 EQUIRECTANGULAR 640 480 640 480", "no lens model for EQUIRECTANGULAR"),
        ("1 FOV 640 480 500 500 320 240 3.9", "w=3.9 is no coefficient of the model fov"),
        ("1 MAGIC 640 480 500 500 320 240", "line 1: unknown camera model 'MAGIC'"),
        ("1 PINHOLE 640 480 500 500 320", "5 numbers after PINHOLE, expected width height fx fy cx cy"),
        ("1 PINHOLE 640 480 500 five 320 240", "not a number"),
        ("1 PINHOLE 0 480 500 500 320 240", "0x480 is no size"),
        ("1 PINHOLE 640 480 -500 500 320 240", "positive"),
        ("1 PINHOLE 640 480 nan 500 320 240", "finite"),
        ("1 PINHOLE 640 480 5 5 3 2\n1 PINHOLE 640 480 5 5 3 2", "two cameras of one number"),
    ],
)
def test_texts_that_are_refused(text, match, make):
    file = make.text("cameras.txt", text + "\n")
    with pytest.raises(DvoError, match=match) as caught:
        read_calibration(file)
    assert caught.value.file == file and caught.value.remedy


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"", "empty"),
        (struct.pack("<Q", 0), "no camera in it"),
        (struct.pack("<Q", 2**60), "cut short"),
        (binary((1, "PINHOLE", (5, 5, 3, 2)))[:-1], "cut short"),
        (binary((1, "PINHOLE", (5, 5, 3, 2))) + b"1", "bytes after the last camera"),
        (struct.pack("<QiiQQ", 1, 1, 99, 640, 480), "unknown camera model number 99"),
    ],
)
def test_binary_files_that_are_refused(data, match, tmp_path):
    file = tmp_path / "cameras.bin"
    file.write_bytes(data)
    with pytest.raises(DvoError, match=match) as caught:
        read_calibration(file)
    assert caught.value.file == file and caught.value.remedy
