"""Time offset and rotation between a camera and a gyroscope, from the orientations of both.

A camera that turns and the gyroscope fixed to it measure the same rotation. Over an interval of the camera's clock from
``t_i`` to ``t_j``, with the gyroscope's rotation ``D(a, b)`` integrated from stamp ``a`` to stamp ``b``,

    R_i^T R_j = C D(t_i + offset, t_j + offset; bias) C^T,    C = R_camera_imu.

Start: mean rates of the intervals, ``Log(.) / (t_j - t_i)``, less their medians (which removes the bias), are rotated
into each other by Kabsch's method (Wahba's problem) for every offset of a grid, and the offset is taken whose singular
values are largest against the norms: a cross-correlation that needs neither the bias nor the rotation, and to which
frames at irregular times do no harm. Refinement: Gauss-Newton over bias, rotation and offset with Cauchy's weights. The
covariance is that of a robust M-estimator whose residuals are correlated between overlapping intervals (Newey and West,
1987).

Sign of the offset as in Kalibr (Furgale et al., "Unified temporal and spatial calibration", IROS 2013):
``t_imu = t_camera + offset``. Time of a frame is that of its middle row, else half a readout is part of the offset.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dvo.core.errors import DvoError
from dvo.geometry.poses import rotation_vector, so3_exp

Array = np.ndarray
GRID = 0.02  # seconds between the offsets of the search
INTERVAL = 0.3  # seconds of an interval; longer where frames are further apart
MAX_GAP = 0.05  # seconds without samples over which nothing is integrated; three times their spacing if that is more
MIN_INTERVALS = 12
MAX_SEARCHED = 300  # intervals in the search for the offset
MIN_RATE = 0.03  # rad/s, deviation of the mean rates that is needed, for the rotation about two axes
MIN_SCORE = 0.6  # correlation below which vision and gyroscope do not see the same motion
RIVAL_SCORE = 0.95  # of the best correlation; a second offset with this much is as good
MAX_SIGMA_OFFSET = 0.01  # seconds
MAX_SIGMA_ROTATION = 1.5  # degrees
_STEPS = 12
_FINE = 0.002  # seconds between orientations in the search
_LONGEST = 7200.0  # seconds of samples that are integrated
_UNKNOWN = (np.inf, np.inf, np.inf)


@dataclass(frozen=True)
class ImuAlignment:
    """A gyroscope against the orientations of a camera.

    Standard deviations are infinite for what the motion does not tell.

    Attributes:
        rotation_camera_imu: ``(3, 3)`` takes vectors of the inertial sensor into the camera.
        time_offset: seconds; ``t_imu = t_camera + time_offset``: subtract it from the stamps of the samples.
        gyro_bias: ``(3,)`` rad/s in the axes of the sensor; the rate is the sample less the bias.
        sigma_rotation: ``(3,)`` degrees about the axes of the camera.
        sigma_offset: seconds.
        sigma_bias: ``(3,)`` rad/s.
        reason: why something is not told, one sentence; empty if all is.
        mirrored: a reflection of the axes explains the rates, and no rotation does.
        axes: ``(3, 3)`` orthogonal matrix of determinant 1 or, if mirrored, -1 that explains the rates best.
        correlation: of the mean rates at the offset, 0 to 1.
        residual: robust deviation of an interval's rotation, degrees.
        intervals: how many were used.
    """

    rotation_camera_imu: Array
    time_offset: float
    gyro_bias: Array
    sigma_rotation: Array
    sigma_offset: float
    sigma_bias: Array
    reason: str
    mirrored: bool = False
    axes: Array | None = None
    correlation: float = 0.0
    residual: float = np.inf
    intervals: int = 0

    @property
    def is_offset_told(self) -> bool:
        """The motion tells the time offset."""
        return bool(np.isfinite(self.sigma_offset))

    @property
    def is_rotation_told(self) -> bool:
        """The motion tells the rotation about all three axes."""
        return bool(np.isfinite(self.sigma_rotation).all())


@dataclass(frozen=True)
class IntegratedGyro:
    """Orientation of a gyroscope over its own stamps, for one bias.

    Attributes:
        times: ``(K,)`` stamps, seconds.
        rates: ``(K, 3)`` rad/s, bias removed.
        rotations: ``(K, 3, 3)`` from the sensor to its axes at the first sample.
        sums: ``(K, 3, 3)`` integral of ``rotations`` over time, for the derivative by the bias.
        missing: ``(K,)`` seconds of gaps before each sample.
    """

    times: Array
    rates: Array
    rotations: Array
    sums: Array
    missing: Array

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """Orientation, its integral and rate.

        Args:
            times: ``(N,)`` stamps within those of the samples.

        Returns:
            ``(N, 3, 3)``, ``(N, 3, 3)`` and ``(N, 3)``.
        """
        before = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        elapsed = (times - self.times[before])[:, None]
        slope = (self.rates[before + 1] - self.rates[before]) / np.diff(self.times)[before, None]
        rate = self.rates[before] + slope * elapsed
        start = self.rotations[before]
        rotation = start @ so3_exp(0.5 * (self.rates[before] + rate) * elapsed)
        return rotation, self.sums[before] + 0.5 * elapsed[..., None] * (start + rotation), rate

    def covers(self, first: Array, last: Array) -> Array:
        """Intervals without a gap.

        Args:
            first, last: ``(N,)`` stamps.

        Returns:
            ``(N,)`` bool.
        """
        gap = np.interp(last, self.times, self.missing) - np.interp(first, self.times, self.missing)
        return (first >= self.times[0]) & (last <= self.times[-1]) & (gap <= 0)


def integrate_gyro(times: Array, gyro: Array, bias: Array) -> IntegratedGyro:
    """Integrate rates, each step with the mean of its ends.

    Args:
        times: ``(K,)`` increasing stamps, seconds.
        gyro: ``(K, 3)`` rad/s.
        bias: ``(3,)`` rad/s, subtracted.
    """
    rates, steps = gyro - bias, np.diff(times)
    turns = so3_exp(0.5 * (rates[1:] + rates[:-1]) * steps[:, None])
    rotations = np.concatenate([np.eye(3)[None], turns])
    reach = 1
    while reach < len(rotations):  # running product in log2(K) passes
        rotations[reach:] = rotations[:-reach] @ rotations[reach:]
        reach *= 2
    areas = 0.5 * steps[:, None, None] * (rotations[1:] + rotations[:-1])
    sums = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(areas, 0)])
    long = np.where(steps > max(MAX_GAP, 3 * float(np.median(steps))), steps, 0.0)
    return IntegratedGyro(times, rates, rotations, sums, np.concatenate([[0.0], np.cumsum(long)]))


def hand_eye(camera: Array, imu: Array) -> tuple[Array, Array, bool]:
    """Rotation that takes rotation vectors of a gyroscope into those of a camera (Kabsch 1976; Wahba 1965).

    Args:
        camera, imu: ``(N, 3)`` rotation vectors or mean rates of the same intervals, less their means if there is a
            bias.

    Returns:
        Orthogonal matrix ``(3, 3)`` with ``camera = matrix @ imu`` that fits best, of determinant 1 or -1; singular
        values ``(3,)`` of the products' sum; and True if the determinant is -1, which means mirrored axes if the third
        singular value is not small.
    """
    left, values, right = np.linalg.svd(camera.T @ imu)
    return left @ right, values, bool(np.linalg.det(left @ right) < 0)


def nearest_rotation(camera: Array, imu: Array) -> Array:
    """As :func:`hand_eye`, among rotations.

    Args:
        camera, imu: ``(N, 3)``.

    Returns:
        ``(3, 3)`` of determinant 1.
    """
    left, _, right = np.linalg.svd(camera.T @ imu)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def align_imu(
    timestamps: Array,
    rotations_wc: Array,
    imu_times: Array,
    gyro: Array,
    rotation_camera_imu: Array | None = None,
    *,
    max_offset: float = 0.5,
    interval: float = INTERVAL,
    fixed: bool = False,
) -> ImuAlignment:
    """Find time offset, rotation and bias of a gyroscope from the orientations of a camera.

    Args:
        timestamps: ``(N,)`` increasing times of the frames (their middle rows), seconds.
        rotations_wc: ``(N, 3, 3)`` camera to world; the world is arbitrary, and the same for all.
        imu_times: ``(K,)`` increasing stamps of the samples, seconds.
        gyro: ``(K, 3)`` rad/s.
        rotation_camera_imu: ``(3, 3)`` stated rotation, or None. It settles what periodic motion leaves open, and
            stands in the result where the motion does not tell the rotation.
        max_offset: seconds searched on either side.
        interval: seconds over which rotations are compared, at least two frames.
        fixed: the stated rotation is taken as exact.

    Returns:
        The alignment; where the motion does not tell, ``reason`` says why and the deviations are infinite.

    Raises:
        DvoError: arrays whose shapes do not match, times that do not increase, or ``fixed`` without a rotation.
    """
    _check(timestamps, rotations_wc, imu_times, gyro)
    if fixed and rotation_camera_imu is None:
        raise DvoError("there is no rotation to keep", field="fixed", remedy="state rotation_camera_imu")
    stated = None if rotation_camera_imu is None else np.asarray(rotation_camera_imu, float)
    nothing = ImuAlignment(
        np.eye(3) if stated is None else stated, 0.0, np.zeros(3), np.array(_UNKNOWN), np.inf, np.array(_UNKNOWN), ""
    )
    if len(timestamps) < MIN_INTERVALS or len(imu_times) < MIN_INTERVALS:
        return replace(nothing, reason=f"{len(timestamps)} frames and {len(imu_times)} samples are too few")
    if imu_times[-1] - imu_times[0] > _LONGEST:  # hours without frames, or a clock that jumps
        reach = max_offset + interval + 1
        near = (imu_times >= timestamps[0] - reach) & (imu_times <= timestamps[-1] + reach)
        imu_times, gyro = imu_times[near], gyro[near]
        if len(imu_times) < MIN_INTERVALS or imu_times[-1] - imu_times[0] > _LONGEST:
            return replace(nothing, reason=f"{len(imu_times)} samples at the times of the frames")
    turns = _Turns.of(timestamps, rotations_wc, interval)
    raw = integrate_gyro(imu_times, gyro, np.zeros(3))
    if len(turns.first) < MIN_INTERVALS:
        return replace(nothing, reason="too few frames follow each other closely")
    spread = _spread(turns.rates)
    if spread[0] < MIN_RATE:
        rates = f"{np.degrees(spread[0]):.2g} of {np.degrees(MIN_RATE):.2g} degrees/s"
        return replace(nothing, reason=f"too little rotation: the camera's rate varies by {rates}")
    step = -(-len(turns.first) // MAX_SEARCHED)
    start = _search(turns.part(np.arange(0, len(turns.first), step)), raw, stated, max_offset)
    found = replace(nothing, **start.facts)
    if start.reason:
        return replace(found, reason=start.reason)
    is_one_axis = spread[1] < MIN_RATE
    keep = fixed or (is_one_axis and stated is not None)
    rotation = start.rotation if stated is None or not keep else stated
    found = _refine(turns, raw, found, rotation, start.offset, keep)
    return _judged(found, stated, spread, is_one_axis, fixed)


def _check(timestamps: Array, rotations_wc: Array, imu_times: Array, gyro: Array) -> None:
    frames, samples = len(timestamps), len(imu_times)
    shapes = (timestamps.shape, rotations_wc.shape, imu_times.shape, gyro.shape)
    if shapes != ((frames,), (frames, 3, 3), (samples,), (samples, 3)):
        raise DvoError(
            f"times {shapes[0]}, rotations {shapes[1]}, stamps {shapes[2]} and gyro {shapes[3]} do not match",
            field="align_imu",
            remedy="give (N,), (N, 3, 3), (K,) and (K, 3) arrays",
        )
    for name, times in (("timestamps", timestamps), ("imu_times", imu_times)):
        if not (np.diff(times) > 0).all():
            raise DvoError("times do not increase", field=name, remedy="sort them and remove repeated ones")


@dataclass(frozen=True)
class _Turns:
    """Rotations ``(M, 3, 3)`` of the camera over intervals from ``first`` to ``last``, sorted, and their mean rates."""

    first: Array
    last: Array
    rotations: Array
    rates: Array
    overlap: int

    @staticmethod
    def of(timestamps: Array, rotations_wc: Array, interval: float) -> _Turns:
        spacing = float(np.median(np.diff(timestamps)))
        length = max(interval, spacing)
        start = np.arange(len(timestamps))
        end = np.searchsorted(timestamps, timestamps + 0.99 * length)
        start, end = start[end < len(timestamps)], end[end < len(timestamps)]
        near = timestamps[end] - timestamps[start] < 2 * length + spacing
        start, end = start[near], end[near]
        turns = np.swapaxes(rotations_wc[start], -1, -2) @ rotations_wc[end]
        span = timestamps[end] - timestamps[start]
        overlap = int(np.median(end - start)) if len(start) else 1
        return _Turns(timestamps[start], timestamps[end], turns, rotation_vector(turns) / span[:, None], overlap)

    def part(self, chosen: Array) -> _Turns:
        return _Turns(
            self.first[chosen], self.last[chosen], self.rotations[chosen], self.rates[chosen], self.overlap
        )  # fmt: skip


def _spread(rates: Array) -> Array:
    """Deviations ``(3,)`` of rates along their principal axes, the largest first."""
    centred = _bounded(rates)
    return np.sqrt(np.linalg.eigvalsh(centred.T @ centred / len(centred))[::-1].clip(0))


@dataclass(frozen=True)
class _Start:
    """Offset and rotation by correlation."""

    offset: float
    rotation: Array
    reason: str
    facts: dict


def _search(turns: _Turns, raw: IntegratedGyro, stated: Array | None, max_offset: float) -> _Start:
    """Correlation over the offsets, and the rotation at the best one."""
    count = round(max_offset / GRID)
    offsets = GRID * np.arange(-count, count + 1)
    grid = _Sampled.of(raw)
    free, held = np.array([_score(*_centred(turns, grid, offset)[:2], turns, stated) for offset in offsets]).T
    scores = held if stated is not None and held.max() > 0.9 * free.max() else free
    best = int(np.argmax(scores))
    if scores[best] <= 0:
        return _Start(0.0, np.eye(3), "the samples do not cover the frames", {})
    camera, imu, used = _centred(turns, grid, float(offsets[best]))
    matrix, values, is_mirrored = hand_eye(camera, imu)
    offset = _peak(offsets, scores, best)
    is_mirrored = is_mirrored and values[2] > 0.02 * values[0] and values[2] > 4 * _noise(camera, imu, matrix)
    facts = {
        "time_offset": offset,
        "axes": matrix,
        "mirrored": is_mirrored,
        "correlation": float(free[best]),
        "intervals": int(used.sum()),
    }
    doubt = _doubt(offsets, scores, best, max_offset, is_mirrored)
    return _Start(offset, nearest_rotation(camera, imu), doubt, facts)


@dataclass(frozen=True)
class _Sampled:
    """Orientations of a gyroscope at even times, near enough to each other that the nearest one serves the search."""

    path: IntegratedGyro
    start: float
    rotations: Array

    @staticmethod
    def of(path: IntegratedGyro) -> _Sampled:
        start, end = float(path.times[0]), float(path.times[-1])
        return _Sampled(path, start, path.at(np.arange(start, end, _FINE))[0])

    def at(self, times: Array) -> Array:
        place = np.round((times - self.start) / _FINE).astype(int)
        return self.rotations[place.clip(0, len(self.rotations) - 1)]


def _noise(camera: Array, imu: Array, matrix: Array) -> float:
    """Third singular value that errors alone would give, about."""
    error = camera - imu @ matrix.T
    return float(np.sqrt(np.median((error**2).sum(1)) * (imu**2).sum() / 3))


def _centred(turns: _Turns, grid: _Sampled, offset: float) -> tuple[Array, Array, Array]:
    """Mean rates of both sensors less their medians, outliers bounded, and which intervals the samples cover."""
    first, last = turns.first + offset, turns.last + offset
    used = grid.path.covers(first, last)
    if not used.any():
        return np.zeros((0, 3)), np.zeros((0, 3)), used
    start, end = grid.at(first[used]), grid.at(last[used])
    imu = rotation_vector(np.swapaxes(start, -1, -2) @ end) / (last - first)[used, None]
    return _bounded(turns.rates[used]), _bounded(imu), used


def _bounded(rates: Array) -> Array:
    """Rates less their median, none longer than twice the length that nine of ten do not exceed."""
    centred = rates - np.median(rates, 0)
    size = np.linalg.norm(centred, axis=1)
    bound = 2 * max(float(np.quantile(size, 0.9)), 1e-12)
    return centred * np.minimum(1, bound / np.maximum(size, 1e-300))[:, None]


def _score(camera: Array, imu: Array, turns: _Turns, stated: Array | None) -> tuple[float, float]:
    """Correlation with the best orthogonal matrix, and with the stated rotation."""
    if len(camera) < max(MIN_INTERVALS, 0.5 * len(turns.first)):
        return 0.0, 0.0
    product = camera.T @ imu / max(np.linalg.norm(camera) * np.linalg.norm(imu), 1e-300)
    held = 0.0 if stated is None else float((product * stated).sum())
    return float(np.linalg.svd(product, compute_uv=False).sum()), held


def _peak(offsets: Array, scores: Array, best: int) -> float:
    """Vertex of the parabola through three scores."""
    if not 0 < best < len(scores) - 1:
        return float(offsets[best])
    before, here, after = scores[best - 1 : best + 2]
    bend = before - 2 * here + after
    return float(offsets[best] + (GRID * 0.5 * (before - after) / bend if bend < 0 else 0.0))


def _doubt(offsets: Array, scores: Array, best: int, max_offset: float, is_mirrored: bool) -> str:
    """Why a correlation does not tell the offset; empty if it does."""
    if scores[best] < MIN_SCORE:
        return f"vision and gyroscope do not agree at any offset (correlation {scores[best]:.2f})"
    tops = np.flatnonzero((scores[1:-1] >= scores[:-2]) & (scores[1:-1] > scores[2:])) + 1
    rivals = tops[(tops != best) & (scores[tops] > RIVAL_SCORE * scores[best])]
    dips = [scores[min(best, k) : max(best, k)].min() for k in rivals]
    rivals = [k for k, dip in zip(rivals, dips, strict=True) if dip < RIVAL_SCORE * scores[k]]
    if len(rivals):
        pair = f"{offsets[best]:.3f} and {offsets[rivals[0]]:.3f} s"
        return f"periodic motion: time offsets of {pair} explain it equally well"
    if best in (0, len(scores) - 1):
        return f"the time offset is not within {max_offset:g} s"
    return "the axes of the samples are mirrored: no rotation explains them" if is_mirrored else ""


def _refine(
    turns: _Turns, raw: IntegratedGyro, found: ImuAlignment, rotation: Array, offset: float, keep: bool
) -> ImuAlignment:
    """Gauss-Newton over bias, rotation (perturbed on the left) and offset."""
    bias, used = np.zeros(3), np.zeros(len(turns.first), bool)
    free = np.array([True] * 3 + [not keep] * 3 + [True])
    covariance = np.full((7, 7), np.inf)
    for step in range(_STEPS):
        path = integrate_gyro(raw.times, raw.rates, bias)
        now = path.covers(turns.first + offset, turns.last + offset)
        used = now if step < 3 else used & now
        if used.sum() < MIN_INTERVALS:
            return replace(found, reason="the samples do not cover the frames")
        residuals, jacobians = _linearised(turns.part(used), path, rotation, offset)
        size = np.linalg.norm(residuals, axis=1)
        scale = max(float(np.median(size)) / 1.54, 1e-9)  # median norm of three standard normal numbers
        weights = 1 / (1 + (size / (3 * scale)) ** 2)
        rows = jacobians[:, :, free]
        normal = np.einsum("nia,n,nib->ab", rows, weights, rows)
        gradient = np.einsum("nia,n,ni->na", rows, weights, residuals)
        inverse = np.linalg.pinv(normal, rcond=1e-12)
        change = np.zeros(7)
        change[free] = inverse @ gradient.sum(0)
        bias, rotation, offset = bias + change[:3], so3_exp(change[3:6]) @ rotation, offset + float(change[6])
        covariance[np.ix_(free, free)] = inverse @ _scatter(gradient, turns.overlap) @ inverse
        if step >= 3 and (np.abs(change) < 1e-9).all():
            break
    sigma = np.sqrt(np.diagonal(covariance).clip(0))
    return replace(
        found, rotation_camera_imu=rotation, time_offset=offset, gyro_bias=bias, sigma_bias=sigma[:3],
        sigma_rotation=np.degrees(sigma[3:6]), sigma_offset=float(sigma[6]), residual=float(np.degrees(scale)),
        intervals=int(used.sum()),
    )  # fmt: skip


def _linearised(turns: _Turns, path: IntegratedGyro, rotation: Array, offset: float) -> tuple[Array, Array]:
    """Residuals ``(M, 3)`` and how the prediction changes ``(M, 3, 7)`` with bias, rotation and offset."""
    start, area, rate = path.at(turns.first + offset)
    end, end_area, end_rate = path.at(turns.last + offset)
    turn = np.swapaxes(start, -1, -2) @ end
    predicted = rotation @ turn @ rotation.T
    residuals = rotation_vector(np.swapaxes(predicted, -1, -2) @ turns.rotations)
    by_bias = -rotation @ np.swapaxes(end, -1, -2) @ (end_area - area)
    by_rotation = np.swapaxes(predicted, -1, -2) - np.eye(3)
    by_offset = rotation @ (end_rate[..., None] - np.swapaxes(turn, -1, -2) @ rate[..., None])
    return residuals, np.concatenate([by_bias, by_rotation, by_offset], -1)


def _scatter(gradient: Array, overlap: int) -> Array:
    """Covariance of a sum of terms ``(M, P)`` of which neighbours are correlated (Bartlett's weights)."""
    count, unknowns = gradient.shape
    reach = min(2 * overlap, count // 4)
    total = gradient.T @ gradient
    for lag in range(1, reach + 1):
        product = gradient[:-lag].T @ gradient[lag:]
        total += (1 - lag / (reach + 1)) * (product + product.T)
    independent = count / max(overlap, 1)
    return total * independent / max(independent - unknowns, 1.0)


def _judged(found: ImuAlignment, stated: Array | None, spread: Array, is_one_axis: bool, fixed: bool) -> ImuAlignment:
    """The alignment without what the motion does not tell."""
    unknown = np.array(_UNKNOWN)
    if not found.sigma_offset < MAX_SIGMA_OFFSET:
        reason = f"the motion does not tell the time offset (deviation {1e3 * found.sigma_offset:.2g} ms)"
        return replace(found, sigma_offset=np.inf, sigma_rotation=unknown, sigma_bias=unknown, reason=reason)
    if fixed:
        return replace(found, sigma_rotation=np.zeros(3))
    if is_one_axis:
        rates = f"{np.degrees(spread[1]):.2g} of {np.degrees(MIN_RATE):.2g} degrees/s about a second one"
        reason = f"rotation about one axis only does not tell the rotation about it ({rates})"
    elif not (found.sigma_rotation < MAX_SIGMA_ROTATION).all():
        reason = f"the motion does not tell the rotation (deviation {found.sigma_rotation.max():.2g} degrees)"
    else:
        return found
    known = found.sigma_bias if stated is not None else unknown
    kept = found.rotation_camera_imu if stated is None else stated
    return replace(found, rotation_camera_imu=kept, sigma_rotation=unknown, sigma_bias=known, reason=reason)
