"""Frame that surroundings are drawn over, and the textures and outlines that they are drawn with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from dvo.geometry import se3
from dvo.geometry.camera import Camera

Array = np.ndarray


@dataclass(frozen=True)
class Canvas:
    """Frame to draw over.

    Attributes:
        image: ``(H, W, 3)`` float RGB in [0, 1]; changed in place.
        depth: ``(H, W)`` along the optical axis, metres; inf where nothing is.
        pose_wc: ``(7,)`` camera to world, z up.
        camera: intrinsics.
        time: seconds.
    """

    image: Array
    depth: Array
    pose_wc: Array
    camera: Camera
    time: float

    def rays(self) -> Array:
        """``(H, W, 3)`` rays of the pixel centres in the world, of depth one."""
        height, width = self.depth.shape
        y, x = np.mgrid[0:height, 0:width]
        camera = self.camera
        rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones((height, width))], -1)
        return rays @ self.rotation.T

    @property
    def rotation(self) -> Array:
        """``(3, 3)`` camera to world."""
        return np.asarray(se3.matrix(torch.from_numpy(np.asarray(self.pose_wc, np.float64))))[:3, :3]


Drawing = Callable[[Canvas], Array]
"""Draws over an image, and gives the pixels ``(H, W)`` bool that it covers."""


@dataclass(frozen=True)
class Style:
    """Textures and outlines. Training clips have others than sequences, so that no suite shows what was trained on.

    Attributes:
        training: blocks and stripes in place of smooth noise, and outlines that are no ellipses.
    """

    training: bool = False

    def texture(self, rng: np.random.Generator, size: int, rows: tuple[int, ...]) -> Array:
        """``(size, size)`` float32 texture that repeats, in [0, 1]: the mean of levels with these numbers of cells.

        Args:
            rng: of the levels.
            size: pixels.
            rows: cells of each level along a side.
        """
        total = np.zeros((size, size), np.float32)
        for cells in rows:
            total += self._level(rng, size, cells) / len(rows)
        return total.clip(0, 1)

    def _level(self, rng: np.random.Generator, size: int, cells: int) -> Array:
        if self.training and rng.random() < 0.5:
            y, x = np.mgrid[0:size, 0:size] / size
            across, along = rng.integers(-cells, cells + 1, 2)
            return (0.5 + 0.5 * np.sin(2 * np.pi * (across * x + along * y) + rng.uniform(0, 6.3))).astype(np.float32)
        level, step = rng.random((cells, cells)).astype(np.float32), size // cells
        if self.training:
            return cv2.resize(level, (size, size), interpolation=cv2.INTER_NEAREST)
        large = cv2.resize(np.pad(level, 2, mode="wrap"), (step * (cells + 4),) * 2, interpolation=cv2.INTER_CUBIC)
        return cv2.resize(large[2 * step : -2 * step, 2 * step : -2 * step], (size, size))

    def power(self, rng: np.random.Generator) -> float:
        """Exponent p of the outline |x|^p + |y|^p = 1: 2 for an ellipse, 1 for a rhombus, large for a rectangle.

        Args:
            rng: of the choice.
        """
        return float(rng.choice([0.8, 1.0, 1.3, 4.0, 8.0])) if self.training else 2.0


def lookup(texture: Array, x: Array, y: Array) -> Array:
    """Values of a texture that repeats with period one, between its pixels.

    Args:
        texture: ``(N, N)``.
        x, y: ``(H, W)`` coordinates.
    """
    size = len(texture)
    wrapped = np.pad(texture, ((0, 1), (0, 1)), mode="wrap")
    u, v = (((value % 1.0) * size).astype(np.float32) for value in (x, y))
    return cv2.remap(wrapped, u, v, cv2.INTER_LINEAR)


def within(a: Array, b: Array, power: float) -> Array:
    """Whether points are inside of an outline, see :meth:`Style.power`.

    Args:
        a, b: coordinates in units of the half axes.
        power: exponent.
    """
    if power == 2.0:
        return np.asarray(a * a + b * b < 1)
    return np.asarray(np.abs(a) ** power + np.abs(b) ** power < 1)
