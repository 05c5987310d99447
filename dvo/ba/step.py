"""One damped Gauss-Newton step as a differentiable function.

Forward assembles ``H delta = g`` without recording a graph. Backward needs only one more solve with the same factor,
and the derivative of one scalar; see :mod:`dvo.ba.adjoint`.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dvo.ba.adjoint import gradients, held_still
from dvo.ba.normal_equations import accumulate
from dvo.ba.schur import SchurFactor, eliminate
from dvo.ba.setting import BADamping, StepSetting
from dvo.geometry import se3
from dvo.geometry.precision import full_precision

__all__ = ["BADamping", "GaussNewtonStep", "StepSetting"]


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
            held = held_still(setting, h_pl[..., 0], q[..., 0, 0], lp, dp, ll[..., 0], dl[..., 0])
            for i, gradient in zip(needed, gradients(setting, ctx.used, inputs, needed, held), strict=True):
                out[i] = gradient
        return None, *out
