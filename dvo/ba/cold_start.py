"""Damping of the first steps without a starting point, and a solver for that case.

From identity poses and constant depth, rotation and sideways translation explain the flow almost equally well. An
undamped first step takes a huge difference of the two, and the depths then settle on the wrong side of it (the
bas-relief ambiguity). Damping relative to the diagonal of the reduced system holds such directions back until the
depths have begun to tell them apart. With exact targets, 8 frames and 10 updates of 2 steps, about half of rendered
clips ended within 2 % of the rotation without this, and nine tenths with it (``tests/train/test_objective.py``).
"""

from __future__ import annotations

import torch
from torch import Tensor

from dvo.ba.layer import bundle_adjust
from dvo.ba.options import BADamping, BAOptions
from dvo.geometry import se3
from dvo.geometry.projection import reproject

COLD_UPDATES = 4
"""Updates of a new graph that are damped strongly."""


def damping_at(update: int) -> BADamping:
    """Damping of bundle adjustment at the given update of a graph, counted from 0."""
    return BADamping(relative=0.1) if update < COLD_UPDATES else BADamping()


_FAR = 1e-3  # inverse depth at which translation moves nothing
_REACH = 5.0  # residual, in pixels, above which an edge counts as an outlier in the comparison of solutions


def robust_cost(
    poses_cw: Tensor, patches: Tensor, intrinsics: Tensor, targets: Tensor, weights: Tensor, ii: Tensor, jj: Tensor,
    kk: Tensor,
) -> Tensor:  # fmt: skip
    """Weighted mean residual ``(B,)`` of the patch centres, pixels, each edge at most 5."""
    c = patches.shape[-1] // 2
    seen = reproject(poses_cw, patches, intrinsics, ii, jj, kk).coords[:, :, c, c]
    residual = (weights * (targets - seen)).norm(dim=-1).clamp(max=_REACH)
    return residual.sum(1) / weights.norm(dim=-1).sum(1).clamp(min=1e-9)


def solve_from_nothing(
    patches: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    *,
    updates: int = 10,
    bounds: tuple[float, float] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Bundle adjustment without a starting point: the better of two ways to begin.

    One begins with poses and depths together under strong damping; the other finds the rotations first, as if
    everything were far away. They fail on different clips, and
    the residual alone tells which one is right (``tests/train/test_objective.py``).

    Args:
        patches: ``(B, K, 3, p, p)``; only ``x, y`` are used, depths begin at 1.
        intrinsics: ``(B, N, 4)``.
        targets, weights: ``(B, E, 2)``.
        ii, jj, kk: ``(E,)`` edges.
        updates: calls of bundle adjustment for each way.
        bounds: see :func:`dvo.ba.layer.bundle_adjust`.

    Returns:
        ``poses_cw (B, N, 7)``, the first the identity; ``patches``; the cost ``(B,)`` of :func:`robust_cost`.
    """
    b, n = intrinsics.shape[:2]
    edges = (ii, jj, kk)
    best: tuple[Tensor, Tensor, Tensor] | None = None
    start = patches.clone()
    start[:, :, 2] = 1.0
    for rotations_first in (False, True):
        poses, now = se3.identity(b, n, dtype=patches.dtype, device=patches.device), start
        if rotations_first:
            far = start.clone()
            far[:, :, 2] = _FAR
            for _ in range(2):
                options = BAOptions(motion_only=True, bounds=bounds)
                poses = bundle_adjust(poses, far, intrinsics, targets, weights, *edges, options).poses_cw
            poses = torch.cat([torch.zeros_like(poses[..., :3]), poses[..., 3:]], -1)
        for update in range(updates):
            options = BAOptions(damping=damping_at(update), bounds=bounds)
            result = bundle_adjust(poses, now, intrinsics, targets, weights, *edges, options)
            poses, now = result.poses_cw, result.patches
        cost = robust_cost(poses, now, intrinsics, targets, weights, *edges)
        if best is None:
            best = poses, now, cost
        else:
            better = (cost < best[2])[:, None, None]
            best = (
                torch.where(better, poses, best[0]),
                torch.where(better[..., None, None], now, best[1]),
                torch.minimum(cost, best[2]),
            )
    assert best is not None
    return best
