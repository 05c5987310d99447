"""Stereo along epipolar lines, for all pixels of a keyframe at once (Engel, Sturm, Cremers: "Semi-dense visual
odometry for a monocular camera", 2013)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.odometry.classical.direct.image import Level, inside, sample

TAPS = np.arange(-2, 3, dtype=np.float32)
"""Five samples a pixel apart along the line are compared."""


@dataclass(frozen=True)
class StereoConfig:
    """Settings; intensities from 0 to 255.

    Attributes:
        noise: standard deviation of an intensity.
        line: standard deviation of the epipolar line's position across itself, pixels.
        sigmas: half of the searched interval in standard deviations of the inverse depth.
        longest: samples of the line that are searched at most.
        difference: largest root of the mean squared difference of the five samples.
        distinct: how much worse the second best place must be, as a factor of the squared difference.
        slope: smallest derivative along the line, intensities per pixel.
        stretch: largest change of size between the images, as a factor.
    """

    noise: float = 4.0
    line: float = 0.25
    sigmas: float = 2.0
    longest: int = 41
    difference: float = 16.0
    distinct: float = 1.5
    slope: float = 3.0
    stretch: float = 1.4


@dataclass(frozen=True)
class Matches:
    """Outcome of :func:`search_lines`, ``(N,)`` each.

    Attributes:
        inverse_depth, variance: measured; meaningless where not ``found``.
        found: a clear match.
        failed: the pixel should have been seen and looks different (occlusion, or a wrong depth).
    """

    inverse_depth: np.ndarray
    variance: np.ndarray
    found: np.ndarray
    failed: np.ndarray


def search_lines(
    key: Level,
    other: Level,
    T: np.ndarray,
    uv: np.ndarray,
    inverse_depth: np.ndarray,
    variance: np.ndarray,
    gain: float,
    offset: float,
    config: StereoConfig,
) -> Matches:
    """Look for pixels of a keyframe along their epipolar lines in another image, within what is known of their depth.

    Args:
        key, other: the two images.
        T: ``(4, 4)`` keyframe to the other.
        uv: ``(N, 2)`` float32 pixels of the keyframe.
        inverse_depth, variance: ``(N,)`` prior.
        gain, offset: ``I_other = gain I_key + offset``.
    """
    n = len(uv)
    out = Matches(np.zeros(n, np.float32), np.full(n, np.inf, np.float32), np.zeros(n, bool), np.zeros(n, bool))
    f, c = key.intrinsics[:2].astype(np.float32), key.intrinsics[2:].astype(np.float32)
    R, t = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    rays = np.column_stack([(uv - c) / f, np.ones(n, np.float32)])
    far = rays @ R.T  # the point at infinity
    sigma = np.sqrt(variance)

    def place(d: np.ndarray) -> np.ndarray:
        q = far + d[:, None] * t
        return q[:, :2] / np.maximum(q[:, 2:], 1e-3) * f + c

    low, high = np.maximum(inverse_depth - config.sigmas * sigma, 1e-4), inverse_depth + config.sigmas * sigma
    # Nothing nearer than a tenth of the depth at infinity's scale: there the line runs through the camera.
    if t[2] < 0:
        high = np.minimum(high, 0.9 * far[:, 2] / -t[2])
    q = far + inverse_depth[:, None] * t
    iz = 1 / np.maximum(q[:, 2], 1e-3)
    speed = f * (t[:2] * iz[:, None] - q[:, :2] * t[2] * iz[:, None] ** 2)  # d pixel / d inverse depth
    pace = np.linalg.norm(speed, axis=1)
    along = speed / np.maximum(pace, 1e-9)[:, None]

    # The same line in the keyframe, and how much the image is stretched along it.
    camera = -R.T @ t
    line = f * (camera[:2] - rays[:, :2] * camera[2])
    line /= np.maximum(np.linalg.norm(line, axis=1), 1e-9)[:, None]
    stepped = np.column_stack([rays[:, :2] + line / f, np.ones(n, np.float32)]) @ R.T + inverse_depth[:, None] * t
    stepped = stepped[:, :2] / np.maximum(stepped[:, 2:], 1e-3) * f + c
    stretch = ((stepped - place(inverse_depth)) * along).sum(axis=1)
    line, stretch = line * np.sign(stretch)[:, None], np.abs(stretch)

    # Uncertainty of a match: photometric and geometric error of the place on the line, in inverse depth.
    gradient = key.packed[uv[:, 1].astype(int), uv[:, 0].astype(int), 1:]
    slope = np.abs((gradient * line).sum(axis=1))
    across = slope / np.maximum(np.linalg.norm(gradient, axis=1), 1e-6)
    place_variance = 4 / len(TAPS) * (config.noise / np.maximum(slope, 1e-3)) ** 2
    place_variance += (config.line / np.maximum(across, 0.05)) ** 2 + 0.1**2
    expected = place_variance / np.maximum(pace, 1e-9) ** 2
    try_it = (q[:, 2] > 0.05) & (high > low) & (slope > config.slope) & (across > 0.25) & (expected < 4 * variance)
    try_it &= (stretch > 1 / config.stretch) & (stretch < config.stretch)
    start, stop = place(low), place(high)
    length = np.linalg.norm(stop - start, axis=1)
    middle = np.where((length < config.longest - 4)[:, None], (start + stop) / 2, place(inverse_depth))
    reach = np.minimum(np.ceil(length / 2) + 1, config.longest // 2).astype(int)
    try_it &= inside(middle[:, 0], middle[:, 1], other.grey.shape, 3)
    for least, most in ((0, 4), (4, 9), (9, config.longest)):
        group = np.flatnonzero(try_it & (reach > least) & (reach <= most))
        if not len(group):
            continue
        g = group
        taps = uv[g, None] + line[g, None] * (TAPS / stretch[g, None])[..., None]
        wanted = gain * sample(key.grey, taps[..., 0], taps[..., 1]) + offset
        half = int(reach[g].max())
        steps = np.arange(-half - 2, half + 3, dtype=np.float32)
        walk = middle[g, None] + along[g, None] * steps[None, :, None]
        strip = sample(other.grey, walk[..., 0], walk[..., 1])
        visible = inside(walk[..., 0], walk[..., 1], other.grey.shape, 1)
        places = 2 * half + 1
        cost = sum((strip[:, j : j + places] - wanted[:, j : j + 1]) ** 2 for j in range(len(TAPS)))
        allowed = visible[:, :places] & visible[:, 4:]
        allowed &= np.abs(np.arange(-half, half + 1)) <= reach[g, None]
        shift, found, failed = _best(np.where(allowed, cost, np.inf), config)
        pixel = middle[g] + along[g] * (shift - half)[:, None]
        d = _inverse_depth(pixel, along[g], far[g], t, f, c)
        sane = found & (d > 1e-4) & (d >= low[g] * 0.8) & (d <= high[g] * 1.25)
        q_d = far[g] + d[:, None] * t
        iz_d = 1 / np.maximum(q_d[:, 2], 1e-3)
        pace_d = np.linalg.norm(f * (t[:2] * iz_d[:, None] - q_d[:, :2] * t[2] * iz_d[:, None] ** 2), axis=1)
        out.inverse_depth[g], out.found[g], out.failed[g] = d, sane, failed
        out.variance[g] = place_variance[g] / np.maximum(pace_d, 1e-9) ** 2
    return out


def _best(cost: np.ndarray, config: StereoConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column (with fraction) of the least cost of each row; whether it is clear; whether nothing fits.

    The least place must lie inside, be good in itself and better than any that is not next to it.
    """
    rows, places = np.arange(len(cost)), cost.shape[1]
    best = cost.argmin(axis=1)
    least = cost[rows, best]
    far_off = np.abs(np.arange(places) - best[:, None]) > 2
    second = np.where(far_off, cost, np.inf).min(axis=1)
    left, right = cost[rows, np.maximum(best - 1, 0)], cost[rows, np.minimum(best + 1, places - 1)]
    inner = (best > 0) & (best < places - 1) & np.isfinite(left) & np.isfinite(right)
    limit = len(TAPS) * config.difference**2
    failed = np.isfinite(least) & (least > limit)
    with np.errstate(invalid="ignore"):
        bend = np.where(inner, left + right - 2 * least, 1)
        fraction = np.where(inner & (bend > 1e-6), 0.5 * (left - right) / np.maximum(bend, 1e-6), 0)
    noise = len(TAPS) * config.noise**2  # so that differences within the noise do not decide
    found = inner & ~failed & (second + noise > config.distinct * (least + noise))
    return best + np.clip(fraction, -0.5, 0.5), found, failed


def _inverse_depth(
    pixel: np.ndarray, along: np.ndarray, far: np.ndarray, t: np.ndarray, f: np.ndarray, c: np.ndarray
) -> np.ndarray:
    """Inverse depth at which a point appears at ``pixel``, by the coordinate along which the line runs."""
    xy = (pixel - c) / f
    top = far[:, :2] - xy * far[:, 2:]
    bottom = xy * t[2] - t[:2]
    axis = (np.abs(along[:, 1]) > np.abs(along[:, 0])).astype(int)
    rows = np.arange(len(pixel))
    chosen = bottom[rows, axis]
    return top[rows, axis] / np.where(np.abs(chosen) < 1e-9, 1e-9, chosen)
