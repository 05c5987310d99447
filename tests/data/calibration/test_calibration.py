import subprocess
import sys

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import Calibration, read_calibration
from dvo.data.calibration import values
from dvo.geometry.lenses import LENSES, Lens


@pytest.mark.parametrize(
    ("text", "numbers", "model", "coefficients"),
    [
        ("500 510 320 240", (500, 510, 320, 240), "none", ()),
        ("# fx fy cx cy\n500, 510, 320, 240  # pixels\n\n", (500, 510, 320, 240), "none", ()),
        ("500 510 320 240 0 0 0 0", (500, 510, 320, 240), "none", ()),
        ("500 510 320 240 .1 .2 .3 .4", (500, 510, 320, 240), "radtan", (0.1, 0.2, 0.3, 0.4)),
        ("500,510,320,240,.1,.2,.3,.4,-.5", (500, 510, 320, 240), "radtan", (0.1, 0.2, 0.3, 0.4, -0.5)),
        ("500 0 320\n0 510 240\n0 0 1\n", (500, 510, 320, 240), "none", ()),
    ],
)
def test_text(make, text, numbers, model, coefficients):
    found = read_calibration(make.text("c.txt", text))
    assert (found.fx, found.fy, found.cx, found.cy) == numbers
    assert (found.model, found.coefficients) == (model, coefficients)
    assert found.width is None


EUROC = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]
"""
KALIBR = """cam0:
  camera_model: pinhole
  intrinsics: [190, 191, 254, 256]
  distortion_model: equidistant
  distortion_coeffs: [0.003, 0.0007, -0.002, 0.0002]
  resolution: [512, 512]
cam1: {camera_model: pinhole, intrinsics: [1, 1, 1, 1]}
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 510., 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.1, 0.2, 0.3, 0.4, 0.5 ]
"""
ROS = """image_width: 640
image_height: 480
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 510, 240, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 8, data: [0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0]}
"""
ORB = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: 500.0
Camera.fy: 510.0
Camera.cx: 320.0
Camera.cy: 240.0
Camera.k1: 0.1
Camera.k2: 0.2
Camera.p1: 0.3
Camera.p2: 0.4
Camera.k3: 0.5
Camera.width: 640
Camera.height: 480
"""
OURS = "{fx: 500, fy: 510, cx: 320, cy: 240, width: 640, height: 480, model: fisheye, coefficients: [0.1, 0, 0, 0]}"
FIVE = (0.1, 0.2, 0.3, 0.4, 0.5)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (EUROC, (458.654, 457.296, 367.215, 248.375, "radtan", (-0.28, 0.07, 0.0002, 1.8e-05), 752, 480)),
        (KALIBR, (190, 191, 254, 256, "fisheye", (0.003, 0.0007, -0.002, 0.0002), 512, 512)),
        (OPENCV, (500, 510, 320, 240, "radtan", FIVE, 640, 480)),
        (ROS, (500, 510, 320, 240, "radtan", FIVE, 640, 480)),
        (ORB, (500, 510, 320, 240, "radtan", FIVE, 640, 480)),
        (OURS, (500, 510, 320, 240, "fisheye", (0.1, 0, 0, 0), 640, 480)),
        ("fx: 500\nfy: 510\ncx: 320\ncy: 240\n", (500, 510, 320, 240, "none", (), None, None)),
        ("intrinsics: [[500, 0, 320], [0, 510, 240], [0, 0, 1]]\n", (500, 510, 320, 240, "none", (), None, None)),
    ],
    ids=["euroc", "kalibr", "opencv", "ros", "orbslam", "ours", "bare", "matrix"],
)
def test_yaml(make, text, expected):
    file = make.text("c.yaml", text)
    assert read_calibration(file) == Calibration(*expected, file=file)


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("c.txt", "500 510 320", "3 numbers"),
        ("c.txt", "", "no numbers"),
        ("c.txt", "500 510 320 240 0.1 0.2", "6 numbers"),
        ("c.txt", "fx fy cx cy", "not a number"),
        ("c.txt", "500 nan 320 240", "finite"),
        ("c.txt", "-500 510 320 240", "positive"),
        ("c.txt", "P0: 1 2 3 4 5 6 7 8 9 10 11 12", "KITTI"),
        ("c.yaml", "fx: 500", "no fx, fy, cx, cy"),
        ("c.yaml", "fx: [", "not valid YAML"),
        ("c.yaml", "- 1\n- 2\n", "no keys"),
        ("c.yaml", "{fx: a, fy: 1, cx: 1, cy: 1}", "not numbers"),
        ("c.yaml", "{fx: 1, fy: 1, cx: 1, cy: 1, model: magic}", "magic"),
        ("c.yaml", "{fx: 1, fy: 1, cx: 1, cy: 1, model: none, coefficients: [0.1]}", "1 coefficients"),
        ("c.yaml", "{fx: 1, fy: 1, cx: 1, cy: 1, model: fisheye, coefficients: [1, 2, 3, 4, 5]}", "5 coefficients"),
        ("c.yaml", "{fx: 1, fy: 1, cx: 1, cy: 1, resolution: [640]}", "width and height"),
        ("c.yaml", "{fx: 1, fy: 1, cx: 1, cy: 1, readout: 20}", "readout: expected seconds, 0 to 1"),
        ("c.yaml", "{fx: 1, fy: 1, cx: 1, cy: 1, readout: -0.01}", "0 to 1"),
        ("c.yaml", "{fx: 1, fy: 1, cx: 1, cy: 1, readout: .nan}", "0 to 1"),
        ("c.yaml", "{fx: 1, fy: 1, cx: 1, cy: 1, readout: fast}", "not numbers"),
        ("c.yaml", "!!python/object/apply:os.system ['true']", "not valid YAML"),
    ],
)
def test_malformed_files(make, name, text, match):
    file = make.text(name, text)
    with pytest.raises(DvoError, match=match) as caught:
        read_calibration(file)
    assert caught.value.file == file and caught.value.remedy


def test_missing_file(tmp_path):
    with pytest.raises(DvoError, match="no such file"):
        read_calibration(tmp_path / "nowhere.txt")


def test_camera_of_fitting_images():
    camera = Calibration(500, 510, 320, 240, "radtan", (0.1, 0, 0, 0), 640, 480).camera(640, 480)
    assert (camera.fx, camera.width, camera.model, camera.coefficients) == (500, 640, "radtan", (0.1, 0, 0, 0))


@pytest.mark.parametrize(
    ("calibration", "match"),
    [
        (Calibration(500, 500, 640, 240), "outside"),
        (Calibration(500, 500, 320, -1), "outside"),
        (Calibration(50, 500, 320, 240), "fx=50"),
        (Calibration(500, 13000, 320, 240), "fy=13000"),
        (Calibration(500, 500, 320, 240, width=752, height=480), "752x480"),
        (Calibration(500, 500, 320, 240, width=640, height=360), "640x360"),
    ],
)
def test_intrinsics_that_do_not_fit(calibration, match):
    with pytest.raises(DvoError, match=match) as caught:
        calibration.camera(640, 480)
    assert caught.value.field == "intrinsics" and "640x480" in str(caught.value)


def test_doubts_about_a_calibration_of_another_resolution():
    assert Calibration(718.9, 718.9, 607.2, 185.2).doubts(1241, 376) == []
    assert "principal point" in Calibration(500, 500, 320, 240).doubts(1920, 1080)[0]
    assert "stretched" in Calibration(500, 1000, 320, 240).doubts(640, 480)[0]


@pytest.mark.parametrize("scale", [0.5, 0.75, 1.25, 1.5, 2.0, 3.0])
@pytest.mark.parametrize(("width", "height"), [(640, 480), (1280, 720), (1920, 1080)])
def test_a_calibration_of_another_resolution_names_it(width, height, scale):
    other = round(width * scale), round(height * scale)
    for cx, cy in (((width - 1) / 2, (height - 1) / 2), (0.487 * width, 0.51 * height)):
        found = Calibration(0.8 * width, 0.8 * width, cx, cy)
        assert found.doubts(width, height) == []
        assert any(f"{width}x{height} images" in doubt for doubt in found.doubts(*other))
        stated = Calibration(0.8 * width, 0.8 * width, cx, cy, width=other[0], height=other[1])
        assert not any("is the centre of" in doubt for doubt in stated.doubts(*other))


@pytest.mark.parametrize("text", [EUROC, KALIBR.replace("cam1:", "  readout: 0.02\ncam1:"), OPENCV, ROS, ORB])
def test_readout_of_a_rolling_shutter(make, text):
    text = text if "readout" in text else text + "readout: 0.02\n"
    found = read_calibration(make.text("c.yaml", text))
    assert found.readout == 0.02
    assert found.camera(found.width, found.height).readout == 0.02


def test_readout_is_0_unless_it_is_stated(make):
    assert read_calibration(make.text("c.yaml", OURS)).readout == 0
    assert read_calibration(make.text("c.yaml", OURS.replace("}", ", readout: 0}"))).readout == 0
    assert read_calibration(make.text("c.txt", "500 510 320 240")).readout == 0
    with pytest.raises(DvoError, match="0 to 1 s"):
        Calibration(500, 510, 320, 240, readout=20).camera(640, 480)


@pytest.mark.parametrize(("width", "height"), [(1080, 1920), (720, 1280)])
def test_a_calibration_that_is_not_turned_with_the_images_is_noted(width, height):
    found = Calibration(1500, 1500, (height - 1) / 2, (width - 1) / 2)
    assert any("turn it too" in doubt for doubt in found.doubts(width, height))
    assert Calibration(1500, 1500, (width - 1) / 2, (height - 1) / 2).doubts(width, height) == []
    stated = Calibration(1500, 1500, (height - 1) / 2, (width - 1) / 2, width=height, height=width)
    with pytest.raises(DvoError, match="turn it too"):
        stated.camera(width, height)


def test_a_principal_point_outside_of_turned_images_names_the_turn():
    with pytest.raises(DvoError, match="lies outside.*turn it too"):
        Calibration(1500, 1500, 959.5, 359.5).camera(720, 1920)
    with pytest.raises(DvoError, match="scale it"):
        Calibration(1500, 1500, 2000, 2000).camera(720, 1920)


@pytest.mark.parametrize("kind", ["fd", "stdin"])
def test_a_calibration_from_a_pipe_of_the_shell(tmp_path, kind):
    code = "from dvo.data import read_calibration; import sys; print(read_calibration(sys.argv[1]).fx)"
    place = {"fd": "/dev/fd/0", "stdin": "/dev/stdin"}[kind]
    done = subprocess.run(
        [sys.executable, "-c", code, place], input="500 510 320 240\n", capture_output=True, text=True
    )
    assert done.stdout == "500.0\n", done.stderr


def test_focal_lengths_of_zero_are_one_error():
    calibration = Calibration(500.0, 0.0, 320.0, 240.0)
    assert calibration.doubts(640, 480)
    with pytest.raises(DvoError):
        calibration.camera(640, 480)


def test_a_folder_is_no_calibration(tmp_path):
    with pytest.raises(DvoError, match="calibration: a folder, no file"):
        read_calibration(tmp_path)


@pytest.mark.parametrize("entry", ["distortion_coefficients: [0.2, 0.1]", "a1: 0.2\na2: 0.1"])
def test_a_lens_model_needs_a_row_and_a_name_to_be_read(entry, tmp_path, monkeypatch):
    """No branch of its own: what a file says of a model is never taken for another one."""
    monkeypatch.setitem(LENSES, "quadratic", Lens(("a1", "a2"), (2,), lambda t, k: (t, np.ones_like(t))))
    monkeypatch.setattr(values, "model_of", lambda name: "quadratic")
    file = tmp_path / "camera.yaml"
    file.write_text(f"fx: 500\nfy: 500\ncx: 320\ncy: 240\ndistortion_model: quadratic\n{entry}\n")
    found = read_calibration(file)
    assert found.model == "quadratic" and found.coefficients == (0.2, 0.1)
