"""Grey image pyramids with gradients, and sampling between pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class Level:
    """One level of a pyramid.

    Attributes:
        packed: ``(H, W, 3)`` float32: intensity (0 to 255), its derivatives along u and v (per pixel).
        grey: ``(H, W)`` float32 intensity alone.
        intrinsics: ``(4,)`` float64 fx fy cx cy of this level.
    """

    packed: np.ndarray
    grey: np.ndarray
    intrinsics: np.ndarray

    @property
    def strength(self) -> np.ndarray:
        """``(H, W)`` length of the gradient."""
        return np.hypot(self.packed[:, :, 1], self.packed[:, :, 2])


def pyramid(grey: np.ndarray, intrinsics: np.ndarray, levels: int) -> list[Level]:
    """Finest first; every further level has half the width and height (area average), down to 12 pixels.

    Args:
        grey: ``(H, W)`` float32, at least 12x12.
        intrinsics: fx fy cx cy of it.
    """
    out = [_level(np.ascontiguousarray(grey, np.float32), np.asarray(intrinsics, np.float64))]
    while len(out) < levels and min(out[-1].grey.shape) >= 24:
        height, width = out[-1].grey.shape
        size = (width // 2, height // 2)
        scale = np.array([size[0] / width, size[1] / height])
        fc = out[-1].intrinsics
        finer = np.concatenate([fc[:2] * scale, (fc[2:] + 0.5) * scale - 0.5])
        out.append(_level(cv2.resize(out[-1].grey, size, interpolation=cv2.INTER_AREA), finer))
    return out


def _level(grey: np.ndarray, intrinsics: np.ndarray) -> Level:
    along_u, along_v = (cv2.Sobel(grey, cv2.CV_32F, *order, ksize=1, scale=0.5) for order in ((1, 0), (0, 1)))
    return Level(np.ascontiguousarray(np.dstack([grey, along_u, along_v])), grey, intrinsics)


def inside(u: np.ndarray, v: np.ndarray, shape: tuple[int, ...], margin: float = 0.0) -> np.ndarray:
    """True where pixels lie in the image, ``margin`` from its edge; False for nan."""
    right, bottom = shape[1] - 1 - margin, shape[0] - 1 - margin
    return (u >= margin) & (u <= right) & (v >= margin) & (v <= bottom)


def sample(values: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear values ``(...)`` or ``(..., C)`` of ``(H, W)`` or ``(H, W, C)`` at pixels ``(...)``; edges are repeated.

    (``cv2.remap`` rounds positions to a 32nd of a pixel, which is coarser than an alignment.)
    """
    height, width = values.shape[:2]
    u = np.clip(np.nan_to_num(u), 0, width - 1.001).astype(np.float32)
    v = np.clip(np.nan_to_num(v), 0, height - 1.001).astype(np.float32)
    left, top = u.astype(np.int32), v.astype(np.int32)
    right, down = u - left, v - top
    flat = values.reshape(height * width, *values.shape[2:])
    if values.ndim == 3:
        right, down = right[..., None], down[..., None]
    at = top * width + left
    upper = flat[at] * (1 - right) + flat[at + 1] * right
    lower = flat[at + width] * (1 - right) + flat[at + width + 1] * right
    return upper * (1 - down) + lower * down
