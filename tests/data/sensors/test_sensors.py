"""Depth, right images and inertial samples of every layout, in miniature."""

import pickle

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import Calibration, open_source
from dvo.data import recording as recordings
from tests.support.tum_folder import depth_image, tum


def left_image(make, index):
    return make.image(index)[..., ::-1]


# --- TUM RGB-D


@pytest.mark.parametrize("listing", [True, False])
def test_tum_depth_by_time(make, listing):
    source = open_source(tum(make, listing))
    depths = [frame.depth for frame in source]
    assert [None if depth is None else float(depth[3, 3]) for depth in depths] == [1, 2, None, 3]
    assert depths[0].shape == (48, 64) and depths[0].dtype == np.float32
    assert [float(frame.depth[0, 0]) for frame in open_source(make.root / "seq", stride=3)] == [1, 3]
    # times of the user do not change which depth belongs to which image
    times = make.text("t.txt", "0\n1\n2\n3\n")
    source = open_source(make.root / "seq", times=times)
    assert [frame.depth is not None for frame in source] == [True, True, False, True]


def test_a_calibration_states_another_unit(make):
    folder = tum(make)
    millimetres = Calibration(50, 51, 31, 23, depth_scale=1000)
    assert float(next(iter(open_source(folder, calib=millimetres))).depth[0, 0]) == 5


def test_depth_is_undistorted_with_the_image(make):
    folder = tum(make)
    lens = Calibration(50, 50, 31, 23, "radtan", (-0.2, 0.02, 0, 0))
    depth = np.full((48, 64), 5000, np.uint16)
    depth[:, 32:] = 10000
    cv2.imwrite(str(next(iter(sorted((folder / "depth").iterdir())))), depth)
    raw, straight = (next(iter(open_source(folder, calib=lens, undistort=u))) for u in (False, True))
    assert np.array_equal(raw.depth, depth / np.float32(5000))
    seen = straight.depth[np.isfinite(straight.depth)]
    assert set(np.unique(seen)) == {1, 2} and seen.size > 0.95 * depth.size  # at the edge half a pixel may be missing
    # columns are drawn apart from the principal point (31, 23) outwards, and the step at 31.5 moves little
    assert straight.depth[23, 31] == 1 and straight.depth[23, 33] == 2 and not np.array_equal(raw.depth, straight.depth)


def test_nothing_is_decoded_that_nobody_reads(make, monkeypatch):
    folder = tum(make)
    calls = []
    read = recordings.read_depth
    monkeypatch.setattr(recordings, "read_depth", lambda *given: calls.append(given) or read(*given))
    (folder / "depth.txt").write_text("not a listing\n")
    assert len(list(open_source(folder))) == 4 and calls == []
    with pytest.raises(DvoError, match="timestamp filename"):
        _ = next(iter(open_source(folder))).depth


def test_a_corrupt_depth_image_keeps_its_frame_and_is_counted(make):
    folder = tum(make)
    victim = sorted((folder / "depth").iterdir())[1]
    victim.write_bytes(victim.read_bytes()[:50])
    source = open_source(folder)
    assert [frame.depth is not None for frame in source] == [True, False, False, True]
    assert source.skipped == 0 and source.warnings == [f"1 depth or right image could not be read: {victim.name}"]


def test_depth_of_another_size_names_the_image(make):
    folder = tum(make)
    depth_image(make, f"seq/depth/{sorted((folder / 'depth').iterdir())[0].name}", 1, width=32, height=20)
    with pytest.raises(DvoError, match="depth image is 32x20, the image 64x48"):
        _ = next(iter(open_source(folder))).depth


def test_single_frames_have_depth_and_no_inertial_samples(make):
    source = pickle.loads(pickle.dumps(open_source(tum(make))))  # as a data loader sends it to its workers
    (third, _), (first, file) = source.frames_at([3, 0])
    assert (float(third.depth[0, 0]), float(first.depth[0, 0])) == (3, 1) and file.name == "10.000000.png"
    assert first.inertial is None and first.right is None


# --- sequence folders


def test_sequence_depth_and_right_images_where_the_calibration_states_unit_and_baseline(make):
    make.images("clip/left", [f"frame-{i:04d}.png" for i in range(3)])
    make.images("clip/right", [f"frame-{i:04d}.png" for i in (0, 2)])
    for i in range(2):
        depth_image(make, f"clip/depth/frame-{i:04d}.depth.png", 2 + i, 1000)
    make.text("clip/calib.yaml", "{fx: 50, fy: 51, cx: 31, cy: 23, depth_scale: 1000, baseline: 0.12}")
    frames = list(open_source(make.root / "clip", fps=10))
    assert [None if f.depth is None else float(f.depth[0, 0]) for f in frames] == [2, 3, None]
    assert [f.right is not None for f in frames] == [True, False, True]
    assert np.array_equal(frames[2].right.image, left_image(make, 1))  # the second that was written
    assert frames[0].right.camera == frames[0].camera and frames[0].right.baseline == 0.12
    assert frames[0].right.T_left_right.tolist() == [0.12, 0, 0, 0, 0, 0, 1]
    # neither is guessed
    plain = list(open_source(make.root / "clip", fps=10, calib=make.calib()))
    assert all(f.depth is None and f.right is None for f in plain)


@pytest.mark.parametrize(
    ("text", "scale", "baseline"),
    [
        ("DepthMapFactor: 5000.0\nCamera.bf: 25.0\n", 5000, 0.5),
        ("RGBD.DepthMapFactor: 1000.0\nStereo.b: 0.11\n", 1000, 0.11),
        ("", None, None),
    ],
)
def test_orbslam_settings(make, text, scale, baseline):
    from dvo.data import read_calibration

    keys = "Camera.fx: 50\nCamera.fy: 51\nCamera.cx: 31\nCamera.cy: 23\n"
    found = read_calibration(make.text("c.yaml", keys + text))
    assert (found.depth_scale, found.baseline) == (scale, baseline)
    with pytest.raises(DvoError, match="baseline: expected one positive"):
        read_calibration(make.text("d.yaml", keys + "Stereo.b: -1\n"))


# --- KITTI


def kitti(make):
    for camera in range(4):
        make.images(f"sequences/07/image_{camera}", [f"{i:06d}.png" for i in range(3)])
    cv2.imwrite(str(make.root / "sequences/07/image_1/000001.png"), make.image(9))
    rows = [f"P{i}: {50 + i} 0 31 {-5.0 * i * (50 + i)} 0 {50 + i} 23 0 0 0 1 0" for i in range(4)]
    make.text("sequences/07/calib.txt", "\n".join(rows))
    make.text("sequences/07/times.txt", "0.0\n0.1\n0.2\n")
    return make.root / "sequences/07"


def test_kitti_right_images(make):
    frames = list(open_source(kitti(make)))
    right = frames[1].right
    assert np.array_equal(right.image, left_image(make, 9)) and right.camera.fx == 51
    assert right.T_left_right.tolist() == [5, 0, 0, 0, 0, 0, 1] and frames[1].depth is None
    colour = next(iter(open_source(make.root / "sequences/07/image_2"))).right
    assert colour.camera.fx == 53 and colour.T_left_right[0] == pytest.approx(5)  # 15 - 10
    assert next(iter(open_source(make.root / "sequences/07/image_1"))).right is None
    (make.root / "sequences/07/image_1/000002.png").unlink()
    assert [frame.right is None for frame in open_source(make.root / "sequences/07")] == [False, False, True]


# --- TartanAir


@pytest.mark.parametrize("version", [1, 2])
def test_tartanair_depth_and_right_images(make, version):
    left, right = ("left", "right") if version == 1 else ("lcam_front", "rcam_front")
    size = (640, 480) if version == 1 else (640, 640)
    make.images(f"P000/image_{left}", [f"{i:06d}_{left}.png" for i in range(2)], *size)
    make.images(f"P000/image_{right}", [f"{i:06d}_{right}.png" for i in range(2)], *size)
    make.text(f"P000/pose_{left}.txt", "1 2 3 0 0 0 1\n1 3 3 0 0 0 1\n")
    folder = make.root / f"P000/depth_{left}"
    folder.mkdir()
    truth = np.linspace(1, 50, size[0] * size[1], dtype=np.float32).reshape(size[::-1])
    if version == 1:
        np.save(folder / f"000001_{left}_depth.npy", truth)
    else:
        cv2.imwrite(str(folder / f"000001_{left}_depth.png"), truth.view(np.uint8).reshape(*truth.shape, 4))
    frames = list(open_source(make.root / "P000"))
    assert frames[0].depth is None and np.array_equal(frames[1].depth, truth)
    assert frames[0].right.T_left_right.tolist() == [0.25, 0, 0, 0, 0, 0, 1]
    assert np.array_equal(frames[1].right.image, frames[1].image) and frames[1].right.camera == frames[1].camera


# --- EuRoC

SENSOR = """%YAML:1.0
T_BS: {{rows: 4, cols: 4, data: [{}]}}
resolution: [64, 48]
intrinsics: [{}, 51, 31, 23]
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.01, 0.0, 0.0]
"""
# camera 0 is turned by 90 degrees about the body's z axis, camera 1 lies 0.1 m along the x axis of camera 0
CAM0 = "0,-1,0,0.1, 1,0,0,0.2, 0,0,1,0.3, 0,0,0,1"
CAM1 = "0,-1,0,0.1, 1,0,0,0.3, 0,0,1,0.3, 0,0,0,1"


def euroc(make):
    stamps = [1403636580000000000 + i * 50_000_000 for i in range(4)]
    for camera, extrinsics in enumerate((CAM0, CAM1)):
        make.images(f"V1/mav0/cam{camera}/data", [f"{stamp}.png" for stamp in stamps])
        make.text(f"V1/mav0/cam{camera}/sensor.yaml", SENSOR.format(extrinsics, 50 + camera))
    rows = [f"{stamps[0] + i * 5_000_000},{i},0.2,0.3,1,2,{i}" for i in range(-2, 25)]
    make.text("V1/mav0/imu0/data.csv", "#timestamp [ns],w_x,...\n" + "\n".join(rows))
    make.text("V1/mav0/imu0/sensor.yaml", "T_BS: {rows: 4, cols: 4, data: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]}\n")
    return make.root / "V1"


def test_euroc_right_camera(make):
    frames = list(open_source(euroc(make)))
    right = frames[2].right
    assert right.T_left_right == pytest.approx([0.1, 0, 0, 0, 0, 0, 1], abs=1e-9)
    assert not right.camera.is_distorted and right.camera.fx / right.camera.fy == pytest.approx(51 / 51)
    assert right.camera != frames[2].camera
    raw = next(iter(open_source(make.root / "V1", undistort=False))).right
    assert raw.camera.is_distorted and np.array_equal(raw.image, left_image(make, 0))


def test_euroc_inertial_samples_since_the_frame_before(make):
    folder = euroc(make)
    frames = list(open_source(folder))
    assert [len(frame.inertial) for frame in frames] == [0, 10, 10, 4]  # the stream ends before the last image
    samples = frames[1].inertial
    assert samples.gyro[:, 0].tolist() == list(range(1, 11)) and samples.gyro[0, 1:].tolist() == [0.2, 0.3]
    assert samples.accel[0].tolist() == [1, 2, 1]
    assert samples.timestamps[-1] == pytest.approx(frames[1].timestamp, abs=1e-6)
    # the inertial sensor lies at the body's origin: (-0.1, -0.2, -0.3) in axes turned by -90 degrees about z
    assert samples.T_camera_imu == pytest.approx([-0.2, 0.1, -0.3, 0, 0, -np.sqrt(0.5), np.sqrt(0.5)])
    assert [len(frame.inertial) for frame in open_source(folder, stride=2)] == [0, 20]
    broken = folder / "mav0/cam0/data/1403636580050000000.png"
    broken.write_bytes(b"")
    assert [len(frame.inertial) for frame in open_source(folder)] == [0, 20, 4]  # none is lost with an image
    times = make.text("t.txt", "0\n1\n2\n3\n")
    assert next(iter(open_source(folder, times=times))).inertial is None  # another clock


def test_euroc_files_of_other_sensors_matter_only_where_they_are_read(make):
    folder = euroc(make)
    make.text("V1/mav0/cam1/sensor.yaml", "T_BS: 3\n")
    make.text("V1/mav0/imu0/data.csv", "1,2,3\n")
    frames = list(open_source(folder))
    assert len(frames) == 4
    with pytest.raises(DvoError, match="T_BS"):
        _ = frames[0].right
    with pytest.raises(DvoError, match="line 1.*increasing times"):
        _ = frames[0].inertial
