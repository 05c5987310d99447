"""Start from two views: corners followed by KLT, essential matrix, and the inverse depths of the corners spread out.

LSD-SLAM starts from random depths and needs a second or two of favourable motion to get over them; two views give the
first keyframe a depth that is right from the start.
"""

from __future__ import annotations

import numpy as np
import torch

from dvo.odometry.classical import two_view
from dvo.odometry.classical.klt import detect, follow

CORNERS, WINDOW, LEVELS, CLOSED, EPIPOLAR = 400, 15, 4, 0.7, 1.0
"""Number of corners, patch side, pyramid levels, forward-backward tolerance and inlier distance (pixels)."""


class TwoViewStart:
    """Corners of a first image, followed from image to image.

    Attributes:
        frame: position of the first image in the sequence.
        first, uv: ``(N, 2)`` float32 where the corners that are left were and are.
        begun: how many there were.
    """

    def __init__(self, grey: np.ndarray, frame: int) -> None:
        self.frame, self._grey = frame, grey
        spacing = 0.4 * float(np.sqrt(grey.size / CORNERS))
        self.first = self.uv = detect(grey, np.zeros((0, 2)), CORNERS, quality=0.001, spacing=spacing)
        self.begun = len(self.first)

    def follow(self, grey: np.ndarray, intrinsics: np.ndarray) -> np.ndarray | None:
        """Carry the corners into the next image ``(H, W)`` uint8; the rotation ``(3, 3)`` since the last, or None if
        too few are left."""
        uv, held = follow(self._grey, grey, self.uv, window=WINDOW, levels=LEVELS, tolerance=CLOSED)
        if held.sum() < 12:
            return None
        turn = two_view.rotation_between(self.uv[held], uv[held], intrinsics)
        self._grey, self.first, self.uv = grey, self.first[held], uv[held]
        return turn

    @property
    def worn(self) -> bool:
        """Too few corners of the first image are left for a start."""
        return len(self.uv) < max(0.4 * self.begun, 40)

    def solve(
        self, intrinsics: np.ndarray, parallax: float, seed: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Motion and inverse depths, if the images are ``parallax`` pixels apart after rotation.

        Returns:
            ``T_21 (4, 4)`` with the translation scaled so that the median depth is 1, pixels ``(M, 2)`` in the first
            image and their inverse depths ``(M,)``; or None.
        """
        pair = two_view.relative_pose(self.first, self.uv, intrinsics, EPIPOLAR, seed)
        if pair is None or pair.parallax < parallax:
            return None
        camera_two = -pair.T_21[:3, :3].T @ pair.T_21[:3, 3]
        ones = np.ones(len(self.first))
        terms = two_view.ray_terms(two_view.rays(self.first, intrinsics), np.zeros(3), ones)
        terms += two_view.ray_terms(two_view.rays(self.uv, intrinsics) @ pair.T_21[:3, :3], camera_two, ones)
        points = two_view.solve_points(terms)
        here, depth = two_view.project(points, np.eye(4), intrinsics)
        there, beyond = two_view.project(points, pair.T_21, intrinsics)
        with np.errstate(invalid="ignore"):
            good = pair.inliers & (depth > 0) & (beyond > 0)
            good &= (np.linalg.norm(here - self.first, axis=1) < 1.5) & (np.linalg.norm(there - self.uv, axis=1) < 1.5)
        if good.sum() < max(40, 0.5 * len(good)):
            return None
        T = pair.T_21.copy()
        middle = float(np.median(depth[good]))
        T[:3, 3] /= middle
        return T, self.first[good], middle / depth[good]


def spread(uv: np.ndarray, inverse_depth: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth and variance of every pixel ``(H, W)`` from the five nearest of some corners.

    The mean, with the square of their standard deviation and of a fifth of the mean as the variance.
    """
    height, width = shape[:2]
    places, found = torch.from_numpy(np.asarray(uv, np.float32)), torch.from_numpy(np.asarray(inverse_depth))
    mean, variance = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for v in range(height):  # a row at a time bounds the memory
        row = torch.stack([torch.arange(width, dtype=torch.float32), torch.full((width,), float(v))], 1)
        rows = torch.cdist(row, places).topk(min(5, len(places)), largest=False).indices
        nearest = found[rows]
        mean[v] = nearest.mean(1).numpy()
        variance[v] = nearest.var(1, correction=0).numpy() + (0.2 * mean[v]) ** 2
    return mean, variance
