"""Null system with an inertial sensor: dead reckoning, images unread.

The first second of samples gives the vertical, from the mean specific force, and, if the sensor stands still in it,
the bias of the gyroscope and that of the accelerometer along the vertical. Afterwards rates and forces are integrated
from rest (Titterton and Weston, "Strapdown Inertial Navigation Technology", 2004, 3.5), so that errors grow to metres
within some seconds. The world is in metres, its z axis points up, and it begins at the sensor. Its rows count, so that
it has errors, although no image has given them.
"""

from __future__ import annotations

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.inertial import InertialSamples
from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import compose_poses, invert_poses, look_rotation, pose_from, so3_exp
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status

GRAVITY = 9.81
SETTLING = 1.0  # seconds of samples that give the vertical
STILL = 0.03, 0.3  # standard deviation of the rates (rad/s) and forces (m/s^2) of a sensor that stands still


class DeadReckoning:
    """See the module.

    Raises:
        DvoError: when tracking, frames without inertial samples, or without the pose of their sensor.
    """

    name = "null-imu"

    def __init__(self, seed: int = 0) -> None:
        self._frames = 0
        self._first: list[InertialSamples] = []
        self._rows: list[tuple[float, np.ndarray]] = []
        self._mount = np.array([0.0, 0, 0, 0, 0, 0, 1])
        self._size = (0, 0)
        self._time: float | None = None
        self._rotation, self._velocity, self._position = np.eye(3), np.zeros(3), np.zeros(3)
        self._gyro_bias, self._accel_bias = np.zeros(3), np.zeros(3)
        self._last = np.zeros(6)

    def track(self, frame: Frame) -> Estimate:
        self._frames += 1
        self._size = (frame.camera.width, frame.camera.height)
        samples = frame.inertial
        if samples is None or samples.T_camera_imu is None:
            lacking = "inertial samples" if samples is None else "pose of the inertial sensor"
            raise DvoError(f"no {lacking}", field=f"frame {frame.index}: inertial", remedy="choose another sequence")
        self._mount = samples.T_camera_imu
        if self._time is None:
            self._first.append(samples)
            times = np.concatenate([part.timestamps for part in self._first])
            if not len(times) or times[-1] - times[0] < SETTLING:
                return Estimate(frame.timestamp, None, Status.INITIALISING, reason="the vertical is measured")
            self._settle(times)
        else:
            self._integrate(samples)
        self._rows.append((frame.timestamp, self._pose(frame.timestamp)))
        return Estimate(frame.timestamp, self._rows[-1][1], Status.INERTIAL)

    def finish(self) -> Result:
        stamps = np.array([stamp for stamp, _ in self._rows])
        poses = np.array([pose for _, pose in self._rows]).reshape(-1, 7)
        info = {"working_size": list(self._size), "gyro_bias": self._gyro_bias.tolist()}
        return Result(Trajectory(stamps, poses), SparseMap(), self._frames, self._frames - len(stamps), info)

    def _settle(self, times: np.ndarray) -> None:
        """Vertical and biases from the first samples, through which the rates are integrated."""
        gyro, accel = (np.concatenate([getattr(part, name) for part in self._first]) for name in ("gyro", "accel"))
        is_still = gyro.std(axis=0).max() < STILL[0] and accel.std(axis=0).max() < STILL[1]
        if is_still:
            self._gyro_bias = gyro.mean(axis=0)
        turns = [np.eye(3)]
        for rate, step in zip(gyro[1:] - self._gyro_bias, np.diff(times), strict=True):
            turns.append(turns[-1] @ so3_exp(rate * step))
        force = np.mean([turn @ sample for turn, sample in zip(turns, accel, strict=True)], axis=0)
        upright = look_rotation(force, np.array([0.0, 1.0, 0.0])).T  # any heading
        self._rotation = upright @ turns[-1]
        if is_still:
            self._accel_bias = self._rotation.T @ [0, 0, np.linalg.norm(force) - GRAVITY]
        self._time, self._last = float(times[-1]), np.concatenate([gyro[-1], accel[-1]])

    def _integrate(self, samples: InertialSamples) -> None:
        for stamp, gyro, accel in zip(samples.timestamps, samples.gyro, samples.accel, strict=True):
            now = np.concatenate([gyro, accel])
            self._rotation, self._velocity, self._position = self._moved(stamp, (now + self._last) / 2)
            self._time, self._last = float(stamp), now

    def _moved(self, time: float, sample: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """State after a step with constant rate and force, the force taken half way through the turn."""
        assert self._time is not None
        step = time - self._time
        turn = (sample[:3] - self._gyro_bias) * step
        force = self._rotation @ so3_exp(turn / 2) @ (sample[3:] - self._accel_bias)
        acceleration = force - [0, 0, GRAVITY]
        position = self._position + self._velocity * step + acceleration * step**2 / 2
        return self._rotation @ so3_exp(turn), self._velocity + acceleration * step, position

    def _pose(self, time: float) -> np.ndarray:
        """Camera to world at the time of a frame, by the last sample."""
        rotation, _, position = self._moved(time, self._last)
        return compose_poses(pose_from(rotation, position), invert_poses(self._mount))
