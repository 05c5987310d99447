"""ORB-SLAM3 with right images and with depth: its settings, the images that it is given, and what it measures."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.frame import Frame, StereoView
from dvo.data.inertial import InertialSamples
from dvo.geometry.camera import Camera
from eval.systems.peers import orbslam3
from eval.systems.registry import find_system

ROOT = Path(__file__).resolve().parents[4]
CAMERA = Camera(60.0, 61.0, 31.5, 23.5, 64, 48)
BASIS = np.array([0.2, 0, 0, 0, 0, 0, 1])


def frame_with(right: StereoView | None = None, depth: np.ndarray | None = None) -> Frame:
    return Frame(7, 0.0, np.zeros((48, 64, 3), np.uint8), CAMERA, depth=depth, right=right)


def view(**changes) -> StereoView:
    return replace(StereoView(np.full((48, 64, 3), 90, np.uint8), CAMERA, BASIS), **changes)


@pytest.fixture
def fed(monkeypatch, tmp_path) -> list:
    """A stand-in for pyorbslam3; what it was made with and given."""
    given: list = []

    class Slam:
        def __init__(self, vocabulary, file, sensor, use_viewer):
            given.append((sensor, Path(file).read_text()))

        def __getattr__(self, name):
            if not name.startswith("track_"):
                raise AttributeError(name)
            return lambda *images_and_stamp, **others: self.keep(name, *images_and_stamp, *others.values())

        def keep(self, name, *images_and_stamp):
            given.append((name, *images_and_stamp))
            state = "RECENTLY_LOST" if (images_and_stamp[0] > 250).all() else "OK"
            return SimpleNamespace(state=state, pose_valid=True, pose_wc=np.eye(4))

        def map_changed(self):
            return False

        def imu_initialized(self):
            return True

        def save_keyframe_trajectory_tum(self, file):
            pass

        def shutdown(self):
            pass

    names = ("NO_IMAGES_YET", "NOT_INITIALIZED", "RECENTLY_LOST", "LOST", "OK", "OK_KLT")
    states = SimpleNamespace(**{name: name for name in names})
    kinds = SimpleNamespace(
        MONOCULAR="one", STEREO="pair", RGBD="depth", IMU_MONOCULAR="one and imu", IMU_STEREO="pair and imu"
    )
    monkeypatch.setitem(sys.modules, "pyorbslam3", SimpleNamespace(Slam=Slam, Sensor=kinds, TrackingState=states))
    (tmp_path / "words.txt").write_text("10 6 0 0\n")
    monkeypatch.setenv(orbslam3.VOCABULARY, str(tmp_path / "words.txt"))
    return given


def test_settings_of_a_pair(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_text(orbslam3.settings(CAMERA, baseline=0.2))
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    pose = storage.getNode("Stereo.T_c1_c2").mat()
    np.testing.assert_allclose(pose, [[1, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-7)
    assert storage.getNode("Stereo.b").real() == 0.2 and storage.getNode("RGBD.DepthMapFactor").real() == 1
    for name in ("fx", "fy", "cx", "cy"):
        assert storage.getNode(f"Camera2.{name}").real() == getattr(CAMERA, name)
    assert "Stereo" not in orbslam3.settings(CAMERA) and "Camera2" not in orbslam3.settings(CAMERA)


def test_it_is_given_the_right_image(fed):
    find_system("orbslam3+sensor=stereo").build(0, "cpu").track(frame_with(view()))
    (sensor, settings), (call, left, right, stamp) = fed
    assert sensor == "pair" and "Stereo.b: 0.2" in settings
    assert call == "track_stereo" and left.shape == right.shape == (96, 128) and stamp == 0
    assert (left == 0).all() and (right == 90).all()


def test_it_is_given_depth_in_metres_and_0_where_it_is_unknown(fed):
    depth = np.full((48, 64), 2.5, np.float32)
    depth[0, 0] = np.nan
    find_system("orbslam3+sensor=rgbd").build(0, "cpu").track(frame_with(depth=depth))
    (sensor, _), (call, image, seen, _) = fed
    assert sensor == "depth" and call == "track_rgbd" and seen.shape == image.shape and seen.dtype == np.float32
    assert (seen[:2, :2] == 0).all() and (seen[2:] == 2.5).all()


SAMPLES = InertialSamples(
    np.array([0.01, 0.02]),
    np.full((2, 3), 0.1),
    np.full((2, 3), 9.0),
    np.array([0.1, 0, 0, 0, 0, *np.sqrt([0.5, 0.5])]),
)


@pytest.mark.parametrize(
    ("sensor", "kind", "images"), [("imu_monocular", "one and imu", 1), ("imu_stereo", "pair and imu", 2)]
)
def test_it_is_given_inertial_samples(fed, tmp_path, sensor, kind, images):
    frame = replace(frame_with(view()), inertial=SAMPLES)
    find_system(f"orbslam3+sensor={sensor}").build(0, "cpu").track(frame)
    (made, settings), (call, *given) = fed
    assert made == kind and call == f"track_{sensor.removeprefix('imu_')}" and len(given) == images + 2
    np.testing.assert_array_equal(given[-1], np.column_stack([SAMPLES.timestamps, SAMPLES.gyro, SAMPLES.accel]))
    (tmp_path / "settings.yaml").write_text(settings)
    storage = cv2.FileStorage(str(tmp_path / "settings.yaml"), cv2.FILE_STORAGE_READ)
    # The sensor stands 0.1 m to the right of the camera and is turned a quarter about its axis.
    expected = [[0, 1, 0, 0], [-1, 0, 0, 0.1], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(storage.getNode("IMU.T_b_c1").mat(), expected, atol=1e-6)
    assert storage.getNode("IMU.NoiseGyro").real() == pytest.approx(1.7e-3), "that of a phone, as none is stated"
    assert ("Stereo.b: 0.2" in settings) == (images == 2)


@pytest.mark.parametrize(("sensor", "poses"), [("imu_monocular", 2), ("monocular", 1)])
def test_poses_from_samples_alone_are_marked(fed, sensor, poses):
    odometry = find_system(f"orbslam3+sensor={sensor}+pace=100").build(0, "cpu")
    white = np.full((48, 64, 3), 255, np.uint8)
    seen = odometry.track(replace(frame_with(), inertial=SAMPLES))
    blind = odometry.track(replace(frame_with(), timestamp=0.1, image=white, inertial=SAMPLES))
    assert seen.status == "tracking" and blind.status == ("inertial" if poses == 2 else "lost")
    assert seen.scale_state == ("aligned" if poses == 2 else "none")
    result = odometry.finish()
    assert len(result.trajectory) == poses and result.frames_tracked == 1


def test_frames_without_inertial_samples_are_refused(fed):
    for samples in (None, replace(SAMPLES, T_camera_imu=None)):
        with pytest.raises(DvoError, match="frame 7: inertial, with the pose of the sensor: not there"):
            find_system("orbslam3+sensor=imu_monocular").build(0, "cpu").track(replace(frame_with(), inertial=samples))


def test_without_a_sensor_it_reads_neither(fed):
    find_system("orbslam3").build(0, "cpu").track(frame_with(view(), np.ones((48, 64), np.float32)))
    assert fed[0][0] == "one" and "Stereo" not in fed[0][1] and fed[1][0] == "track_monocular" and len(fed[1]) == 3


@pytest.mark.parametrize(
    ("sensor", "frame", "message"),
    [
        ("stereo", frame_with(), "frame 7: right: not there"),
        ("rgbd", frame_with(view()), "frame 7: depth: not there"),
        ("stereo", frame_with(view(T_left_right=np.array([-0.2, 0, 0, 0, 0, 0, 1]))), "not a rectified"),
        ("stereo", frame_with(view(T_left_right=np.array([0.2, 0.01, 0, 0, 0, 0, 1]))), "not a rectified"),
        ("stereo", frame_with(view(camera=replace(CAMERA, cx=30.0))), "not a rectified"),
    ],
)
def test_frames_of_another_sensor_are_refused(fed, sensor, frame, message):
    with pytest.raises(DvoError, match=message):
        find_system(f"orbslam3+sensor={sensor}").build(0, "cpu").track(frame)


def test_an_unknown_sensor_is_refused(fed):
    with pytest.raises(DvoError, match="sensor: no such sensor: sonar"):
        find_system("orbslam3+sensor=sonar").build(0, "cpu")


@pytest.mark.slow
@pytest.mark.parametrize(("suite", "sensor"), [("rgbd", "rgbd"), ("stereo", "stereo")])
def test_it_is_in_metres(suite, sensor, tmp_path):
    system = f"orbslam3+sensor={sensor}"
    reason = find_system(system).missing()
    if reason is not None:
        pytest.skip(reason)
    command = [sys.executable, "-m", "eval", "run", "--suite", suite, "--sequences", f"{suite}_handheld"]
    command += ["--systems", system, "--out", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True, capture_output=True)
    with (tmp_path / "results.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["status"] == "ok" and float(row["completeness"]) > 0.9
    assert float(row["scale_error"]) < 4 and float(row["ate_percent"]) < 1.5
