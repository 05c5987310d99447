"""Two views and the flow between them: parallax, length of the step, and agreement of the flow with a motion.

Seen from camera ``a``, whose axes are used throughout, camera ``b`` stands at ``s t``, ``t`` of length one. A point of
depth ``Z`` seen by ``a`` at ``x`` (on the plane ``z = 1``) is seen by ``b``, turned into the axes of ``a``, at ``y``
with ``y - x = (s / Z) (y t_z - t_xy)``: the flow without the part of the rotation points along ``y t_z - t_xy``, and
its length tells the step in units of the depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.geometry.poses import pose_matrices

AGREEMENT = 1.0
"""A flow agrees with a motion within this distance from its epipolar line, and with the flow the other way within this
distance from its start; feature pixels, to which a tenth of the length of the flow is added."""

_MIN_Z = 0.1  # smallest z of a turned ray; beyond it the plane z = 1 tells nothing


@dataclass(frozen=True)
class Parallax:
    """Flow of two views without the part of the rotation.

    Attributes:
        motion: ``(M, 2)`` ``y - x`` of the pixels that count, on the plane ``z = 1`` of camera ``a``.
        direction: ``(M, 2)`` ``y t_z - t_xy``, the motion for a step as long as the point is deep.
        length: ``(M,)`` length of the whole flow, feature pixels.
        focal: mean focal length, feature pixels.
    """

    motion: np.ndarray
    direction: np.ndarray
    length: np.ndarray
    focal: float

    def step(self, longest: float) -> float:
        """Length of the step in units of the median depth: the weighted median of the ratios of motion and direction.

        Pixels count as much as a step moves them, so that those near the epipole do not decide.

        Args:
            longest: limit of the result.

        Returns:
            At least 0; a flow that is opposed to the motion counts as one along it, since it tells the length as well.
        """
        weight = np.linalg.norm(self.direction, axis=-1)
        total = weight.sum()
        if not total > 0:
            return 0.0
        ratio = (self.motion * self.direction).sum(-1) / np.maximum(weight**2, 1e-12)
        order = np.argsort(ratio, kind="stable")
        middle = np.searchsorted(np.cumsum(weight[order]), total / 2)
        return float(min(abs(ratio[order][min(middle, len(order) - 1)]), longest))

    def agreement(self) -> float:
        """Share of the flows that lie on their epipolar lines, see :data:`AGREEMENT`.

        Returns:
            In [0, 1]; 0 without a pixel.
        """
        if not len(self.motion):
            return 0.0
        across = self.motion[:, 0] * self.direction[:, 1] - self.motion[:, 1] * self.direction[:, 0]
        distance = np.abs(across) / np.maximum(np.linalg.norm(self.direction, axis=-1), 1e-12) * self.focal
        return float((distance < AGREEMENT + 0.1 * self.length).mean())


def parallax_of(flow: np.ndarray, pose_ab: np.ndarray, intrinsics: np.ndarray) -> Parallax:
    """Remove the rotation from a flow.

    Args:
        flow: ``(2, h, w)`` from image ``a`` to image ``b``, feature pixels.
        pose_ab: ``(7,)`` camera ``b`` in the coordinates of camera ``a``; the length of the translation is ignored.
        intrinsics: ``(4,)`` ``fx fy cx cy``, feature pixels.

    Returns:
        Parallax of all pixels that are finite and, after the rotation, in front of the camera.
    """
    _, h, w = flow.shape
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    columns, rows = np.meshgrid(np.arange(w, dtype=np.float64), np.arange(h, dtype=np.float64))
    dx, dy = flow.astype(np.float64)
    start = np.stack([(columns - cx) / fx, (rows - cy) / fy], -1).reshape(-1, 2)
    end = np.stack([(columns + dx - cx) / fx, (rows + dy - cy) / fy, np.ones((h, w))], -1).reshape(-1, 3)
    matrix = pose_matrices(np.asarray(pose_ab, dtype=np.float64)[None])[0]
    t = matrix[:3, 3] / max(float(np.linalg.norm(matrix[:3, 3])), 1e-12)
    turned = end @ matrix[:3, :3].T
    counts = np.isfinite(turned).all(-1) & (turned[:, 2] > _MIN_Z)
    there = turned[counts, :2] / turned[counts, 2:]
    length = np.hypot(dx, dy).reshape(-1)[counts]
    return Parallax(there - start[counts], there * t[2] - t[:2], length, (fx + fy) / 2)


def returning_share(forward: np.ndarray, backward: np.ndarray) -> float:
    """Share of the pixels that the flow there and the flow back bring home, see :data:`AGREEMENT`.

    Args:
        forward: ``(2, h, w)`` flow from image ``a`` to image ``b``, feature pixels.
        backward: ``(2, h, w)`` flow from image ``b`` to image ``a``.

    Returns:
        In [0, 1]; pixels that leave the image do not return.
    """
    _, h, w = forward.shape
    columns, rows = np.meshgrid(np.arange(w), np.arange(h))
    x, y = columns + forward[0], rows + forward[1]
    inside = np.isfinite(x) & np.isfinite(y) & (x > -0.5) & (x < w - 0.5) & (y > -0.5) & (y < h - 0.5)
    nearest = np.rint(y[inside]).astype(int), np.rint(x[inside]).astype(int)
    there = forward[:, inside]
    miss = np.hypot(*(there + backward[:, nearest[0], nearest[1]]))
    return float((miss < AGREEMENT + 0.1 * np.hypot(*there)).sum() / (h * w))
