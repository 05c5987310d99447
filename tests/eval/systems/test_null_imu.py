"""Dead reckoning: right with exact samples from a still start, and refused without samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.inertial import InertialSamples
from dvo.geometry.camera import Camera
from dvo.geometry.poses import compose_poses, invert_poses, pose_from, quaternion_to_matrix, so3_exp
from dvo.odometry.protocol import Status
from dvo.synth.sensors.imu import measure_imu
from eval.systems.registry import find_system

CAMERA = Camera(40.0, 40.0, 15.5, 11.5, 32, 24)
MOUNT = pose_from(so3_exp(np.array([0.3, -1.2, 0.5])), np.array([0.03, -0.05, 0.02]))
BIAS = np.array([0.02, -0.01, 0.03])


class Going:
    """A sensor that stands still for two seconds, then goes and turns."""

    def poses_wc(self, times: np.ndarray) -> np.ndarray:
        moved = np.clip(np.asarray(times) - 2.0, 0, None) ** 3
        position = np.stack([0.02 * moved, -0.01 * moved, 0.005 * moved], -1)
        return pose_from(so3_exp(0.01 * moved[:, None] * [1.0, 2.0, -1.0] + [1.0, 0.2, 0.3]), position)


def frames(mount: np.ndarray | None = MOUNT) -> list[Frame]:
    exact = measure_imu(Going(), np.arange(1201) / 200)
    samples = InertialSamples(exact.timestamps, exact.gyro + BIAS, exact.accel, mount)
    image, times = np.zeros((24, 32, 3), np.uint8), np.arange(120) / 20
    parts = [samples.between(before, now) for before, now in zip([np.inf, *times[:-1]], times, strict=True)]
    return [Frame(k, float(times[k]), image, CAMERA, inertial=parts[k]) for k in range(len(times))]


def test_it_follows_exact_samples_from_a_still_start() -> None:
    odometry = find_system("null-imu").build(0, "cpu")
    said = [odometry.track(frame) for frame in frames()]
    assert said[10].status == Status.INITIALISING and said[10].pose_wc is None
    result = odometry.finish()
    assert len(result.trajectory) == 120 - result.frames_lost and 18 < result.frames_lost < 24
    times = result.trajectory.timestamps
    np.testing.assert_allclose(said[-1].pose_wc, result.trajectory.poses_wc[-1])
    bodies = compose_poses(result.trajectory.poses_wc, np.broadcast_to(MOUNT, (len(times), 7)))
    turn = quaternion_to_matrix(Going().poses_wc(times)[:, 3:]) @ np.swapaxes(
        quaternion_to_matrix(bodies[:, 3:]), -1, -2
    )
    np.testing.assert_allclose(turn[:, 2, 2], 1, atol=1e-4)  # upright
    expected = (Going().poses_wc(times)[:, :3] - Going().poses_wc(times[:1])[:, :3]) @ turn[0]
    np.testing.assert_allclose(bodies[:, :3] - bodies[0, :3], expected, atol=0.03)
    assert np.linalg.norm(expected[-1]) > 1


def test_frames_without_samples_are_refused() -> None:
    one = frames()[0]
    with pytest.raises(DvoError, match="no inertial samples"):
        find_system("null-imu").build(0, "cpu").track(replace(one, inertial=None))
    with pytest.raises(DvoError, match="no pose of the inertial sensor"):
        find_system("null-imu").build(0, "cpu").track(frames(mount=None)[0])


def test_its_poses_are_those_of_the_camera() -> None:
    odometry = find_system("null-imu").build(0, "cpu")
    poses = [estimate.pose_wc for estimate in map(odometry.track, frames()[:30]) if estimate.pose_wc is not None]
    np.testing.assert_allclose(compose_poses(poses[-1], MOUNT)[:3], 0, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(poses[-1][:3]), np.linalg.norm(invert_poses(MOUNT)[:3]), atol=1e-3)
