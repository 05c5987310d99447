"""Inertial measurements of a sensor at the camera, from the continuous path.

Model (that of Kalibr, and of Forster et al., "On-manifold preintegration", 2017, eq. 27-28), in the camera frame:

    gyro  = omega + bias_g + noise,    accel = R_wc^T (a_w - g_w) + bias_a + noise,

with white noise of density n (deviation ``n sqrt(rate)`` of a sample) and biases that follow random walks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.inertial import ImuNoise
from dvo.geometry.poses import rotation_vector, split
from dvo.synth import salts
from dvo.synth.protocols import Motion

Array = np.ndarray
GRAVITY = np.array([0.0, 0.0, -9.81])  # world, m/s^2; z is up
STEP = 2e-4  # seconds on either side of a sample over which motion is differentiated


@dataclass(frozen=True)
class Imu:
    """Samples in the camera frame (x right, y down, z forward).

    Attributes:
        timestamps: ``(T,)`` seconds.
        gyro: ``(T, 3)`` rad/s.
        accel: ``(T, 3)`` m/s^2, specific force (at rest: -R^T g).
        gyro_bias, accel_bias: ``(T, 3)`` biases contained in them.
        gravity: ``(3,)`` in the world, m/s^2.
    """

    timestamps: Array
    gyro: Array
    accel: Array
    gyro_bias: Array
    accel_bias: Array
    gravity: Array


def measure_imu(
    path: Motion, times: Array, *, noise: ImuNoise | None = None, seed: int = 0, gravity: Array = GRAVITY
) -> Imu:
    """IMU samples along a path.

    Rates and accelerations are central differences over ``STEP`` of the path in float64 (rounding: about 1e-6 m/s^2 and
    1e-11 rad/s).

    Args:
        path: camera to world, in metres.
        times: ``(T,)`` evenly spaced, seconds.
        noise: None measures without noise and bias.
        seed: of the noise.
        gravity: ``(3,)`` in the world, m/s^2.

    Returns:
        The samples.

    Raises:
        DvoError: times that are not evenly spaced.
    """
    times = np.asarray(times, float)
    steps = np.diff(times)
    if times.ndim != 1 or len(times) < 2 or not (steps > 0).all() or np.ptp(steps) > 1e-6 * steps.mean():
        raise DvoError("need two evenly spaced times or more", field="times", remedy="give np.arange(...) / rate")
    (before, left), (now, here), (after, right) = (split(path.poses_wc(times + s * STEP)) for s in (-1, 0, 1))
    omega = rotation_vector(np.swapaxes(before, -1, -2) @ after) / (2 * STEP)
    # ``before^T after`` turns about an axis in the frame of ``before``; half way is the frame of ``now``.
    omega = (np.swapaxes(now, -1, -2) @ before @ omega[..., None])[..., 0]
    acceleration = ((right - here) - (here - left)) / STEP**2
    accel = (np.swapaxes(now, -1, -2) @ (acceleration - gravity)[..., None])[..., 0]
    biases = np.zeros((2, len(times), 3))
    if noise is not None:
        rng = np.random.default_rng([seed, salts.IMU])
        rate = 1 / steps.mean()
        for k, (start, walk) in enumerate(((noise.gyro_bias, noise.gyro_walk), (noise.accel_bias, noise.accel_walk))):
            wander = rng.normal(0, walk / np.sqrt(rate), (len(times), 3))
            wander[0] = rng.normal(0, start, 3)
            biases[k] = np.cumsum(wander, 0)
        omega = omega + biases[0] + rng.normal(0, noise.gyro * np.sqrt(rate), omega.shape)
        accel = accel + biases[1] + rng.normal(0, noise.accel * np.sqrt(rate), accel.shape)
    return Imu(times, omega, accel, biases[0], biases[1], np.asarray(gravity, float))
