"""Inertial measurements of a sensor on a continuous path.

Model (that of Kalibr, and of Forster et al., "On-manifold preintegration", 2017, eq. 27-28), in the frame of the path:

    gyro  = omega + bias_g + noise,    accel = R_wc^T (a_w - g_w) + bias_a + noise,

with white noise of density n (deviation ``n sqrt(rate)`` of a sample) and biases that follow random walks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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
    """Samples in the frame of the path (of a camera: x right, y down, z forward).

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
        path: sensor to world, in metres.
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
    none = np.zeros((len(times), 3))
    exact = Imu(times, omega, accel, none, none, np.asarray(gravity, float))
    return exact if noise is None else with_noise(exact, noise, seed)


def with_noise(exact: Imu, noise: ImuNoise, seed: int) -> Imu:
    """Samples with white noise and biases added.

    Args:
        exact: evenly spaced samples.
        noise: densities.
        seed: same seed, same noise.

    Returns:
        The samples, with the biases that they contain.
    """
    rng = np.random.default_rng([seed, salts.IMU])
    rate = 1 / np.diff(exact.timestamps).mean()
    biases = []
    for start, walk in ((noise.gyro_bias, noise.gyro_walk), (noise.accel_bias, noise.accel_walk)):
        wander = rng.normal(0, walk / np.sqrt(rate), exact.gyro.shape)
        wander[0] = rng.normal(0, start, 3)
        biases.append(np.cumsum(wander, 0))
    gyro = exact.gyro + biases[0] + rng.normal(0, noise.gyro * np.sqrt(rate), exact.gyro.shape)
    accel = exact.accel + biases[1] + rng.normal(0, noise.accel * np.sqrt(rate), exact.accel.shape)
    return replace(exact, gyro=gyro, accel=accel, gyro_bias=biases[0], accel_bias=biases[1])
