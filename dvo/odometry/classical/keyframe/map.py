"""The map: keyframes, the points that they see, and what keeps both few and good."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dvo.odometry.classical import two_view
from dvo.odometry.classical.keyframe.pose import centre, reprojects


@dataclass(eq=False)
class Keyframe:
    """One view that the map keeps.

    Attributes:
        frame: position in the sequence.
        T_cw: ``(4, 4)`` world to camera; bundle adjustment moves it.
        ids: ``(N,)`` landmarks seen, ascending.
        uv: ``(N, 2)`` float32 where.
        grey: ``(H, W)`` uint8.
        features: what relocalisation has computed of the image, by name.
    """

    frame: int
    T_cw: np.ndarray
    ids: np.ndarray
    uv: np.ndarray
    grey: np.ndarray
    features: dict[str, np.ndarray] = field(default_factory=dict)

    def forget(self, gone: np.ndarray) -> None:
        """Drop the observations where ``(N,)`` is True."""
        self.ids, self.uv, self.features = self.ids[~gone], self.uv[~gone], {}


class Map:
    """Keyframes in order of time, and landmarks; a landmark's number is its row.

    Attributes:
        keyframes: oldest first.
        xyz: ``(P, 3)`` world, nan for a landmark without a position.
        colors: ``(P, 3)`` uint8 RGB.
    """

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []
        self.xyz = np.zeros((0, 3))
        self.colors = np.zeros((0, 3), np.uint8)

    def add(self, colors: np.ndarray) -> np.ndarray:
        """New landmarks without position; their numbers."""
        first = len(self.xyz)
        self.xyz = np.concatenate([self.xyz, np.full((len(colors), 3), np.nan)])
        self.colors = np.concatenate([self.colors, colors])
        return np.arange(first, len(self.xyz))

    def known(self, ids: np.ndarray) -> np.ndarray:
        """``(N,)`` bool: has a position."""
        return ~np.isnan(self.xyz[ids, 0])

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions ``(M, 3)`` and colours ``(M, 3)`` of those landmarks that have one."""
        has = ~np.isnan(self.xyz[:, 0])
        return self.xyz[has].astype(np.float32), self.colors[has]

    def shared(self, keyframe: Keyframe) -> np.ndarray:
        """``(K,)`` number of positioned landmarks that each keyframe has in common with this one."""
        seen = np.zeros(len(self.xyz), bool)
        seen[keyframe.ids] = True
        seen &= ~np.isnan(self.xyz[:, 0])
        return np.array([int(seen[other.ids].sum()) for other in self.keyframes])

    def triangulate(self, newest: Keyframe, intrinsics: np.ndarray, angle: float, threshold: float) -> int:
        """Give positions to what the newest keyframe and an older one see under a wide enough angle.

        All views of a landmark count: the point is the one nearest to all of its rays.

        Args:
            angle: degrees, between the newest ray and any older one.
            threshold: largest reprojection error in every view, pixels.

        Returns:
            How many are new.
        """
        ids = newest.ids[~self.known(newest.ids)]
        row = np.full(len(self.xyz), -1)
        row[ids] = np.arange(len(ids))
        normal = np.zeros((len(ids), 3, 4))
        narrowest = np.ones(len(ids))  # cosine of the widest angle
        reference = np.zeros((len(ids), 3))
        views = []
        for keyframe in reversed(self.keyframes):
            if keyframe.frame > newest.frame:
                continue
            at = row[keyframe.ids]
            rows, uv = at[at >= 0], keyframe.uv[at >= 0]
            if not len(rows):
                continue
            rays = two_view.rays(uv, intrinsics) @ keyframe.T_cw[:3, :3]
            unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
            normal[rows] += two_view.ray_terms(unit, centre(keyframe.T_cw), np.ones(len(rows)))
            if keyframe is newest:
                reference[rows] = unit
            narrowest[rows] = np.minimum(narrowest[rows], (unit * reference[rows]).sum(axis=1))
            views.append((keyframe, rows, uv))
        points = two_view.solve_points(normal)
        good = (narrowest < np.cos(np.radians(angle))) & ~np.isnan(points[:, 0])
        for keyframe, rows, uv in views:
            good[rows] &= reprojects(points[rows], uv, intrinsics, keyframe.T_cw, threshold)
        self.xyz[ids[good]] = points[good]
        return int(good.sum())

    def cull_observations(self, keyframes: list[Keyframe], intrinsics: np.ndarray, threshold: float) -> None:
        """Drop what reprojects badly in these keyframes, and positions that fewer than two keyframes hold up."""
        touched = np.zeros(len(self.xyz), bool)
        for keyframe in keyframes:
            known = self.known(keyframe.ids)
            good = reprojects(self.xyz[keyframe.ids], keyframe.uv, intrinsics, keyframe.T_cw, threshold)
            touched[keyframe.ids[known & ~good]] = True
            if (known & ~good).any():
                keyframe.forget(known & ~good)
        self.xyz[touched & (self.views() < 2)] = np.nan

    def views(self) -> np.ndarray:
        """``(P,)`` number of keyframes that see each landmark."""
        count = np.zeros(len(self.xyz), int)
        for keyframe in self.keyframes:
            count[keyframe.ids] += 1
        return count

    def redundant(self, part: float, spared: int) -> Keyframe | None:
        """The oldest keyframe of whose landmarks at least ``part`` are seen by three others; neither the first nor
        the last ``spared``."""
        count = self.views()
        for keyframe in self.keyframes[1 : max(len(self.keyframes) - spared, 1)]:
            ids = keyframe.ids[self.known(keyframe.ids)]
            if len(ids) and (count[ids] >= 4).mean() >= part:
                return keyframe
        return None
