"""True overlap of the views of a rendered sequence, from its depth."""

from __future__ import annotations

import numpy as np

from dvo.geometry.poses import pose_matrices
from dvo.synth.render.renderer import render_depth
from dvo.synth.scenes.bodies import Stage
from dvo.synth.sequence import SyntheticSequence

SIZE = (48, 64)
"""Height and width of the depth maps that are compared."""
STEP = 4
"""Pixels between the pixels that are projected."""
CLOSE = 0.05
"""Relative difference of depth below which two views show the same surface."""


def depth_maps(sequence: SyntheticSequence, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth of some frames at a low resolution.

    Args:
        sequence: rendered; bodies that move are left out.
        indices: ``(N,)`` of the frames.

    Returns:
        ``(N, h, w)`` float32 depth, 0 for none; ``(4,)`` fx fy cx cy of its pixels.
    """
    camera = sequence.camera.resized(SIZE[1], SIZE[0])
    poses = sequence.groundtruth.poses_wc[indices]
    scene = sequence.scene.scene if isinstance(sequence.scene, Stage) else sequence.scene
    maps = [render_depth(scene, pose[None], camera.intrinsics, *SIZE)[0][0].cpu().numpy() for pose in poses]
    return np.stack(maps).astype(np.float32), camera.intrinsics


def shared_view(depth: np.ndarray, intrinsics: np.ndarray, poses_wc: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Share of the view that two frames have in common: the smaller of the shares of their pixels seen by the other.

    Args:
        depth: ``(N, h, w)``, 0 for none.
        intrinsics: ``(4,)`` of its pixels.
        poses_wc: ``(N, 7)`` camera to world.
        pairs: ``(N, N)`` bool, the pairs to compare, symmetric or not.

    Returns:
        ``(N, N)`` float32, 0 for other pairs.
    """
    return np.minimum(*both_shares(depth, intrinsics, poses_wc, pairs))


def both_shares(
    depth: np.ndarray, intrinsics: np.ndarray, poses_wc: np.ndarray, pairs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the pixels of either frame of a pair that the other one sees.

    Args:
        depth, intrinsics, poses_wc, pairs: as for :func:`shared_view`.

    Returns:
        ``(N, N)`` float32 of the pixels of the first frame (row) seen by the second (column), and of the second's seen
        by the first.
    """
    matrices = pose_matrices(poses_wc)
    there = seen_share(depth, intrinsics, matrices, pairs)
    return there, seen_share(depth, intrinsics, matrices, pairs.T).T


def seen_share(depth: np.ndarray, intrinsics: np.ndarray, matrices: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Share of the pixels of the first frame of a pair whose surface the second one sees.

    Args:
        depth, intrinsics, pairs: as for :func:`shared_view`.
        matrices: ``(N, 4, 4)`` camera to world.

    Returns:
        ``(N, N)`` float32.
    """
    count, height, width = depth.shape
    fx, fy, cx, cy = intrinsics
    # Inverse depth is linear over the image of a plane: interpolating it is exact there.
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0)
    v, u = (grid.ravel() for grid in np.mgrid[STEP // 2 : height : STEP, STEP // 2 : width : STEP])
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], -1)
    worlds = np.linalg.inv(matrices)
    shares = np.zeros((count, count), np.float32)
    for first in range(count):
        others = np.flatnonzero(pairs[first])
        hit = depth[first, v, u] > 0
        points = rays[hit] * depth[first, v, u][hit][:, None] @ matrices[first, :3, :3].T + matrices[first, :3, 3]
        local = np.einsum("bij,pj->bpi", worlds[others, :3, :3], points) + worlds[others, None, :3, 3]
        z = np.maximum(local[..., 2], 1e-9)
        x, y = fx * local[..., 0] / z + cx, fy * local[..., 1] / z + cy
        inside = (local[..., 2] > 0) & (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
        other, point = np.nonzero(inside)
        x, y, z = (values[other, point] for values in (x, y, z))
        found = _interpolate(inverse, others[other], x, y)
        shown = np.abs(found * z - 1) < CLOSE
        shares[first, others] = np.bincount(other[shown], minlength=len(others)) / len(rays)
    return shares


def _interpolate(maps: np.ndarray, index: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear values of ``maps (N, h, w)[index]`` at ``x, y``, those of the border beyond it."""
    height, width = maps.shape[1:]
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    a, b = x - left, y - top
    upper = (1 - a) * maps[index, top, left] + a * maps[index, top, left + 1]
    lower = (1 - a) * maps[index, top + 1, left] + a * maps[index, top + 1, left + 1]
    return (1 - b) * upper + b * lower
