"""Motion of a hand that holds a camera and an inertial sensor, without a scene: orientations and samples of both."""

from __future__ import annotations

import numpy as np

from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry.poses import pose_from, so3_exp, split
from dvo.synth import measure_imu
from dvo.synth.motion.motion import Path

CAMERA_IMU = so3_exp(np.array([0.4, -1.9, 0.8]))
"""``(3, 3)`` rotation of the sensor in the camera."""
T_CAMERA_IMU = pose_from(CAMERA_IMU, np.zeros(3))


def hand_motion(seed: int, swing: tuple[float, float, float] = (0.25, 0.3, 0.2)) -> Path:
    """Sum of thirty waves from 0.1 to 4 Hz with random phases, whose spectrum of velocities falls as ``1/f``.

    Args:
        seed: of the phases.
        swing: deviation of the rotation about x, y and z, rad.
    """
    rng = np.random.default_rng(seed)
    frequency = 2 * np.pi * 0.1 * 40 ** rng.uniform(0, 1, 30)
    fall = frequency**-1.5 / np.sqrt((frequency**-3.0).sum())
    shake = rng.normal(0, 1, (30, 2, 6)) * fall[:, None, None] * np.array([0.1, 0.1, 0.1, *swing])
    return Path("hand", so3_exp(np.array([-1.5, 0.0, 0.0])), np.zeros(3), np.zeros(6), frequency, shake, 1.0)


def frames(
    path: Path, seconds: float, *, rate: float = 30.0, noise: float = 0.05, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Times ``(N,)`` of frames and orientations ``(N, 3, 3)`` camera to world, with noise in degrees."""
    times = np.arange(round(seconds * rate)) / rate
    errors = np.random.default_rng(seed).normal(0, np.radians(noise), (len(times), 3))
    return times, split(path.poses_wc(times))[0] @ so3_exp(errors)


def samples(
    path: Path, seconds: float, *, rate: float = 200.0, noise: ImuNoise | None = None, seed: int = 0
) -> InertialSamples:
    """Samples in the axes of the sensor, from half a second before the first frame to half a second after the last."""
    imu = measure_imu(path, np.arange(round((seconds + 1) * rate)) / rate - 0.5, noise=noise, seed=seed)
    return InertialSamples(imu.timestamps, imu.gyro @ CAMERA_IMU, imu.accel @ CAMERA_IMU, T_CAMERA_IMU, noise)
