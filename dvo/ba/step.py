"""One damped Gauss-Newton step as a differentiable function.

Forward assembles ``H delta = g`` without recording a graph. Backward needs only one more solve with the same factor:
for the incoming gradient ``c`` and ``H lambda = c``, the derivative of the step by anything that H and g depend on is that of

    phi = lambda^T (g - H delta) = sum over edges of  w (J lambda) . (r - J delta)

with ``lambda`` and ``delta`` held still (implicit function theorem). ``J lambda`` is a directional derivative, so phi is a
short formula for each edge, and autograd through it is all that is left. The diagonal that the damping is relative to is
treated as a constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dvo.ba.edges import EdgePlan
from dvo.ba.normal_equations import Gate, accumulate, relative_motion, view
from dvo.ba.schur import SchurFactor, eliminate
from dvo.geometry import se3, so3
from dvo.geometry.precision import full_precision


@dataclass(frozen=True)
class BADamping:
    """Damping of one Gauss-Newton step; the same constants serve training and tracking.

    Attributes:
        pose: added to the diagonal of the reduced pose system, in weighted pixels squared per unit squared.
        relative: this fraction of that diagonal is added too.
        depth: added to the curvature of each inverse depth.
    """

    pose: float = 0.1
    relative: float = 1e-4
    depth: float = 1e-4


@dataclass(frozen=True)
class StepSetting:
    """What a step is told besides tensors with gradients; see :func:`dvo.ba.layer.bundle_adjust`."""

    plan: EdgePlan
    gate: Gate
    slot: Tensor
    free: int
    damping: BADamping
    move_poses: bool
    move_depths: bool

    def spread(self, dp: Tensor) -> Tensor:
        """Tangents of the free frames ``(B, 6n)`` to tangents of all ``(B, N, 6)``, zero for the fixed ones."""
        rows = torch.nn.functional.pad(dp.view(len(dp), -1, 6), (0, 0, 0, self.free + 1 - dp.shape[1] // 6))
        return rows.index_select(1, self.slot)


class GaussNewtonStep(torch.autograd.Function):
    """``(setting, poses_cw, inverse_depth, rays, target, weight, depth value, depth weight, prior poses, pose weight)``
    to the steps ``(B, 6n)`` of the free poses and ``(B, K)`` of the inverse depths. The four priors may be None."""

    @staticmethod
    def forward(ctx: Any, setting: StepSetting, *inputs: Tensor | None) -> tuple[Tensor, Tensor]:
        poses_cw, inverse_depth, rays, target, weight, d_value, d_weight, p_value, p_weight = inputs
        assert poses_cw is not None and inverse_depth is not None
        assert rays is not None and target is not None and weight is not None
        damping, free = setting.damping, setting.free
        system, used = accumulate(
            poses_cw, inverse_depth, rays, target, weight, setting.plan, setting.gate, setting.slot, free,
            setting.move_poses, setting.move_depths,
        )  # fmt: skip
        h_pp, g_p, g_l = system.h_pp, system.g_p, system.g_l
        h_ll = system.h_ll + damping.depth
        if d_value is not None and d_weight is not None:
            h_ll = h_ll + d_weight[..., None, None]
            g_l = g_l + (d_weight * (d_value - inverse_depth))[..., None]
        if p_value is not None and p_weight is not None and setting.move_poses:
            rows = torch.zeros_like(poses_cw[:, :1, :6]).repeat(1, free + 1, 1)
            residual = se3.log(se3.relative(poses_cw, p_value))
            h_pp = h_pp + torch.diag_embed(rows.index_add(1, setting.slot, p_weight)[:, :free].flatten(1))
            g_p = g_p + rows.index_add(1, setting.slot, p_weight * residual)[:, :free].flatten(1)
        if not setting.move_depths:
            h_ll = torch.zeros_like(h_ll)  # as if nothing observed them: they get no step
        solver = eliminate(h_pp, system.h_pl, h_ll, damping.pose, damping.relative)
        dp, dl = solver.solve(g_p, g_l)
        ctx.setting, ctx.used = setting, used
        ctx.save_for_backward(*inputs, solver.h_pl, solver.q, solver.factor, solver.ok, dp, dl)
        return dp, dl[..., 0]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, h_pl, q, factor, ok, dp, dl = ctx.saved_tensors
        setting: StepSetting = ctx.setting
        out: list[Tensor | None] = [None] * len(inputs)
        needed = [i for i, x in enumerate(inputs) if x is not None and ctx.needs_input_grad[i + 1]]
        with full_precision(dp.device):
            lp, ll = SchurFactor(h_pl, q, factor, ok).solve(grads[0], grads[1][..., None])
            directions = (setting.spread(lp), setting.spread(dp), ll[..., 0], dl[..., 0])
            for i, gradient in zip(needed, _adjoint(setting, ctx.used, inputs, needed, directions), strict=True):
                out[i] = gradient
        return None, *out


def _adjoint(
    setting: StepSetting,
    used: list[Tensor],
    inputs: list[Tensor | None],
    needed: list[int],
    directions: tuple[Tensor, ...],
) -> list[Tensor | None]:
    """Gradient of phi by the inputs that need one. Chunk by chunk, so that only one chunk's graph is alive."""
    found: list[Tensor | None] = [None] * len(needed)
    if not needed:
        return found
    with torch.enable_grad():
        leaves = [None if x is None else x.detach().requires_grad_(i in needed) for i, x in enumerate(inputs)]
        if any(x is not None for x in inputs[5:]):
            found = _gradients(_prior_terms(setting, leaves, directions), leaves, needed)
        for part, use in zip(setting.plan.chunks(), used, strict=True):
            more = _gradients(_edge_terms(setting, leaves, directions, part, use), leaves, needed)
            found = [a if b is None else b if a is None else a + b for a, b in zip(found, more, strict=True)]
    return found


def _gradients(term: Tensor, leaves: list[Tensor | None], needed: list[int]) -> list[Tensor | None]:
    wanted = [leaves[i] for i in needed]
    if not term.requires_grad:
        return [None] * len(wanted)
    return list(torch.autograd.grad(term, wanted, allow_unused=True))  # type: ignore[arg-type]


def _prior_terms(setting: StepSetting, leaves: list[Any], directions: tuple[Tensor, ...]) -> Tensor:
    """The part of phi that comes from the priors."""
    poses_cw, inverse_depth, _, _, _, d_value, d_weight, p_value, p_weight = leaves
    lp, dp, ll, dl = directions
    total = ll.new_zeros(())
    if d_value is not None:
        total = total + (ll * d_weight * (d_value - inverse_depth - dl)).sum()
    if p_value is not None and setting.move_poses:
        total = total + (lp * p_weight * (se3.log(se3.relative(poses_cw, p_value)) - dp)).sum()
    return total


def _edge_terms(
    setting: StepSetting, leaves: list[Any], directions: tuple[Tensor, ...], part: slice, use: Tensor
) -> Tensor:
    """The part of phi that comes from the edges of a slice of groups."""
    plan = setting.plan
    poses_cw, inverse_depth, rays, target, weight = leaves[:5]
    lp, dp, ll, dl = directions
    group = plan.group_pair[part]
    kk = plan.kk[part.start * plan.size : part.stop * plan.size]
    rotation, t = relative_motion(poses_cw, plan)
    # Per pair: the motion of frame j relative to frame i along both directions, xi_j - Ad_ij xi_i
    xi = torch.cat((lp, dp), -1).unflatten(-1, (4, 3)).mT  # columns tau, phi of lambda, then of delta
    moved = rotation @ xi.index_select(1, plan.pair_i)
    rate = xi.index_select(1, plan.pair_j) - moved
    tau = rate[..., 0::2] - so3.hat(t[..., 0]) @ moved[..., 1::2]
    turn = so3.hat(rate[..., 1::2].mT)
    rate = torch.cat((turn, tau.mT[..., None]), -1).flatten(2, 3).index_select(1, group)  # (B, G, 2 x 3, 4)

    depth = inverse_depth.index_select(1, kk).view(len(rays), -1, 1, plan.size)
    motion = t.index_select(1, group)
    v = view(rotation.index_select(1, group), motion, rays[:, part], depth)
    # Velocity of the point over Z, (B, G, 2 directions, 3, M); then of its projection
    velocity = (rate @ torch.cat((v.xy, torch.ones_like(v.h), v.h), 2)).unflatten(2, (2, 3))
    flow = velocity[..., :2, :] - v.xy[:, :, None] * velocity[..., 2:, :]
    if setting.move_depths:
        j_d = (motion[..., :2, :] - v.xy * motion[..., 2:, :]) * v.inv_z
        steps = torch.stack((ll, dl), 1).index_select(2, kk).view(len(rays), 2, -1, plan.size).transpose(1, 2)
        flow = flow + j_d[:, :, None] * steps[..., None, :]
    residual = torch.where(use, target[:, part] - v.xy, 0.0)
    weight = torch.where(use, weight[:, part], 0.0)
    return (weight * flow[:, :, 0] * (residual - flow[:, :, 1])).sum()
