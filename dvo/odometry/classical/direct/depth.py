"""Inverse depths of a keyframe's pixels as independent Gaussians: fused, smoothed, and carried to the next keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.odometry.classical.direct.align import Reference
from dvo.odometry.classical.direct.image import Level, inside, sample
from dvo.odometry.classical.direct.stereo import Matches

NEIGHBOURS = np.array([(u, v) for v in range(-2, 3) for u in range(-2, 3) if u or v])
"""``(24, 2)`` steps to the pixels around one."""
CLOSENESS = np.exp(-(NEIGHBOURS**2).sum(axis=1) / 4).astype(np.float32)
"""``(24,)`` their weights."""


@dataclass(frozen=True)
class DepthConfig:
    """Settings.

    Attributes:
        strength: smallest gradient of a pixel that is used, intensities per pixel.
        pixels: how many pixels are used at most, the strongest.
        aligned: how many of them images are aligned to at most, evenly over the image.
        prior: standard deviation of a new pixel's inverse depth, as part of the value that it begins with.
        agree: neighbours, and measurements, agree within so many standard deviations.
        growth: factor on every variance per new frame, and (squared) per failure.
        failures: failed searches in excess of successes after which a pixel starts anew.
        support: how many of the 24 neighbours must agree with a pixel that is carried on.
        carry: variance added to a carried inverse depth, as a squared part of it.
    """

    strength: float = 5.0
    pixels: int = 10000
    aligned: int = 5000
    prior: float = 0.5
    agree: float = 2.0
    growth: float = 1.01
    failures: int = 3
    support: int = 3
    carry: float = 0.01


def fuse(
    mean: np.ndarray, variance: np.ndarray, other_mean: np.ndarray, other_variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Product of two Gaussians: mean and variance."""
    total = variance + other_variance
    return (mean * other_variance + other_mean * variance) / total, variance * other_variance / total


class DepthMap:
    """The filter of one keyframe.

    Attributes:
        mean, variance: ``(H, W)`` float32 inverse depth; the variance is infinite where nothing is known.
        failures: ``(H, W)`` int8.
        candidates: ``(H, W)`` bool, pixels with gradient enough.
    """

    def __init__(self, key: Level, config: DepthConfig) -> None:
        self.config, self.key = config, key
        shape = key.grey.shape
        self.mean = np.ones(shape, np.float32)
        self.variance = np.full(shape, np.inf, np.float32)
        self.failures = np.zeros(shape, np.int8)
        strength = key.strength.copy()
        strength[:3], strength[-3:], strength[:, :3], strength[:, -3:] = 0, 0, 0, 0
        least = config.strength
        if (strength > least).sum() > config.pixels:
            least = float(np.partition(strength.ravel(), -config.pixels)[-config.pixels])
        self.candidates = strength > least

    @property
    def valid(self) -> np.ndarray:
        """``(H, W)`` bool: has an inverse depth."""
        return np.isfinite(self.variance)

    def begin(self, inverse_depth: np.ndarray, variance: np.ndarray) -> None:
        """Give candidates that have none an inverse depth ``(H, W)`` with variance ``(H, W)`` (infinite: none)."""
        new = self.candidates & ~self.valid & np.isfinite(variance) & (inverse_depth > 0)
        self.mean[new], self.variance[new], self.failures[new] = inverse_depth[new], variance[new], 0

    @property
    def measured(self) -> np.ndarray:
        """``(H, W)`` bool: known better than a new pixel."""
        return self.variance < (0.6 * self.config.prior * self.mean) ** 2

    def pixels(self) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """``(N, 2)`` float32 pixels that have an inverse depth, and their rows and columns."""
        v, u = np.nonzero(self.valid)
        return np.column_stack([u, v]).astype(np.float32), (v, u)

    def update(self, at: tuple[np.ndarray, np.ndarray], matches: Matches) -> None:
        """Fuse measurements of the pixels ``at`` (rows, columns); those that contradict count as failures."""
        c = self.config
        mean, variance = self.mean[at], self.variance[at] * c.growth
        off = (matches.inverse_depth - mean) ** 2 > c.agree**2 * (variance + matches.variance)
        good, bad = matches.found & ~off, matches.failed | (matches.found & off)
        fused = fuse(mean[good], variance[good], matches.inverse_depth[good], matches.variance[good])
        mean[good], variance[good] = fused
        variance[bad] *= c.growth**10
        failures = self.failures[at]
        failures = np.clip(failures + bad.astype(np.int8) - good.astype(np.int8), -4, 10)
        variance[(failures >= c.failures) | (mean <= 0)] = np.inf
        failures[failures >= c.failures] = 0
        self.mean[at], self.variance[at], self.failures[at] = mean, variance, failures

    def smoothed(self, fill: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means over agreeing neighbours in 5x5 pixels, weighted by inverse variance and distance.

        Args:
            fill: also where there is no inverse depth, from all neighbours.

        Returns:
            inverse depth, variance (the averaged one of the neighbours; infinite where there is none) and how many
            neighbours agreed, ``(H, W)`` each.
        """
        c = self.config
        shape: tuple[int, ...] = self.mean.shape
        v, u = np.nonzero(self.candidates)
        at = v * shape[1] + u
        beside = at[:, None] + (NEIGHBOURS[:, 1] * shape[1] + NEIGHBOURS[:, 0])  # candidates keep off the border
        mean, variance = self.mean.ravel(), self.variance.ravel()
        d, var, d_n, var_n = mean[at], variance[at], mean[beside], variance[beside]
        known, known_n = np.isfinite(var), np.isfinite(var_n)
        agrees = known_n & ((d_n - d[:, None]) ** 2 < c.agree**2 * (var_n + var[:, None]))
        agrees &= known[:, None] | fill
        w_n = np.where(agrees, CLOSENESS, 0)
        ww_n = w_n / var_n
        own = known / var
        total, near = own + ww_n.sum(axis=1), known + w_n.sum(axis=1)
        some = near > 0
        summed = own * d + (ww_n * d_n).sum(axis=1)
        strong = np.where(known, var, 0) + (w_n * np.where(known_n, var_n, 0)).sum(axis=1)
        smooth, spread = np.ones(shape, np.float32), np.full(shape, np.inf, np.float32)
        count = np.zeros(shape, np.int16)
        smooth[v, u] = np.where(some, summed / np.where(some, total, 1), 1)
        spread[v, u] = np.where(some, strong / np.where(some, near, 1), np.inf)
        count[v, u] = agrees.sum(axis=1)
        return smooth, spread, count

    def references(self, levels: list[Level]) -> list[Reference]:
        """Pixels to align with, on every level of the keyframe's pyramid."""
        mean, variance, count = self.smoothed()
        variance = np.where(self.measured & (count >= 2), variance, np.inf)
        out = []
        for level in levels:
            v, u = np.nonzero(np.isfinite(variance))
            if len(v) > self.config.aligned:
                rows = np.linspace(0, len(v) - 1, self.config.aligned).astype(int)
                v, u = v[rows], u[rows]
            fx, fy, cx, cy = level.intrinsics
            rays = np.column_stack([(u - cx) / fx, (v - cy) / fy, np.ones(len(u))]).astype(np.float32)
            out.append(Reference(rays, mean[v, u], variance[v, u], level.grey[v, u]))
            mean, variance = _pooled(mean, variance)
        return out

    def carried(self, T: np.ndarray, key: Level, gain: float, offset: float) -> DepthMap:
        """Depth filter of the next keyframe: this one's estimates, transformed into its view.

        Args:
            T: ``(4, 4)`` this keyframe to the next.
            key: image of the next.
            gain, offset: brightness of the next in terms of this one's.
        """
        c = self.config
        mean, variance, count = self.smoothed()
        v, u = np.nonzero(self.measured & (count >= c.support))
        fx, fy, cx, cy = self.key.intrinsics
        d, var = mean[v, u], self.variance[v, u]
        rays = np.column_stack([(u - cx) / fx, (v - cy) / fy, np.ones(len(u))])
        q = rays @ T[:3, :3].T + d[:, None] * T[:3, 3]
        z = np.maximum(q[:, 2], 1e-3)
        u2, v2 = fx * q[:, 0] / z + cx, fy * q[:, 1] / z + cy
        good = (q[:, 2] > 0.05) & inside(u2, v2, key.grey.shape, 2)
        # A pixel that looks different there is hidden, or was wrong.
        look = np.abs(sample(key.grey, u2, v2) - gain * self.key.grey[v, u] - offset)
        good &= look < 20 + 0.5 * key.strength[np.rint(v2 * good).astype(int), np.rint(u2 * good).astype(int)]
        d2 = (d / z)[good]
        var2 = ((1 / z) ** 4 * var)[good] + c.carry**2 * d2**2
        order = np.argsort(d2, kind="stable")  # the nearest is written last and hides the others
        at = np.rint(v2[good][order]).astype(int), np.rint(u2[good][order]).astype(int)
        new = DepthMap(key, c)
        new.mean[at], new.variance[at] = d2[order], var2[order]
        new.variance[~new.candidates] = np.inf
        if new.valid.any():
            filled, spread, support = new.smoothed(fill=True)
            middle = float(np.median(new.mean[new.valid]))
            wide = (c.prior * filled) ** 2
            new.begin(filled, np.where(support >= 2, np.minimum(4 * spread + (0.1 * filled) ** 2, wide), np.inf))
            new.begin(np.full_like(filled, middle), np.full_like(filled, (c.prior * middle) ** 2))
        return new


def _pooled(mean: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half size: means of 2x2 pixels weighted by inverse variance, with their harmonic mean as variance."""
    height, width = (side // 2 * 2 for side in mean.shape)
    known = np.isfinite(variance)
    weight = np.where(known, 1 / np.where(known, variance, 1), 0)

    def blocks(values: np.ndarray) -> np.ndarray:
        return values[:height, :width].reshape(height // 2, 2, width // 2, 2).sum(axis=(1, 3))

    total, count = blocks(weight), blocks(known.astype(np.float32))
    some = total > 0
    safe = np.where(some, total, 1)
    return np.where(some, blocks(weight * mean) / safe, 1), np.where(some, count / safe, np.inf)
