"""Inertial samples in a buffer, and the motion between two times by them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.data.inertial import ImuNoise, InertialSamples

GRAVITY = np.array([0.0, 0.0, -9.81])  # world, m/s^2; z is up
LONGEST_STEP = 0.05  # seconds between two samples, above which motion between them is not known
UNKNOWN = np.array([1.0, 5.0])  # rad/s and m/s^2 over such a step, standard deviations


@dataclass(frozen=True)
class Motion:
    """State of the inertial sensor (body).

    Attributes:
        R: ``(3, 3)`` body to world.
        p: ``(3,)`` position in the world, metres.
        v: ``(3,)`` velocity in the world, m/s.
    """

    R: np.ndarray
    p: np.ndarray
    v: np.ndarray

    @classmethod
    def at_rest(cls) -> Motion:
        """At the origin of the world, with its axes."""
        return cls(np.eye(3), np.zeros(3), np.zeros(3))


@dataclass(frozen=True)
class Stretch:
    """Samples from one time to another, both ends interpolated.

    Attributes:
        times: ``(K,)`` seconds, from the first time to the second.
        gyro, accel: ``(K, 3)`` rad/s, m/s^2.
    """

    times: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray


def propagate(
    stretch: Stretch,
    motion: Motion,
    bias: np.ndarray,
    noise: ImuNoise,
    *,
    first: Motion | None = None,
    gravity: np.ndarray = GRAVITY,
) -> tuple[Motion, np.ndarray, np.ndarray]:
    """Integrate samples; between two of them the mean of both acts.

    The error is ``[p, theta, v, gyro bias, accel bias]``, 3 each: ``p, v`` and biases are added, ``theta`` is a right
    tangent (``R exp(theta)``). From the identity without gravity the result is a preintegrated measurement with its
    bias Jacobians and covariance (Forster et al. 2017).

    Args:
        stretch: samples.
        motion: state at its first time.
        bias: ``(6,)`` of gyroscope and accelerometer.
        noise: of the samples.
        first: state at its first time as it was first predicted, at which the transition is linearised (first-estimate
            Jacobians; Li & Mourikis 2013, eq. 36-38); None for ``motion``.
        gravity: ``(3,)`` in the world.

    Returns:
        State at the last time, transition ``(15, 15)`` of the error and covariance ``(15, 15)`` of the noise.
    """
    from dvo.odometry.classical.msckf import motion_kernels

    first = first or motion
    R, p, v = motion.R.copy(), motion.p.copy(), motion.v.copy()
    densities = np.array([noise.gyro, noise.gyro_walk, noise.accel, noise.accel_walk], float)
    # The kernel is compiled anew for each layout of its arguments.
    R0, p0, v0, bg, ba = (np.ascontiguousarray(x) for x in (first.R, first.p, first.v, bias[:3], bias[3:]))
    transition, covariance = motion_kernels.propagate(
        stretch.times, stretch.gyro, stretch.accel, R, p, v, R0, p0, v0, bg, ba, gravity, densities, LONGEST_STEP,
        UNKNOWN,
    )  # fmt: skip
    u, _, vt = np.linalg.svd(R)
    return Motion(u @ vt, p, v), transition, covariance


def rotation_vector(R: np.ndarray) -> np.ndarray:
    """Logarithm ``(3,)`` of a rotation ``(3, 3)`` by less than pi, rad."""
    twist = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.linalg.norm(twist))
    angle = np.arctan2(sine, 0.5 * (np.trace(R) - 1))
    return twist * (angle / sine if sine > 1e-9 else 1.0)


class SampleBuffer:
    """Samples in order of time; old ones are forgotten."""

    def __init__(self) -> None:
        self._times, self._gyro, self._accel = np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))

    def __len__(self) -> int:
        return len(self._times)

    @property
    def start(self) -> float:
        """Time of the first sample, infinite without one."""
        return float(self._times[0]) if len(self) else np.inf

    @property
    def end(self) -> float:
        """Time of the last sample, minus infinity without one."""
        return float(self._times[-1]) if len(self) else -np.inf

    def add(self, samples: InertialSamples) -> None:
        """Append the samples that are later than all before."""
        new = samples.timestamps > self.end
        self._times = np.concatenate([self._times, samples.timestamps[new]])
        self._gyro = np.concatenate([self._gyro, samples.gyro[new]])
        self._accel = np.concatenate([self._accel, samples.accel[new]])

    def forget(self, before: float) -> None:
        """Drop the samples before a time, except for the last of them."""
        keep = max(int(np.searchsorted(self._times, before)) - 1, 0)
        self._times, self._gyro, self._accel = self._times[keep:], self._gyro[keep:], self._accel[keep:]

    def between(self, start: float, end: float) -> Stretch:
        """Samples of an interval; the first and the last one of the buffer hold before and after it."""
        inside = (self._times > start) & (self._times < end)
        times = np.concatenate([[start], self._times[inside], [end]])
        gyro, accel = (
            np.stack([np.interp(times, self._times, values[:, k]) for k in range(3)], 1)
            for values in (self._gyro, self._accel)
        )
        return Stretch(times, gyro, accel)

    def rate(self, time: float) -> np.ndarray:
        """Angular rate ``(3,)`` at a time, interpolated, rad/s."""
        return np.array([np.interp(time, self._times, self._gyro[:, k]) for k in range(3)])
