"""Starts of the filter: from a stretch without motion, or from the motion of the first seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dvo.data.inertial import ImuNoise
from dvo.geometry.poses import skew, so3_exp
from dvo.odometry.classical.msckf.features import Clones, Layout, Views, linearise, triangulate
from dvo.odometry.classical.msckf.filter import EXTRINSICS, FIXED, OFFSET
from dvo.odometry.classical.msckf.motion import GRAVITY, Motion, SampleBuffer, Stretch, propagate, rotation_vector
from dvo.odometry.classical.two_view import relative_pose

G = float(np.linalg.norm(GRAVITY))
HELD = 1e-6  # standard deviation of what is held fixed: position and heading of the start
REST_SPEED = 0.01  # m/s, of a body that stands still, standard deviation
REST_ACCEL = 0.01  # m/s^2, of the mean specific force meanwhile
CAUTION = 2.0  # factor on the covariance of a start from motion, whose equations are far from linear
GN_STEPS = 12
RELINEARISE = 3  # times that the samples are integrated again with better biases and time offset
MISFIT = 0.35  # mean cost of a residual over that of an outlier, from which a start is none
OUTLIER = 3.0  # root mean square residual of a point over the noise, from which it counts little


@dataclass(frozen=True)
class Observed:
    """Tracks in one image.

    Attributes:
        time: of the image, seconds.
        ids: ``(N,)`` of the tracks, increasing.
        xy: ``(N, 2)`` on the plane z = 1.
        delay: ``(N,)`` seconds from ``time`` to that of the pixel's row.
    """

    time: float
    ids: np.ndarray
    xy: np.ndarray
    delay: np.ndarray


@dataclass(frozen=True)
class Device:
    """Camera and inertial sensor.

    Attributes:
        R_bc, p_bc: camera in the body.
        noise: of the samples.
        gate, sigma: of an observation on the plane z = 1, for finding outliers and for updates.
        offset_sigma, position_sigma, rotation_sigma: see :class:`MsckfConfig`.
    """

    R_bc: np.ndarray
    p_bc: np.ndarray
    noise: ImuNoise
    gate: float
    sigma: float
    offset_sigma: float
    position_sigma: float
    rotation_sigma: float


@dataclass(frozen=True)
class Start:
    """State at the start.

    Attributes:
        time: on the clock of the samples, seconds.
        motion, bias, offset: see :class:`dvo.odometry.classical.msckf.filter.Filter`.
        P: ``(22, 22)`` covariance of the error; the position and the heading of the start are those of the world.
        history: times and states before it.
        rested: the sensor has stood still since the first of them.
    """

    time: float
    motion: Motion
    bias: np.ndarray
    offset: float
    P: np.ndarray
    history: tuple[tuple[float, Motion], ...] = ()
    rested: bool = False


def _prior(device: Device) -> np.ndarray:
    """Covariance ``(22, 22)`` before anything is measured; pose and velocity held fixed."""
    noise, sigma = device.noise, np.full(FIXED, HELD)
    sigma[9:12], sigma[12:15], sigma[OFFSET] = noise.gyro_bias, noise.accel_bias, device.offset_sigma
    sigma[EXTRINSICS : EXTRINSICS + 3], sigma[EXTRINSICS + 3 : FIXED] = device.position_sigma, device.rotation_sigma
    return np.diag(np.maximum(sigma, 1e-9) ** 2)


def start_from_rest(stretch: Stretch, device: Device) -> Start:
    """Gravity and bias of the gyroscope from the means over a stretch without motion.

    Args:
        stretch: its samples.
        device: camera and inertial sensor.

    Returns:
        State at the end of the stretch.
    """
    weights = np.gradient(stretch.times)
    gyro, accel = ((values * weights[:, None]).sum(0) / weights.sum() for values in (stretch.gyro, stretch.accel))
    span = stretch.times[-1] - stretch.times[0]
    R = _level(accel)
    force = R.T @ -GRAVITY
    P = _prior(device)
    P[3:6, 3:6] = R.T @ np.diag([1.0, 1.0, HELD**2]) @ R
    P[6:9, 6:9] = REST_SPEED**2 * np.eye(3)
    H = np.zeros((6, FIXED))
    H[:3, 9:12] = np.eye(3)
    H[3:, 3:6], H[3:, 12:15] = skew(force), np.eye(3)
    n = device.noise
    variance = np.repeat([n.gyro**2 / span, n.accel**2 / span + REST_ACCEL**2], 3)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(variance))
    change = gain @ np.concatenate([gyro, accel - force])
    P = (np.eye(FIXED) - gain @ H) @ P
    still = Motion(R @ so3_exp(change[3:6]), np.zeros(3), np.zeros(3))
    return Start(
        float(stretch.times[-1]), still, change[9:15], 0.0, 0.5 * (P + P.T), ((float(stretch.times[0]), still),), True
    )


def _level(force: np.ndarray) -> np.ndarray:
    """Rotation ``(3, 3)`` that turns a direction upward, by the shortest way."""
    a = force / np.linalg.norm(force)
    axis, cosine = np.cross(a, [0.0, 0.0, 1.0]), a[2]
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    return np.eye(3) + skew(axis) + skew(axis) @ skew(axis) / (1 + cosine)


@dataclass
class _Window:
    """Unknowns of a start from motion: states at K images, constant biases, time offset."""

    R: np.ndarray
    p: np.ndarray
    v: np.ndarray
    bias: np.ndarray
    shift: float  # of the images against the times of the states

    def moved(self, change: np.ndarray) -> _Window:
        by = change[:-7].reshape(-1, 9)
        return _Window(
            self.R @ so3_exp(by[:, 3:6]), self.p + by[:, :3], self.v + by[:, 6:], self.bias + change[-7:-1],
            self.shift + float(change[-1]),
        )  # fmt: skip


def start_from_motion(
    frames: Sequence[Observed], samples: SampleBuffer, device: Device, *, most: float, seed: int
) -> Start | str:
    """Velocity, gravity and biases from images and samples of some seconds.

    The bias of the gyroscope comes from rotations between images (Qin et al. 2018, eq. 15), velocity and gravity from a
    linear system with known rotations (Dong-Si & Mourikis 2012), then all states from a least-squares adjustment whose
    information gives the covariance.

    Args:
        frames: tracks in images that follow each other.
        samples: that cover them.
        device: camera and inertial sensor.
        most: largest relative standard deviation of the distance moved.
        seed: of the essential matrices.

    Returns:
        State at the last image, or why there is none.
    """
    views, _ = gather(frames, fewest=4)
    if views.count < 15:
        return "too few tracks"
    offset, bias = 0.0, np.zeros(6)
    times = np.array([frame.time for frame in frames])
    bias[:3] = _gyro_bias(frames, samples, device, seed)
    window = _linear_solution(times, views, samples, device, bias)
    if window is None:
        return "too little motion"
    solved = None
    for _ in range(RELINEARISE):
        solved = _adjust(times + offset, views, samples, device, window)
        if solved is None:
            return "no solution"
        window = solved.window
        offset += window.shift
        # The states are moved to the new times of the images.
        R, p, v = (values.copy() for values in (window.R, window.p, window.v))
        for k, time in enumerate(times + offset):
            rate = samples.rate(time) - window.bias[:3]
            R[k], p[k] = R[k] @ so3_exp(rate * window.shift), p[k] + v[k] * window.shift
        window = _Window(R, p, v, window.bias, 0.0)
    assert solved is not None
    return _checked(times + offset, offset, window, solved, device, most)


def gather(frames: Sequence[Observed], fewest: int) -> tuple[Views, np.ndarray]:
    """Observations by track: of those with ``fewest`` or more, in order of their ids, which are returned too."""
    ids = np.concatenate([frame.ids for frame in frames])
    clone = np.repeat(np.arange(len(frames)), [len(frame.ids) for frame in frames])
    xy = np.concatenate([frame.xy for frame in frames])
    delay = np.concatenate([frame.delay for frame in frames])
    order = np.lexsort((clone, ids))
    _, which, counts = np.unique(ids[order], return_inverse=True, return_counts=True)
    order = order[counts[which] >= fewest]
    kept, point = np.unique(ids[order], return_inverse=True)
    return Views(point, clone[order], xy[order], delay[order]), kept


def _gyro_bias(frames: Sequence[Observed], samples: SampleBuffer, device: Device, seed: int) -> np.ndarray:
    """Median of the biases that make the rotations of pairs of images equal to those of the gyroscope."""
    found = []
    step = max(1, min(4, len(frames) // 3))
    intrinsics = np.array([1 / device.sigma, 1 / device.sigma, 0, 0])  # an observation is known to one unit
    for first, second in zip(frames[:-step], frames[step:], strict=True):
        _, one, two = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
        if len(one) < 20:
            continue
        pair = relative_pose(first.xy[one] / device.sigma, second.xy[two] / device.sigma, intrinsics, 2.0, seed % 2**31)
        if pair is None:
            continue
        seen = device.R_bc @ pair.T_21[:3, :3].T @ device.R_bc.T
        motion, J, _ = propagate(
            samples.between(first.time, second.time), Motion.at_rest(), np.zeros(6), device.noise, gravity=np.zeros(3)
        )
        found.append(np.linalg.solve(J[3:6, 9:12], rotation_vector(motion.R.T @ seen)))
    bias = np.median(found, axis=0) if len(found) > 2 else np.zeros(3)
    return np.clip(bias, -3 * device.noise.gyro_bias, 3 * device.noise.gyro_bias)


def _preintegrated(
    times: np.ndarray, samples: SampleBuffer, bias: np.ndarray, noise: ImuNoise
) -> list[tuple[Motion, np.ndarray, np.ndarray]]:
    return [
        propagate(samples.between(a, b), Motion.at_rest(), bias, noise, gravity=np.zeros(3))
        for a, b in zip(times[:-1], times[1:], strict=True)
    ]


def _linear_solution(
    times: np.ndarray, views: Views, samples: SampleBuffer, device: Device, bias: np.ndarray
) -> _Window | None:
    """States by the linear system for velocity and gravity, with z up."""
    count = len(times)
    R, alpha, beta = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros((count, 3))
    for k, (step, _, _) in enumerate(_preintegrated(times, samples, bias, device.noise)):
        dt = times[k + 1] - times[k]
        alpha[k + 1] = alpha[k] + beta[k] * dt + R[k] @ step.p
        beta[k + 1] = beta[k] + R[k] @ step.v
        R[k + 1] = R[k] @ step.R
    t = (times - times[0])[views.clone]
    centre = alpha[views.clone] + R[views.clone] @ device.p_bc
    rays = R[views.clone] @ device.R_bc @ np.column_stack([views.xy, np.ones(len(t))])[..., None]
    rays = rays[..., 0] / np.linalg.norm(rays[..., 0], axis=1, keepdims=True)
    A = np.concatenate([t[:, None, None] * np.eye(3), 0.5 * t[:, None, None] ** 2 * np.eye(3)], 2)
    up = beta[-1] / np.linalg.norm(beta[-1])
    weight = np.ones(len(t))
    best: np.ndarray | None = None
    for _ in range(3):
        W = weight[:, None, None] * (np.eye(3) - rays[:, :, None] * rays[:, None, :])
        sums = np.zeros((views.count, 3, 10))  # of W, W A, W e
        np.add.at(sums, views.point, np.concatenate([W, W @ A, W @ centre[..., None]], 2))
        spread = np.linalg.eigvalsh(sums[:, :, :3])
        good = spread[:, 0] > 1e-7 * spread[:, 2]
        inverse = np.linalg.inv(sums[good, :, :3])
        rows = good[views.point]
        At = np.swapaxes(A[rows], 1, 2) @ W[rows]
        N = (At @ A[rows]).sum(0)
        b = -(At @ centre[rows][..., None]).sum(0)[:, 0]
        cross = np.swapaxes(sums[good, :, 3:9], 1, 2) @ inverse
        N -= (cross @ sums[good, :, 3:9]).sum(0)
        b += (cross @ sums[good, :, 9:]).sum(0)[:, 0]
        free = np.linalg.lstsq(N, b, rcond=1e-10)[0]
        starts = [-up] + ([free[3:] / np.linalg.norm(free[3:])] if np.linalg.norm(free[3:]) > 1e-3 else [])
        tried = [_with_gravity(N, b, start) for start in starts]
        best = min(tried, key=lambda y: y @ N @ y - 2 * b @ y)
        if not np.isfinite(best).all():
            return None
        points = (inverse @ (sums[good, :, 9:] + sums[good, :, 3:9] @ best[:, None]))[..., 0]
        where = np.full((views.count, 3), np.nan)
        where[good] = points
        distance = np.linalg.norm(where[views.point] - centre - (A @ best[:, None])[..., 0], axis=1)
        weight = 1 / np.clip(np.nan_to_num(distance, nan=1e3), 0.2, 1e3) ** 2
    assert best is not None
    v0, g = best[:3], best[3:]
    s = times - times[0]
    world = _level(-g)
    return _Window(
        world @ R, (v0 * s[:, None] + 0.5 * g * s[:, None] ** 2 + alpha) @ world.T,
        (v0 + g * s[:, None] + beta) @ world.T, bias, 0.0,
    )  # fmt: skip


def _with_gravity(N: np.ndarray, b: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Minimum of ``y N y - 2 b y`` for velocity and gravity, the latter of known length, by Gauss-Newton."""
    y = np.concatenate([np.zeros(3), G * down])
    for _ in range(6):
        M = np.zeros((6, 5))
        M[:3, :3] = np.eye(3)
        M[3:, 3:] = np.linalg.svd(y[None, 3:])[2][1:].T
        step = np.linalg.lstsq(M.T @ N @ M, M.T @ (b - N @ y), rcond=1e-12)[0]
        y = y + M @ step
        y[3:] *= G / np.linalg.norm(y[3:])
    return y


@dataclass(frozen=True)
class _Solved:
    """Solution of the adjustment: states, information about their error and cost per degree of freedom."""

    window: _Window
    information: np.ndarray
    misfit: float


def _adjust(times: np.ndarray, views: Views, samples: SampleBuffer, device: Device, window: _Window) -> _Solved | None:
    """Levenberg-Marquardt over all states; the points are eliminated by their null space."""
    damping = 1e-4
    parts = _preintegrated(times, samples, window.bias, device.noise)
    base = window.bias
    rates = np.stack([samples.rate(time) for time in times])
    now = _normal_equations(window, times, views, parts, base, rates, device)
    for _ in range(GN_STEPS):
        H, b = now[0].copy(), now[1]
        H[np.diag_indices(len(H))] += damping * np.maximum(np.diag(H), 1e-6)
        H[np.diag_indices(3)] += 1e6  # the first position is held
        try:
            change = np.linalg.solve(H, b)
        except np.linalg.LinAlgError:
            return None
        trial = window.moved(change)
        after = _normal_equations(trial, times, views, parts, base, rates, device)
        if after[2] < now[2]:
            gain = now[2] - after[2]
            window, now, damping = trial, after, damping * 0.2
            if gain < 1e-3 * now[2]:
                break
        else:
            damping *= 10
            if damping > 1e4:
                break
    if not np.isfinite(now[2]):
        return None
    return _Solved(window, now[0], now[2] / max(now[3], 1))


def _normal_equations(
    window: _Window,
    times: np.ndarray,
    views: Views,
    parts: list[tuple[Motion, np.ndarray, np.ndarray]],
    base: np.ndarray,
    rates: np.ndarray,
    device: Device,
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Information, right-hand side, robust cost and number of residuals less unknowns."""
    count = len(times)
    size = 9 * count + 7
    H, b, cost = np.zeros((size, size)), np.zeros(size), 0.0
    rotate = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8])
    for k, (step, J, Q) in enumerate(parts):
        dt = times[k + 1] - times[k]
        Rt = window.R[k].T
        db = window.bias - base
        dp = Rt @ (window.p[k + 1] - window.p[k] - window.v[k] * dt - 0.5 * GRAVITY * dt * dt)
        dv = Rt @ (window.v[k + 1] - window.v[k] - GRAVITY * dt)
        turn = step.R @ so3_exp(J[3:6, 9:] @ db)
        relative = Rt @ window.R[k + 1]
        r = np.concatenate([
            dp - step.p - J[:3, 9:] @ db, rotation_vector(turn.T @ relative), dv - step.v - J[6:9, 9:] @ db
        ])  # fmt: skip
        D = np.zeros((9, 24))  # of state k, state k + 1, biases
        D[:3, :3], D[:3, 3:6], D[:3, 6:9], D[:3, 9:12] = -Rt, skew(dp), -Rt * dt, Rt
        D[3:6, 3:6], D[3:6, 12:15] = -relative.T, np.eye(3)
        D[6:9, 3:6], D[6:9, 6:9], D[6:9, 15:18] = skew(dv), -Rt, Rt
        D[:, 18:] = -J[:9, 9:]
        L = np.linalg.cholesky(Q[:9, :9] + 1e-16 * np.eye(9))
        both = np.linalg.solve(L, np.column_stack([D, r]))
        at = np.concatenate([9 * k + rotate, 9 * (k + 1) + rotate, 9 * count + np.arange(6)])
        H[np.ix_(at, at)] += both[:, :-1].T @ both[:, :-1]
        b[at] -= both[:, :-1].T @ both[:, -1]
        cost += float(both[:, -1] @ both[:, -1])
    noise = device.noise
    at = 9 * count + np.arange(7)
    sigma = np.maximum(np.repeat([noise.gyro_bias, noise.accel_bias, device.offset_sigma], [3, 3, 1]), 1e-9)
    value = np.append(window.bias, window.shift)
    H[at, at] += sigma**-2
    b[at] -= value / sigma**2
    cost += float(((value / sigma) ** 2).sum())
    # The images.
    shifted = replace(views, delay=views.delay + window.shift)
    clones = Clones(window.R, window.p, window.v, rates - window.bias[:3])
    R, p, _ = clones.shifted(shifted.clone, shifted.delay)
    points, good = triangulate(shifted, R @ device.R_bc, p + R @ device.p_bc)
    layout = Layout(size, 9 * np.arange(count), None, 9 * count + 6)
    seen = linearise(shifted, points, clones, clones, device.R_bc, device.p_bc, layout)
    lengths = np.diff(seen.begins)
    r, J = seen.residual / device.sigma, seen.jacobian / device.sigma
    bound = OUTLIER * device.gate
    square = np.add.reduceat(seen.residual**2, seen.begins[:-1]) / lengths / bound**2
    square[~good] = np.inf
    weight = np.repeat(1 / (1 + square) ** 2, lengths)  # Geman and McClure's
    H += J.T @ (weight[:, None] * J)
    b += J.T @ (weight * r)
    cost += float((lengths * (bound / device.sigma) ** 2 / (1 + 1 / np.maximum(square, 1e-12))).sum())
    rows = int(lengths[good].sum())
    return H, b, cost, rows


def _checked(
    times: np.ndarray, offset: float, window: _Window, solved: _Solved, device: Device, most: float
) -> Start | str:
    """The start, if it is one: the last position and heading become those of the world."""
    count, noise = len(times), device.noise
    if solved.misfit > MISFIT * (OUTLIER * device.gate / device.sigma) ** 2:
        return "images and samples do not agree"
    last = 9 * (count - 1)
    H = solved.information.copy()
    up = window.R[-1].T @ np.array([0.0, 0.0, 1.0])
    H[last : last + 3, last : last + 3] += np.eye(3) / HELD**2
    H[last + 3 : last + 6, last + 3 : last + 6] += np.outer(up, up) / HELD**2
    try:
        covariance = np.linalg.inv(H)
    except np.linalg.LinAlgError:
        return "too little motion"
    away = window.p - window.p[-1]
    far = int(np.argmax(np.linalg.norm(away, axis=1)))
    length = float(np.linalg.norm(away[far]))
    towards = away[far] / max(length, 1e-9)
    spread = towards @ covariance[9 * far : 9 * far + 3, 9 * far : 9 * far + 3] @ towards
    if not 0 < spread < (most * length) ** 2:
        return "too little motion"
    if (np.abs(window.bias) > 4 * np.repeat([noise.gyro_bias, noise.accel_bias], 3)).any():
        return "biases out of bounds"
    at = np.concatenate([last + np.arange(9), 9 * count + np.arange(7)])
    P = _prior(device)
    P[: FIXED - 6, : FIXED - 6] = CAUTION * covariance[np.ix_(at, at)]
    span = times[-1] - times[0]
    walk = np.repeat([noise.gyro_walk, noise.accel_walk], 3) ** 2 * span
    P[np.arange(9, 15), np.arange(9, 15)] += walk
    origin = window.p[-1]
    states = [Motion(R, p - origin, v) for R, p, v in zip(window.R, window.p, window.v, strict=True)]
    return Start(
        float(times[-1]), states[-1], window.bias, offset, 0.5 * (P + P.T),
        tuple(zip(map(float, times), states, strict=True)),
    )  # fmt: skip
