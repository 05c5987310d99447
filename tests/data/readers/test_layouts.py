"""Layouts of data sets that are entered at other places, and those of TUM-VI, KITTI's raw data and associated lists."""

import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data.companions.right_source import with_right

SENSOR = """sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, {x}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
resolution: [64, 48]
camera_model: pinhole
intrinsics: [{f}, 51, 31, 23]
distortion_model: radial-tangential
distortion_coefficients: [0, 0, 0, 0]
"""
STAMPS = [1403636579763555584 + 50_000_000 * i for i in range(4)]


def euroc(make):
    for number in (0, 1):
        make.images(f"s/mav0/cam{number}/data", [f"{stamp}.png" for stamp in STAMPS])
        make.text(f"s/mav0/cam{number}/data.csv", "".join(f"{stamp},{stamp}.png\n" for stamp in STAMPS))
        make.text(f"s/mav0/cam{number}/sensor.yaml", SENSOR.format(x=number / 10, f=50 + number))
    truth = "".join(f"{stamp},{i},0,0,1,0,0,0\n" for i, stamp in enumerate(STAMPS))
    make.text("s/mav0/state_groundtruth_estimate0/data.csv", truth)
    return make.root / "s"


@pytest.mark.parametrize("place", ["", "mav0", "mav0/cam0", "mav0/cam0/data"])
def test_euroc_is_entered_anywhere(make, place):
    source = dvo.open(euroc(make) / place)
    assert (source.kind, len(source), source.camera.fx, source.name) == ("euroc", 4, 50, "s")
    assert source.groundtruth.positions[:, 0] == pytest.approx([0, 1, 2, 3])
    assert next(iter(source)).right.T_left_right[0] == pytest.approx(0.1)
    assert source.calibration.file.name == "sensor.yaml"


@pytest.mark.parametrize(("parts", "unit"), [(1_000, "microseconds"), (1_000_000, "milliseconds")])
def test_euroc_s_layout_with_dates_in_another_unit(make, parts, unit):
    """As recorders of their own write it; images, truth and inertial samples keep one clock."""
    root = euroc(make)
    imu = "".join(f"{STAMPS[0] + 5_000_000 * k},0,0,0.1,0,0,9.81\n" for k in range(31))
    make.text("s/mav0/imu0/data.csv", imu)
    for file in root.rglob("data.csv"):
        rows = [line.split(",", 1) for line in file.read_text().splitlines()]
        file.write_text("".join(f"{int(stamp) // parts},{rest}\n" for stamp, rest in rows))
    source = dvo.open(root)
    assert source.timestamps == pytest.approx([stamp / 1e9 for stamp in STAMPS], abs=1e-3)
    assert source.groundtruth.positions[:, 0] == pytest.approx([0, 1, 2, 3])
    assert np.diff(source.inertial.timestamps) == pytest.approx(0.005, abs=1e-3)
    assert f"taken for {unit}" in source.warnings[0] and len(list(source)[2].inertial) > 8


def test_a_header_states_the_unit_of_relative_stamps(make):
    root = euroc(make)
    rows = "".join(f"{50_000 * i},{stamp}.png\n" for i, stamp in enumerate(STAMPS))
    make.text("s/mav0/cam0/data.csv", "#timestamp [us],filename\n" + rows)
    assert dvo.open(root).timestamps == pytest.approx([0, 0.05, 0.1, 0.15])


@pytest.mark.parametrize("place", ["mav0/cam1", "mav0/cam1/data"])
def test_the_right_camera_alone(make, place):
    source = dvo.open(euroc(make) / place)
    assert (len(source), source.camera.fx) == (4, 51) and next(iter(source)).right is None
    assert source.groundtruth.positions[:, 0] == pytest.approx([0.1, 1.1, 2.1, 3.1])


CAMCHAIN = """cam0:
  T_cam_imu: [[1, 0, 0, -0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [50, 51, 31, 23]
  distortion_model: equidistant
  distortion_coeffs: [0.01, 0, 0, 0]
  resolution: [64, 48]
cam1:
  T_cam_imu: [[1, 0, 0, -0.6], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [52, 51, 31, 23]
  distortion_model: equidistant
  distortion_coeffs: [0.01, 0, 0, 0]
  resolution: [64, 48]
"""


def test_tum_vi(make):
    folder = euroc(make)
    for number in (0, 1):
        (folder / f"mav0/cam{number}/sensor.yaml").unlink()
    (folder / "mav0/state_groundtruth_estimate0").rename(folder / "mav0/mocap0")
    make.text("s/dso/camchain.yaml", CAMCHAIN)
    source = dvo.open(folder, undistort=False)
    assert source.camera.model == "fisheye" and source.calibration.file.name == "camchain.yaml"
    assert source.groundtruth.positions[:, 0] == pytest.approx([0.5, 1.5, 2.5, 3.5])
    assert next(iter(source)).right.T_left_right[0] == pytest.approx(0.1)


CAM_TO_CAM = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_00: 70 50
K_00: 60 0 33 0 61 25 0 0 1
D_00: -0.1 0.01 0 0 0
S_rect_00: 64 48
P_rect_00: 50 0 31 0 0 50 23 0 0 0 1 0
P_rect_01: 50 0 31 -25 0 50 23 0 0 0 1 0
P_rect_02: 50 0 31 2 0 50 23 0 0 0 1 0
"""


@pytest.mark.parametrize("place", ["", "image_00", "image_00/data"])
def test_kitti_raw(make, place):
    drive = "2011_09_26/2011_09_26_drive_0001_sync"
    for number in (0, 1):
        make.images(f"{drive}/image_0{number}/data", [f"{i:010d}.png" for i in range(3)])
        rows = "".join(f"2011-09-26 13:02:25.{594 + 100 * i}360375\n" for i in range(3))
        make.text(f"{drive}/image_0{number}/timestamps.txt", rows)
    make.text("2011_09_26/calib_cam_to_cam.txt", CAM_TO_CAM)
    make.text(f"{drive}/oxts/timestamps.txt", "")
    source = dvo.open(make.root / drive / place)
    assert (source.kind, source.name, source.camera.fx) == ("kitti_raw", "2011_09_26_drive_0001_sync", 50)
    assert np.diff(source.timestamps) == pytest.approx([0.1, 0.1], abs=1e-6)
    assert next(iter(with_right(source))).right.T_left_right[0] == pytest.approx(0.5)
    assert len(source.warnings) == 1 and "oxts" in source.warnings[0] and source.positions is None
    rows = "".join(f"2011-09-26 13:02:25.{594 + 100 * i}360375\n" for i in range(3))
    make.text(f"{drive}/oxts/timestamps.txt", rows)
    for i in range(3):
        values = [49.0 + 1e-5 * i, 8.0, 110.0, *[0.0] * 20, 0.5 + i, 0.1, 4, 9, 6 if i else 0, 6, 6]
        make.text(f"{drive}/oxts/data/{i:010d}.txt", " ".join(map(str, values)))
    positions = dvo.open(make.root / drive / place).positions
    assert positions is not None and positions.has_fix.tolist() == [False, True, True]
    facts = positions.summary()
    assert facts["length"] == pytest.approx(1.112, abs=1e-3) and facts["precision"] == 1.5
    assert facts["fix"] == {"RTK integer": 2, "none": 1} and facts["precision_unit"] == "m"
    make.text(f"{drive}/oxts/data/0000000001.txt", "1 2 3")
    with pytest.raises(DvoError, match="not 30 numbers"):
        _ = dvo.open(make.root / drive / place).positions


def test_kitti_raw_that_is_not_rectified(make):
    drive = "2011_09_26/2011_09_26_drive_0001_extract"
    make.images(f"{drive}/image_00/data", ["0000000000.png", "0000000001.png"], 70, 50)
    make.text("2011_09_26/calib_cam_to_cam.txt", CAM_TO_CAM)
    camera = dvo.open(make.root / drive, undistort=False, fps=10).camera
    assert [camera.fx, camera.fy, camera.cx, camera.model, camera.width] == [60, 61, 33, "radtan", 70]


@pytest.mark.parametrize("row", ["{t} rgb/{i}.png {u} depth/{i}.png\n", "{u} depth/{i}.png {t} rgb/{i}.png\n"])
def test_associated_lists(make, row):
    make.images("s/rgb", [f"{i}.png" for i in range(3)])
    make.images("s/depth", [f"{i}.png" for i in range(3)])
    text = "".join(row.format(t=1305031102.1 + i / 30, u=1305031102.11 + i / 30, i=i) for i in range(3))
    make.text("s/associations.txt", text)
    source = dvo.open(make.root / "s", calib=make.calib())
    assert source.kind == "tum" and [path.name for path in source.recording.images] == ["0.png", "1.png", "2.png"]
    assert np.diff(source.timestamps) == pytest.approx([1 / 30, 1 / 30], abs=1e-6)
    assert source.recording.sensors.depth(source.recording.images[1]).name == "1.png"
    assert source.recording.sensors.depth(source.recording.images[1]).parent.name == "depth"


def test_associated_lists_that_count(make):
    make.images("s/rgb", ["0.png", "1.png"])
    make.text("s/associations.txt", "0 depth/0.png 0 rgb/0.png\n1 depth/1.png 1 rgb/1.png\n")
    assert dvo.open(make.root / "s", calib=make.calib(), fps=20).timestamps.tolist() == [0, 0.05]
