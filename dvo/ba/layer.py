"""The differentiable dense bundle adjustment layer.

Unknowns are camera poses and one inverse depth per patch; measurements are where each patch centre is seen in other
frames. Residual of an edge (i, j, k): ``r = target - project(T_j T_i^-1 backproject(patch k))``, weighted by a
2-vector. Each iteration is a damped Gauss-Newton step without acceptance test, hence differentiable from end to end:
linearise with analytic Jacobians, eliminate the depths, solve for the poses, substitute back, retract. (Tang and
Tan, "BA-Net", 2019; Teed et al., "Deep Patch Visual Odometry", 2023.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dvo.ba.edges import EdgePlan, free_slots, plan_edges
from dvo.ba.normal_equations import MARGIN, Gate
from dvo.ba.setting import BADamping, StepSetting
from dvo.ba.step import GaussNewtonStep
from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.precision import full_precision


@dataclass(frozen=True)
class DepthPrior:
    """Adds ``weight (d - value)^2`` for each patch: ``value``, ``weight`` ``(B, K)`` or broadcastable to it."""

    value: Tensor
    weight: Tensor


@dataclass(frozen=True)
class PosePrior:
    """Adds ``weight . Log(prior T^-1)^2``: ``poses_cw (B, N, 7)``, ``weight (B, N, 6)`` or broadcastable to it."""

    poses_cw: Tensor
    weight: Tensor


def bundle_adjust(
    poses_cw: Tensor,
    patches: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    *,
    fixed: int | Tensor | Sequence[bool] = 1,
    iterations: int = 2,
    damping: BADamping = BADamping(),  # noqa: B008 (frozen)
    structure_only: bool = False,
    motion_only: bool = False,
    bounds: tuple[float, float] | None = None,
    max_residual: float = 128.0,
    depth_range: tuple[float, float] = (1e-3, 10.0),
    depth_prior: DepthPrior | None = None,
    pose_prior: PosePrior | None = None,
    plan: EdgePlan | None = None,
) -> tuple[Tensor, Tensor]:
    """Refine poses and inverse depths so that the patches project onto their targets.

    Gradients flow to poses, patches, intrinsics, targets and weights, through all iterations. Neither the result nor a
    gradient is ever NaN for finite input: an edge whose point is not in front of frame j (``Z <= 0.2``), whose residual
    is too long, or which leaves the bounds counts for nothing in that iteration, and where the system cannot be solved
    the step is zero.

    Args:
        poses_cw: ``(B, N, 7)`` world to camera.
        patches: ``(B, K, 3, p, p)`` x, y (feature-map pixels) and inverse depth; all pixels of a patch share the one
            of its centre.
        intrinsics: ``(B, N, 4)`` fx fy cx cy in the same pixels.
        targets: ``(B, E, 2)`` where the patch centres are seen, pixels of frame j.
        weights: ``(B, E, 2)`` confidence per axis, not negative.
        ii, jj, kk: ``(E,)`` source frame, target frame and patch of each edge, in any order, shared by the batch.
        fixed: how many leading poses stay, or which: bool ``(N,)``.
        iterations: number of Gauss-Newton steps.
        damping: see :class:`BADamping`.
        structure_only: poses stay. motion_only: inverse depths stay.
        bounds: ``(width, height)`` of the feature map; a projection more than 64 px outside does not count.
        max_residual: pixels; an edge with a longer residual does not count.
        depth_range: inverse depths are clamped to it.
        depth_prior, pose_prior: optional quadratic priors.
        plan: what :func:`plan_edges` made of ``ii, jj, kk``, to save doing it again for a graph that does not change.

    Returns:
        New ``poses_cw`` and ``patches``.

    Raises:
        DvoError: shapes that do not belong together.
    """
    _check(poses_cw, patches, intrinsics, targets, weights, ii, jj, kk)
    dtype = poses_cw.dtype
    if dtype in (torch.float16, torch.bfloat16):
        dtype = torch.float32
    with full_precision(poses_cw.device):
        poses_cw, patches, intrinsics, targets, weights = (
            x.to(dtype) for x in (poses_cw, patches, intrinsics, targets, weights)
        )
        centre = patches.shape[-1] // 2
        inverse_depth = patches[:, :, 2, centre, centre]
        batch, frames, count = len(poses_cw), poses_cw.shape[1], patches.shape[1]
        slot, free = free_slots(fixed, frames, poses_cw.device)
        move_poses, move_depths = not structure_only and free > 0, not motion_only
        if plan is None:
            plan = plan_edges(ii, jj, kk, frames, count)
        rays, target, weight, gate = _measurements(
            patches[:, :, :2, centre, centre], intrinsics, targets, weights, plan, max_residual, bounds
        )
        priors: list[Tensor | None] = [None] * 4
        if depth_prior is not None:
            priors[:2] = (x.to(inverse_depth).expand(batch, count) for x in (depth_prior.value, depth_prior.weight))
        if pose_prior is not None:
            priors[2] = pose_prior.poses_cw.to(poses_cw).expand(batch, frames, 7)
            priors[3] = pose_prior.weight.to(poses_cw).expand(batch, frames, 6)
        setting = StepSetting(plan, gate, slot, free, damping, move_poses, move_depths)
        stays = (slot == free)[:, None]
        for _ in range(iterations if move_poses or move_depths else 0):
            dp, dl = GaussNewtonStep.apply(setting, poses_cw, inverse_depth, rays, target, weight, *priors)
            if move_poses:
                poses_cw = torch.where(stays, poses_cw, se3.retract(poses_cw, setting.spread(dp)))
            if move_depths:
                inverse_depth = (inverse_depth + dl).clamp(*depth_range)
        if move_depths:
            row = inverse_depth[:, :, None, None, None].expand_as(patches[:, :, :1])
            patches = torch.cat((patches[:, :, :2], row), 2)
        return poses_cw, patches


def _check(
    poses_cw: Tensor, patches: Tensor, intrinsics: Tensor, targets: Tensor, weights: Tensor, *edges: Tensor
) -> None:
    """Shapes only: looking at the indices would make an accelerator wait."""
    b, n = poses_cw.shape[:2] if poses_cw.dim() == 3 else (-1, -1)
    count = len(edges[0])
    wanted: dict[str, tuple[Tensor, tuple[int, ...]]]
    wanted = {"poses_cw": (poses_cw, (b, n, 7)), "intrinsics": (intrinsics, (b, n, 4))}
    wanted |= {"targets": (targets, (b, count, 2)), "weights": (weights, (b, count, 2))}
    wanted |= {name: (x, (count,)) for name, x in zip(("ii", "jj", "kk"), edges, strict=True)}
    if patches.dim() == 5:
        wanted["patches"] = (patches, (b, patches.shape[1], 3, *patches.shape[3:]))
    else:
        wanted["patches"] = (patches, (b, -1, 3, -1, -1))
    for name, (tensor, shape) in wanted.items():
        if tensor.shape != shape:
            raise DvoError(
                f"has shape {tuple(tensor.shape)}, not {shape}", field=name, remedy="see the help of bundle_adjust"
            )


def _measurements(
    xy: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    plan: EdgePlan,
    max_residual: float,
    bounds: tuple[float, float] | None,
) -> tuple[Tensor, Tensor, Tensor, Gate]:
    """Rays ``(B, G, 3, M)``, targets and weights ``(B, G, 2, M)``, laid out by group, in normalised coordinates."""
    shape = (len(xy), plan.groups, plan.size, 2)
    f_i, c_i = intrinsics.index_select(1, plan.pair_i[plan.group_pair])[:, :, None].split(2, -1)
    f_j, c_j = intrinsics.index_select(1, plan.pair_j[plan.group_pair])[:, :, None].split(2, -1)
    source = (xy.index_select(1, plan.kk).view(shape) - c_i) / f_i
    rays = torch.cat((source, torch.ones_like(source[..., :1])), -1).mT.contiguous()
    target = (targets.index_select(1, plan.order).view(shape) - c_j) / f_j
    weight = weights.index_select(1, plan.order).view(shape) * (f_j * f_j)
    # A weight that is not finite is none at all; the empty places of a group have none either.
    weight = torch.where(plan.filled[..., None] & torch.isfinite(weight).all(-1, keepdim=True), weight, 0.0)
    gate = Gate(max_residual, f_j.detach().mT)
    if bounds is not None:
        middle = xy.new_tensor(bounds) / 2
        gate = replace(gate, offset=(c_j.detach() - middle).mT, reach=middle[:, None] + MARGIN)
    return rays, target.mT.contiguous(), weight.mT.contiguous(), gate
