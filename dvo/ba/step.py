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
from dvo.ba.schur import damped, factorise, invert_blocks, solve_with
from dvo.geometry import se3, so3


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
        h_pp, h_pl, g_p = system.h_pp, system.h_pl[..., 0], system.g_p
        h_ll, g_l = system.h_ll[..., 0, 0] + damping.depth, system.g_l[..., 0]
        if d_value is not None and d_weight is not None:
            h_ll, g_l = h_ll + d_weight, g_l + d_weight * (d_value - inverse_depth)
        if p_value is not None and p_weight is not None and setting.move_poses:
            rows = torch.zeros_like(poses_cw[:, :1, :6]).repeat(1, free + 1, 1)
            residual = se3.log(se3.relative(poses_cw, p_value))
            h_pp = h_pp + torch.diag_embed(rows.index_add(1, setting.slot, p_weight)[:, :free].flatten(1))
            g_p = g_p + rows.index_add(1, setting.slot, p_weight * residual)[:, :free].flatten(1)
        q = invert_blocks(h_ll[..., None, None])[..., 0, 0] if setting.move_depths else torch.zeros_like(h_ll)
        eliminated = h_pl * q[:, None]
        reduced = damped(h_pp - eliminated @ h_pl.mT, damping.pose, damping.relative)
        factor, ok = factorise(reduced)
        dp = solve_with(factor, ok, g_p - (eliminated @ g_l[..., None])[..., 0])
        dl = q * (g_l - (h_pl.mT @ dp[..., None])[..., 0])
        ctx.setting, ctx.used = setting, used
        ctx.save_for_backward(*inputs, factor, ok, h_pl, q, dp, dl)
        return dp, dl

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, factor, ok, h_pl, q, dp, dl = ctx.saved_tensors
        setting: StepSetting = ctx.setting
        needed = [i for i, x in enumerate(inputs) if x is not None and ctx.needs_input_grad[i + 1]]
        out: list[Tensor | None] = [None] * len(inputs)
        if not needed:
            return None, *out
        lp = solve_with(factor, ok, grads[0] - ((h_pl * q[:, None]) @ grads[1][..., None])[..., 0])
        ll = q * (grads[1] - (h_pl.mT @ lp[..., None])[..., 0])
        directions = (setting.spread(lp), setting.spread(dp), ll, dl)
        with torch.enable_grad():
            leaves = [None if x is None else x.detach().requires_grad_(i in needed) for i, x in enumerate(inputs)]
            terms = [_prior_terms(setting, leaves, directions)]
            found = _gradients(terms, leaves, needed)
            for part, use in zip(setting.plan.chunks(), ctx.used, strict=True):
                more = _gradients([_edge_terms(setting, leaves, directions, part, use)], leaves, needed)
                found = [a if b is None else b if a is None else a + b for a, b in zip(found, more, strict=True)]
        for i, gradient in zip(needed, found, strict=True):
            out[i] = gradient
        return None, *out


def _gradients(terms: list[Tensor], leaves: list[Tensor | None], needed: list[int]) -> list[Tensor | None]:
    wanted = [leaves[i] for i in needed]
    terms = [x for x in terms if x.requires_grad]
    if not terms:
        return [None] * len(wanted)
    return list(torch.autograd.grad(terms, wanted, allow_unused=True))  # type: ignore[arg-type]


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
    xi = torch.stack((lp, dp), -1)
    xi_i, xi_j = xi.index_select(1, plan.pair_i), xi.index_select(1, plan.pair_j)
    phi_i = rotation @ xi_i[..., 3:, :]
    tau = xi_j[..., :3, :] - rotation @ xi_i[..., :3, :] - so3.cross(t.expand_as(phi_i), phi_i, dim=-2)
    turn = so3.hat((xi_j[..., 3:, :] - phi_i).mT)  # (B, P, 2, 3, 3)
    o = torch.zeros_like(t)
    tt = torch.stack((torch.cat((t, o), -1), torch.cat((o, t), -1)), 2)  # (B, P, 2, 3, 2)
    rate = torch.cat((turn, tau.mT[..., None], tt), -1).flatten(2, 3).index_select(1, group)  # (B, G, 6, 6)

    depth = inverse_depth.index_select(1, kk).view(len(rays), -1, 1, plan.size)
    v = view(rotation.index_select(1, group), t.index_select(1, group), rays[:, part], depth)
    steps = torch.stack((ll, dl), 1).index_select(2, kk).view(len(rays), 2, -1, plan.size).transpose(1, 2)
    # Velocity of the point over Z, (B, G, 2 directions, 3, M); then of its projection
    velocity = rate @ torch.cat((v.xy, torch.ones_like(v.h), v.h, steps * v.inv_z), 2)
    velocity = velocity.unflatten(2, (2, 3))
    flow = velocity[..., :2, :] - v.xy[:, :, None] * velocity[..., 2:, :]
    residual = torch.where(use, target[:, part] - v.xy, 0.0)
    weight = torch.where(use, weight[:, part], 0.0)
    return (weight * flow[:, :, 0] * (residual - flow[:, :, 1])).sum()
