"""Preintegration of inertial samples on the rotation group, and dead reckoning with them.

Forster, Carlone, Dellaert, Scaramuzza, "On-manifold preintegration for real-time visual-inertial odometry" (IEEE
Transactions on Robotics, 2017). The body frame is that of the inertial sensor. Between samples, rates and specific
forces are linear: the rotation of a step is the mean rate with the coning term ``dt^2/12 w0 x w1``, and velocity and
position integrate the specific force, linear in the frame of the interval's start.

A compiled kernel goes step by step. Its twin computes all steps of all intervals at once: rotations by a scan,
velocities and positions by cumulative sums, covariance and bias Jacobians from the closed form of what an error in one
step does to the end of its interval.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.kernels import available
from dvo.data.inertial import ImuNoise, InertialSamples
from dvo.geometry.poses import skew, so3_exp

Array = np.ndarray
GAP = 2.5  # median intervals between samples; a longer time without one is a gap
CONTEXT = 2.0  # seconds of samples before and after the intervals that are looked at
MOST_STEPS = 20_000  # integrated at once, which bounds memory to some ten megabytes


@dataclass(frozen=True)
class Preintegration:
    """Motion of the body over ``K`` intervals, in the body frame at the start of each; all arrays are float64.

    Attributes:
        duration: ``(K,)`` seconds.
        rotation: ``(K, 3, 3)`` from the body at the end to the body at the start of the interval.
        velocity, position: ``(K, 3)`` m/s and m, without gravity and without the velocity at the start.
        covariance: ``(K, 9, 9)`` of (phi, velocity, position), where phi is on the right of ``rotation``. Infinite on
            the diagonal where the samples do not cover the interval (see :func:`preintegrate`).
        rotation_by_gyro, velocity_by_gyro, velocity_by_accel, position_by_gyro, position_by_accel: ``(K, 3, 3)``
            derivatives by the biases; that of the rotation is on its right.
        gyro_bias, accel_bias: ``(K, 3)`` subtracted from the samples, rad/s and m/s^2.
        longest: ``(K,)`` longest time without a sample in the interval, seconds.
        rates, forces: ``(K, 2, 3)`` rad/s and m/s^2 of the body at start and end, without the bias.
    """

    duration: Array
    rotation: Array
    velocity: Array
    position: Array
    covariance: Array
    rotation_by_gyro: Array
    velocity_by_gyro: Array
    velocity_by_accel: Array
    position_by_gyro: Array
    position_by_accel: Array
    gyro_bias: Array
    accel_bias: Array
    longest: Array
    rates: Array
    forces: Array

    def __len__(self) -> int:
        return len(self.duration)

    def where(self, keep: Array) -> Preintegration:
        """Intervals that are chosen by a mask ``(K,)``."""
        return Preintegration(**{name: value[keep] for name, value in vars(self).items()})

    @property
    def covered(self) -> Array:
        """``(K,)`` bool, intervals that the samples cover."""
        return np.isfinite(self.covariance[:, 0, 0])

    def corrected(self, gyro_bias: Array, accel_bias: Array) -> tuple[Array, Array, Array]:
        """Motion for other biases, to first order.

        Args:
            gyro_bias, accel_bias: ``(3,)`` or ``(K, 3)``, rad/s and m/s^2.

        Returns:
            Rotation ``(K, 3, 3)``, velocity ``(K, 3)`` and position ``(K, 3)``.
        """
        gyro, accel = (gyro_bias - self.gyro_bias)[..., None], (accel_bias - self.accel_bias)[..., None]
        rotation = self.rotation @ so3_exp((self.rotation_by_gyro @ gyro)[..., 0])
        velocity = self.velocity + (self.velocity_by_gyro @ gyro + self.velocity_by_accel @ accel)[..., 0]
        position = self.position + (self.position_by_gyro @ gyro + self.position_by_accel @ accel)[..., 0]
        return rotation, velocity, position


def preintegrate(
    samples: InertialSamples, times: Array, gyro_bias: Array, accel_bias: Array, noise: ImuNoise
) -> Preintegration:
    """Integrate samples over the intervals between consecutive times.

    Samples are interpolated linearly to the times. Over a time without samples longer than ``GAP`` median intervals
    the interpolated rate and force are uncertain by more than the noise of a sample: with ``D`` the root mean square
    change of a signal over the length of the gap, where there are samples (for a gap longer than half of them, that
    over half of them, in proportion to the length), the mean over a step inside of the gap has a standard deviation of
    ``D / 4``, that of the largest triangle on the chord whose slope is ``D`` over the gap. An interval that begins
    before the first or ends after the last sample by at most ``GAP`` median intervals holds that sample, as in a gap;
    one that reaches further, or that has fewer than two samples, has no motion, no Jacobians, and an infinite
    covariance.

    When a keyframe is dropped, call this again without its time.

    Args:
        samples: any that contain the intervals; those within ``CONTEXT`` of them also tell the rate, and how fast the
            signals change in a gap.
        times: ``(K + 1,)`` strictly increasing seconds on the clock of the samples.
        gyro_bias, accel_bias: ``(3,)`` or ``(K, 3)``, rad/s and m/s^2.
        noise: white noise of the samples. The bias walks are measurements of their own
            (:class:`dvo.ba.inertial_factor.BiasWalk`).

    Returns:
        ``K`` intervals. Noise is taken as independent between steps, and as white within a step, so that a single step
        does not tie position and velocity; an interval of a few samples then has a covariance some percent too large,
        since two neighbours share the sample at their border.

    Raises:
        DvoError: times or samples that do not increase, samples or biases that are not finite.
    """
    times = np.asarray(times, float)
    samples = _checked(samples, times)
    count = len(times) - 1
    biases = [np.broadcast_to(np.asarray(b, float), (count, 3)).copy() for b in (gyro_bias, accel_bias)]
    if not all(np.isfinite(b).all() for b in biases):
        raise DvoError("are not finite", field="gyro_bias, accel_bias", remedy="give biases in rad/s and m/s^2")
    if count == 0:
        scalar, vector, matrix, ends = (np.zeros((0, *shape)) for shape in ((), (3,), (3, 3), (2, 3)))
        own = scalar, matrix, vector, vector, np.zeros((0, 9, 9))
        return Preintegration(*own, *(matrix,) * 5, vector, vector, scalar, ends, ends)
    steps = np.diff(np.searchsorted(samples.timestamps, times)) + 1
    part = np.cumsum(steps) // MOST_STEPS
    cuts = [0, *(np.flatnonzero(np.diff(part)) + 1), count]
    parts = [
        _integrate(samples, times[a : b + 1], biases[0][a:b], biases[1][a:b], noise)
        for a, b in zip(cuts[:-1], cuts[1:], strict=True)
    ]
    if len(parts) == 1:
        return parts[0]
    return Preintegration(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Preintegration)))


def integrated_turn(samples: InertialSamples, times: Array, gyro_bias: Array) -> Array | None:
    """Rotation over one interval, as :func:`preintegrate` gives it, and nothing else.

    Args:
        samples, times, gyro_bias: see there; two times.

    Returns:
        ``(3, 3)``; None where samples do not cover the interval.
    """
    samples, stamps = _checked(samples, times), samples.timestamps
    reach = _reach(stamps)
    if len(stamps) < 2 or times[0] < stamps[0] - reach or times[1] > stamps[-1] + reach:
        return None
    found: Array = _Steps.between(samples, times, gyro_bias, np.zeros(3)).rotation[-1]
    return found


def propagate(
    rotation: Array,
    position: Array,
    velocity: Array,
    samples: InertialSamples,
    times: Array,
    gyro_bias: Array,
    accel_bias: Array,
    gravity: Array,
) -> tuple[Array, Array, Array]:
    """Dead reckoning from a known state.

    Args:
        rotation: ``(3, 3)`` body to world at ``times[0]``.
        position, velocity: ``(3,)`` of the body in the world at ``times[0]``, m and m/s.
        samples: that cover the times; the first or last sample is held beyond them.
        times: ``(N,)`` strictly increasing seconds on the clock of the samples.
        gyro_bias, accel_bias: ``(3,)`` rad/s and m/s^2.
        gravity: ``(3,)`` in the world, m/s^2, for example ``(0, 0, -9.81)``.

    Returns:
        Rotations ``(N, 3, 3)``, positions ``(N, 3)`` and velocities ``(N, 3)`` at the times.

    Raises:
        DvoError: see :func:`preintegrate`; no samples.
    """
    times = np.asarray(times, float)
    samples = _checked(samples, times)
    if len(samples) == 0:
        raise DvoError("there are none", field="samples", remedy="give samples that cover the times")
    steps = _Steps.between(samples, times, np.asarray(gyro_bias, float), np.asarray(accel_bias, float))
    at = steps.index
    since = (times - times[0])[:, None]
    moved = position + velocity * since + steps.position[at] @ rotation.T + 0.5 * gravity * since**2
    return rotation @ steps.rotation[at], moved, velocity + steps.velocity[at] @ rotation.T + gravity * since


def _checked(samples: InertialSamples, times: Array) -> InertialSamples:
    """The samples about the times."""
    if times.ndim != 1 or len(times) == 0 or not np.isfinite(times).all() or not (np.diff(times) > 0).all():
        raise DvoError("do not strictly increase", field="times", remedy="give one time of each frame, in order")
    if len(samples) and not (
        times[0] - CONTEXT <= samples.timestamps[0] and samples.timestamps[-1] <= times[-1] + CONTEXT
    ):
        near = samples.between(times[0] - CONTEXT, times[-1] + CONTEXT)
        samples = near if len(near) else samples
    if not (np.diff(samples.timestamps) > 0).all():
        raise DvoError("do not strictly increase", field="samples.timestamps", remedy="sort the samples")
    if not all(np.isfinite(x).all() for x in (samples.timestamps, samples.gyro, samples.accel)):
        raise DvoError("are not finite", field="samples", remedy="leave out samples without a value")
    return samples


@dataclass(frozen=True)
class _Steps:
    """The ``S`` steps between ``S + 1`` knots: the samples, and the times between them."""

    knots: Array  # (S + 1,)
    index: Array  # (K + 1,) knots that are the times
    dt: Array  # (S, 1)
    gyro: tuple[Array, Array]  # (S, 3) at both ends of a step
    accel: tuple[Array, Array]

    @staticmethod
    def between(samples: InertialSamples, times: Array, gyro_bias: Array, accel_bias: Array) -> _Steps:
        """Steps from the first to the last of the times, with biases ``(3,)`` or ``(K, 3)``."""
        stamps = samples.timestamps
        first, last = np.searchsorted(stamps, times[0], "right"), np.searchsorted(stamps, times[-1], "left")
        knots = np.union1d(stamps[first:last], times)
        index = np.searchsorted(knots, times)
        low, high = max(int(first) - 1, 0), int(last) + 1
        values = np.concatenate([samples.gyro[low:high], samples.accel[low:high]], 1)
        values = np.stack([np.interp(knots, stamps[low:high], column) for column in values.T], 1)
        bias = np.concatenate([gyro_bias, accel_bias], -1)
        if bias.ndim == 2:
            bias = np.repeat(bias, np.diff(index), 0)
        start, end = values[:-1] - bias, values[1:] - bias
        return _Steps(knots, index, np.diff(knots)[:, None], (start[:, :3], end[:, :3]), (start[:, 3:], end[:, 3:]))

    @cached_property
    def turn(self) -> Array:
        """``(S, 3)`` rotation vectors."""
        return (self.gyro[0] + self.gyro[1]) * (self.dt / 2) + np.cross(*self.gyro) * (self.dt**2 / 12)

    @cached_property
    def rotation(self) -> Array:
        """``(S + 1, 3, 3)`` to the first knot."""
        return _products(so3_exp(self.turn))

    @cached_property
    def forces(self) -> tuple[Array, Array]:
        """``(S, 3)`` at both ends of a step, in the frame of the first knot."""
        ends = (self.rotation[:-1], self.accel[0]), (self.rotation[1:], self.accel[1])
        first, second = ((r @ a[..., None])[..., 0] for r, a in ends)
        return first, second

    @cached_property
    def velocity(self) -> Array:
        """``(S + 1, 3)`` from the first knot, in its frame."""
        return np.concatenate([np.zeros((1, 3)), np.cumsum(sum(self.forces) * (self.dt / 2), 0)])

    @cached_property
    def position(self) -> Array:
        """``(S + 1, 3)`` likewise."""
        moved = self.velocity[:-1] * self.dt + (2 * self.forces[0] + self.forces[1]) * (self.dt**2 / 6)
        return np.concatenate([np.zeros((1, 3)), np.cumsum(moved, 0)])


def _products(rotations: Array) -> Array:
    """``(S + 1, 3, 3)``: identity, then the products of the first 1, 2, ... of ``S`` rotations, in log2 S passes."""
    out = np.concatenate([np.eye(3)[None], rotations])
    ahead = 1
    while ahead < len(rotations):
        out[1 + ahead :] = out[1:-ahead] @ out[1 + ahead :]
        ahead *= 2
    return out


def _integrate(
    samples: InertialSamples, times: Array, gyro_bias: Array, accel_bias: Array, noise: ImuNoise
) -> Preintegration:
    """:func:`preintegrate` of checked arguments."""
    if len(samples) == 0:
        samples = InertialSamples(times[:1], np.zeros((1, 3)), np.zeros((1, 3)))
    s = _Steps.between(samples, times, gyro_bias, accel_bias)
    variance, longest, covered = _uncertainty(samples, s, times, noise)
    rotation, velocity, position, covariance, by_bias = (_by_kernel if available() else _at_once)(s, variance)
    rates, forces = (np.stack([first[s.index[:-1]], second[s.index[1:] - 1]], 1) for first, second in (s.gyro, s.accel))
    if not covered.all():
        rotation[~covered], velocity[~covered], position[~covered], by_bias[~covered] = np.eye(3), 0, 0, 0
        covariance[~covered] = np.where(np.eye(9, dtype=bool), np.inf, 0)
    return Preintegration(
        np.diff(times), rotation, velocity, position, covariance,
        by_bias[:, :3, :3], by_bias[:, 3:6, :3], by_bias[:, 3:6, 3:], by_bias[:, 6:, :3], by_bias[:, 6:, 3:],
        gyro_bias, accel_bias, longest, rates, forces,
    )  # fmt: skip


def _by_kernel(s: _Steps, variance: Array) -> tuple[Array, ...]:
    from dvo.odometry.inertial.preintegration_kernels import integrate

    count = len(s.index) - 1
    out = tuple(np.empty((count, *shape)) for shape in ((3, 3), (3,), (3,), (9, 9), (9, 6)))
    given = (s.dt[:, 0], *s.gyro, *s.accel, variance)
    integrate(s.index, *(np.ascontiguousarray(x) for x in given), *out)
    return out


def _at_once(s: _Steps, variance: Array) -> tuple[Array, ...]:
    """Rotation, velocity, position, covariance and derivatives ``(K, 9, 6)`` by the biases, of all intervals."""
    start, end, count = s.index[:-1], s.index[1:], np.diff(s.index)
    last = np.repeat(end, count)  # of the interval of a step
    inverse = np.swapaxes(s.rotation[start], -1, -2)
    duration = (s.knots[end] - s.knots[start])[:, None]
    velocity = inverse @ (s.velocity[end] - s.velocity[start])[..., None]
    position = inverse @ (s.position[end] - s.position[start] - s.velocity[start] * duration)[..., None]
    effect = _effect(s, last)
    scaled = effect * np.sqrt(np.repeat(variance, 3, 1))[:, None]
    covariance = np.add.reduceat(scaled @ np.swapaxes(scaled, -1, -2), start, axis=0)
    turn = np.zeros((len(start), 9, 9))
    turn[:, :3, :3], turn[:, 3:6, 3:6], turn[:, 6:, 6:] = np.eye(3), inverse, inverse
    by_bias = -turn @ np.add.reduceat(effect, start, axis=0)  # a bias is subtracted
    covariance = turn @ covariance @ np.swapaxes(turn, -1, -2)
    within = np.add.reduceat(variance[:, 1] * s.dt[:, 0] ** 4 / 12, start)
    covariance[:, range(6, 9), range(6, 9)] += within[:, None]
    return inverse @ s.rotation[end], velocity[..., 0], position[..., 0], covariance, by_bias


def _effect(s: _Steps, last: Array) -> Array:
    """``(S, 9, 6)`` derivatives of (phi, v, p) at the end of the interval by mean rate and force of each step.

    phi is in the body frame at the end; v and p are in the frame of the first knot.
    """
    dt, here, after = s.dt[:, :, None], s.rotation[:-1], s.rotation[1:]
    k = skew(s.turn)
    angle2 = (s.turn**2).sum(-1)[:, None, None]
    small = angle2 < 1e-6
    safe = np.where(small, 1.0, angle2)
    sine = np.sinc(np.sqrt(angle2) / np.pi)
    bent = np.where(small, 1 / 6 - angle2 / 120, (1 - sine) / safe)
    right = np.eye(3) - 0.5 * np.sinc(np.sqrt(angle2) / (2 * np.pi)) ** 2 * k + bent * (k @ k)
    phi = right @ (dt * np.eye(3) + dt**2 / 12 * (skew(s.gyro[0]) - skew(s.gyro[1])))  # at the end of the step
    arm = after @ phi
    force = -after @ skew(s.accel[1]) @ phi
    left = (s.knots[last] - s.knots[1:])[:, None]
    further = s.velocity[last] - s.velocity[1:]
    out = np.zeros((len(dt), 9, 6))
    out[:, :3, :3] = np.swapaxes(s.rotation[last], -1, -2) @ arm
    velocity, by_force = dt / 2 * force, dt / 2 * (here + after)
    out[:, 3:6, :3] = velocity - skew(further) @ arm
    out[:, 3:6, 3:] = by_force
    away = s.position[last] - s.position[1:] - s.velocity[1:] * left
    out[:, 6:, :3] = dt**2 / 6 * force + velocity * left[..., None] - skew(away) @ arm
    out[:, 6:, 3:] = dt**2 / 6 * (2 * here + after) + by_force * left[..., None]
    return out


def _reach(stamps: Array) -> float:
    """Time without samples beyond which there is a gap, seconds."""
    return GAP * float(np.median(np.diff(stamps))) * (1 + 1e-9) if len(stamps) > 1 else 0.0


def _uncertainty(samples: InertialSamples, s: _Steps, times: Array, noise: ImuNoise) -> tuple[Array, Array, Array]:
    """Variance of the mean rate and force of each step ``(S, 2)``; of each interval the longest time without a sample,
    and whether it is covered."""
    stamps, variance = samples.timestamps, np.array([noise.gyro, noise.accel]) ** 2 / s.dt
    before, after, reach = times[:-1], times[1:], _reach(stamps)
    median = reach / GAP
    covered = (before >= stamps[0] - reach) & (after <= stamps[-1] + reach) & (len(stamps) > 1)
    middle = (s.knots[:-1] + s.knots[1:]) / 2
    bounds = np.concatenate([[-np.inf], stamps, [np.inf]])
    at = np.searchsorted(stamps, middle)
    low, high = bounds[at], bounds[at + 1]
    interval = np.repeat(np.arange(len(before)), np.diff(s.index))
    clipped = np.minimum(high, after[interval]) - np.maximum(low, before[interval])
    longest = np.maximum.reduceat(clipped, s.index[:-1])
    whole = high - low
    held = ~np.isfinite(whole)
    whole = np.where(held, 2 * s.dt[:, 0], whole)  # one of its ends is not known
    steps = np.flatnonzero((held | (whole > reach)) & covered[interval])
    if len(steps):
        lags = np.clip(np.rint(whole[steps] / median), 1, max(len(stamps) // 2, 1)).astype(int)
        longer = np.maximum(whole[steps] / (lags * median), 1.0)
        for lag in np.unique(lags):
            change = [np.mean((x[lag:] - x[:-lag]) ** 2) for x in (samples.gyro, samples.accel)]
            which = lags == lag
            variance[steps[which]] += np.multiply.outer(longer[which] ** 2, change) / 16
    return variance, longest, covered
