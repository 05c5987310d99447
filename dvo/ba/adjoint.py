"""Backward of a Gauss-Newton step.

The step solves ``H delta = g``. For the incoming gradient ``c`` let ``H lambda = c``; then the derivative of the step
by anything that H and g are made of is that of the scalar

    phi = lambda^T (g - H delta) = sum over edges of  w (J lambda) . (r - J delta)

with ``lambda`` and ``delta`` held still (implicit function theorem). ``J lambda`` is a directional derivative, so phi
is a short formula for each edge, and autograd through it is all that is left.

H contains ``relative diag(S)`` of the reduced system ``S = H_pp - E Q E^T``. It adds ``sum s_i S_ii`` to phi, with
``s_i = -relative lambda_i delta_i``. To first order ``S_ii`` changes with ``H_pp`` directly, with E by ``-2 Q E`` and
with the depth curvatures C by ``(Q E)^2``, which are held still too; summed over edges,

    sum over edges of  w (J diag(s) J^T + J_d J e + J_d^2 c),   e_k = -2 s Q_k E_k,   c_k = sum_i s_i (Q_k E_ik)^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dvo.ba.normal_equations import pose_jacobian, relative_motion, view
from dvo.ba.setting import StepSetting
from dvo.geometry import se3, so3
from dvo.geometry.projection import gather


@dataclass(frozen=True)
class Held:
    """What phi holds still.

    Attributes:
        lp, dp: ``(B, N, 6)`` pose parts of lambda and delta. ll, dl: ``(B, K)`` their depth parts.
        s: ``(B, N, 6)``; None if damping is not relative to anything, as are the other two.
        e: ``(B, (n + 1) K, 6)`` by slot and patch, zero for the fixed frames. c: ``(B, K)``.
    """

    lp: Tensor
    dp: Tensor
    ll: Tensor
    dl: Tensor
    s: Tensor | None = None
    e: Tensor | None = None
    c: Tensor | None = None


def held_still(setting: StepSetting, h_pl: Tensor, q: Tensor, lp: Tensor, dp: Tensor, ll: Tensor, dl: Tensor) -> Held:
    """From ``E = h_pl (B, 6n, K)``, ``q (B, K)`` and the parts of lambda and delta, ``(B, 6n)`` and ``(B, K)``."""
    parts = (setting.spread(lp), setting.spread(dp), ll, dl)
    if not setting.move_poses or setting.damping.relative == 0:
        return Held(*parts)
    s = -setting.damping.relative * lp * dp
    qe = h_pl * q[:, None]
    c = (s[:, None] @ (qe * qe))[:, 0]
    e = (-2 * s[..., None] * qe).unflatten(1, (-1, 6)).transpose(2, 3)
    return Held(*parts, setting.spread(s), torch.nn.functional.pad(e, (0, 0, 0, 0, 0, 1)).flatten(1, 2), c)


def gradients(
    setting: StepSetting,
    used: list[Tensor],
    inputs: list[Tensor | None],
    needed: list[int],
    held: Held,
) -> list[Tensor | None]:
    """Gradient of phi by the inputs that need one. Chunk by chunk, so that only one chunk's graph is alive."""
    found: list[Tensor | None] = [None] * len(needed)
    if not needed:
        return found
    with torch.enable_grad():
        leaves = [None if x is None else x.detach().requires_grad_(i in needed) for i, x in enumerate(inputs)]
        if any(x is not None for x in inputs[5:]):
            found = _gradients(_prior_terms(setting, leaves, held), leaves, needed)
        for part, use in zip(setting.plan.chunks(), used, strict=True):
            more = _gradients(_edge_terms(setting, leaves, held, part, use), leaves, needed)
            found = [a if b is None else b if a is None else a + b for a, b in zip(found, more, strict=True)]
    return found


def _gradients(term: Tensor, leaves: list[Tensor | None], needed: list[int]) -> list[Tensor | None]:
    wanted = [leaves[i] for i in needed]
    if not term.requires_grad:
        return [None] * len(wanted)
    return list(torch.autograd.grad(term, wanted, allow_unused=True))  # type: ignore[arg-type]


def _prior_terms(setting: StepSetting, leaves: list[Any], held: Held) -> Tensor:
    """The part of phi that comes from the priors."""
    poses_cw, inverse_depth, _, _, _, d_value, d_weight, p_value, p_weight = leaves
    total = held.ll.new_zeros(())
    if d_value is not None:
        total = total + (held.ll * d_weight * (d_value - inverse_depth - held.dl)).sum()
        if held.c is not None:
            total = total + (held.c * d_weight).sum()
    if p_value is not None and setting.move_poses:
        total = total + (held.lp * p_weight * (se3.log(se3.relative(poses_cw, p_value)) - held.dp)).sum()
        if held.s is not None:
            total = total + (held.s * p_weight).sum()
    return total


def _edge_terms(setting: StepSetting, leaves: list[Any], held: Held, part: slice, use: Tensor) -> Tensor:
    """The part of phi that comes from the edges of a slice of groups."""
    plan, size = setting.plan, setting.plan.size
    poses_cw, inverse_depth, rays, target, weight = leaves[:5]
    b, group = len(rays), plan.group_pair[part]
    kk = plan.kk[part.start * size : part.stop * size]
    rotation, t = relative_motion(poses_cw, plan)
    depth = inverse_depth.index_select(1, kk).view(b, -1, 1, size)
    motion = t.index_select(1, group)
    v = view(rotation.index_select(1, group), motion, rays[:, part], depth)
    j_d = (motion[..., :2, :] - v.xy * motion[..., 2:, :]) * v.inv_z
    residual = torch.where(use, target[:, part] - v.xy, 0.0)
    weight = torch.where(use, weight[:, part], 0.0)
    steps = torch.stack((held.ll, held.dl), 1).index_select(2, kk).view(b, 2, -1, 1, size).transpose(1, 2)
    flow = j_d[:, :, None] * steps  # J lambda and J delta, (B, G, 2 directions, 2 axes, M)
    if not setting.move_poses:
        return (weight * flow[:, :, 0] * (residual - flow[:, :, 1])).sum()

    jacobian = torch.cat(pose_jacobian(v), -2).view(b, -1, 6, 2 * size)
    top = torch.cat((rotation, so3.hat(t[..., 0]) @ rotation), -1)
    adjoint = torch.cat((top, torch.nn.functional.pad(rotation, (3, 0))), -2)
    # Along both directions, frame j moves relative to frame i by xi_j - Ad_ij xi_i.
    xi = torch.stack((held.lp, held.dp), -1)
    xi = xi.index_select(1, plan.pair_j) - adjoint @ xi.index_select(1, plan.pair_i)
    flow = flow + (xi.mT.index_select(1, group) @ jacobian).unflatten(-1, (2, size))
    total = (weight * flow[:, :, 0] * (residual - flow[:, :, 1])).sum()
    if held.s is None or held.e is None or held.c is None:
        return total

    # J diag(s) J^T of both ends, with J_i = -J_j Ad. An edge from a frame into itself moves with neither.
    s_i, s_j = (held.s.index_select(1, x) for x in (plan.pair_i, plan.pair_j))
    ends = torch.diag_embed(s_j) + (adjoint * s_i[:, :, None]) @ adjoint.mT
    ends = torch.where((plan.pair_i == plan.pair_j)[:, None, None], 0.0, ends)
    quadratic = ((ends.index_select(1, group) @ jacobian) * jacobian).sum(-2).unflatten(-1, (2, size))
    slot_i, slot_j = (setting.slot[x[group]][:, None] * plan.patches for x in (plan.pair_i, plan.pair_j))
    e_i, e_j = (gather(held.e, (x + kk.view(-1, size)).flatten()).view(b, -1, size, 6) for x in (slot_i, slot_j))
    e = (e_j - e_i @ adjoint.index_select(1, group).mT).mT[..., None, :]  # (B, G, 6, 1, M)
    linear = (jacobian.unflatten(-1, (2, size)) * e).sum(-3)
    c = held.c.index_select(1, kk).view(b, -1, 1, size)
    return total + (weight * (quadratic + j_d * (linear + j_d * c))).sum()
