"""Patch reprojection of one camera on edges grouped by frame pair: the fast twin of :mod:`dvo.ba.layer.reprojection`.

Intrinsics enter with the measurements, in normalised coordinates, and are no state block here; gradients flow to them
through the rays, targets and weights.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dvo.ba.blocks import INVERSE_DEPTHS, POSES
from dvo.ba.edges import EdgePlan
from dvo.ba.kernels import Kernel
from dvo.ba.layer.normal_equations import (
    Counted,
    Gate,
    SumIndex,
    accumulate,
    counts,
    pose_jacobian,
    relative_motion,
    sum_index,
    view,
)
from dvo.ba.layer.reprojection import MARGIN
from dvo.ba.limits import LARGEST
from dvo.ba.problem import AdjointConstants, Factor, Linearisation, NormalEquations, State, StateBlock
from dvo.geometry import so3


@dataclass(frozen=True)
class GroupedReprojection(Factor):
    """Reprojection residuals of ``G`` groups of ``M`` places, see :class:`dvo.ba.edges.EdgePlan`.

    Attributes:
        rays: ``(B, G, 3, M)`` normalised patch centres ``(x, y, 1)`` in the source frames.
        target, weight: ``(B, G, 2, M)`` normalised; a weight is zero where a place is empty.
        plan: layout of the edges.
        gate: conditions on which edges count.
        index: destinations of the sums for the free frames of a state.
    """

    rays: Tensor
    target: Tensor
    weight: Tensor
    plan: EdgePlan
    gate: Gate
    index: SumIndex

    def tensors(self) -> tuple[Tensor, ...]:
        return self.rays, self.target, self.weight

    def indices(self) -> tuple[Tensor, ...]:
        plan = self.plan
        return plan.pair_i, plan.pair_j, plan.group_pair, plan.kk

    def with_tensors(self, tensors: Sequence[Tensor]) -> GroupedReprojection:
        rays, target, weight = tensors
        return GroupedReprojection(rays, target, weight, self.plan, self.gate, self.index)

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        plan, b, everything = self.plan, len(self.rays), slice(0, self.plan.groups)
        group = plan.group_pair
        rotation, t = (x.index_select(1, group) for x in relative_motion(values[POSES], plan))
        v = view(rotation, t, self.rays, values[INVERSE_DEPTHS].index_select(1, plan.kk).view(b, -1, 1, plan.size))
        residual = self.target - v.xy
        use = counts(v, residual, self.gate, everything)
        residual, weight = torch.where(use, residual, 0.0), torch.where(use, self.weight, 0.0)
        scale = self.gate.kernel.weights(residual, weight, -2)
        jac_j = torch.cat(pose_jacobian(v), -2).unflatten(-2, (6, 2)).permute(0, 1, 4, 3, 2)  # (B, G, M, 2, 6)
        jac_i = -jac_j @ _adjoint(rotation, t)[:, :, None]
        jac_d = ((t[..., :2, :] - v.xy * t[..., 2:, :]) * v.inv_z).mT[..., None]
        ii, jj = (x[group].repeat_interleave(plan.size) for x in (plan.pair_i, plan.pair_j))
        return Linearisation(
            residual.mT.flatten(1, 2),
            (weight if scale is None else weight * scale).mT.flatten(1, 2),
            (POSES, POSES, INVERSE_DEPTHS),
            (ii, jj, plan.kk),
            (jac_i.flatten(1, 2), jac_j.flatten(1, 2), jac_d.flatten(1, 2)),
        )

    def normal_equations(self, state: State) -> tuple[NormalEquations, list[Counted]]:
        poses, depths = state[POSES], state[INVERSE_DEPTHS]
        equations, used = accumulate(
            poses.value, depths.value, self.rays, self.target, self.weight, self.plan, self.gate,
            self._index_for(state), not poses.held, not depths.held,
        )  # fmt: skip
        before, width = state.offsets[POSES], 6 * poses.unknowns
        after = state.size - before - width
        if before == after == 0:
            return equations, used
        pad = torch.nn.functional.pad
        h_pp = pad(equations.h_pp, (before, after, before, after))
        h_pl, g_p = pad(equations.h_pl, (0, 0, before, after)), pad(equations.g_p, (before, after))
        return replace(equations, h_pp=h_pp, h_pl=h_pl, g_p=g_p), used

    def phi(self, state: State, constants: AdjointConstants, memo: Any) -> Iterator[Tensor]:
        held = None if state[POSES].held else _pose_constants(state, constants)
        index = self._index_for(state)
        for part, ends, used in zip(self.plan.chunks(), index.ends, memo, strict=True):
            yield _edge_terms(self, state, constants, held, part, ends, used)

    def _index_for(self, state: State) -> SumIndex:
        poses = state[POSES]
        if self.index.slot is poses.slot:
            return self.index
        assert poses.slot is not None
        return sum_index(self.plan, poses.slot, poses.free, len(self.rays))


@dataclass(frozen=True)
class _PoseConstants:
    """Parts of :class:`AdjointConstants` by frame.

    Attributes:
        lambda_p, delta_p: ``(B, N, 6)``, zero for the fixed frames.
        s: ``(B, N, 6)``; None without relative damping, as are the other two.
        e: ``(B (n + 1) K, 6)`` by element, slot and patch, zero for the fixed frames. c: ``(B, K)``.
    """

    lambda_p: Tensor
    delta_p: Tensor
    s: Tensor | None = None
    e: Tensor | None = None
    c: Tensor | None = None


def _pose_constants(state: State, constants: AdjointConstants) -> _PoseConstants:
    spread = state[POSES].spread
    lambda_p, delta_p = (spread(state.part(POSES, x)) for x in (constants.lambda_p, constants.delta_p))
    if constants.s is None or constants.e is None:
        return _PoseConstants(lambda_p, delta_p)
    start = state.offsets[POSES]
    e = constants.e[:, start : start + 6 * state[POSES].unknowns].unflatten(1, (-1, 6)).transpose(2, 3)
    e = torch.nn.functional.pad(e, (0, 0, 0, 0, 0, 1)).flatten(0, 2)
    return _PoseConstants(lambda_p, delta_p, spread(state.part(POSES, constants.s)), e, constants.c)


def _adjoint(rotation: Tensor, t: Tensor) -> Tensor:
    """``(..., 6, 6)`` adjoint of motions given as ``(..., 3, 3)`` and ``(..., 3, 1)``."""
    top = torch.cat((rotation, so3.hat(t[..., 0]) @ rotation), -1)
    return torch.cat((top, torch.nn.functional.pad(rotation, (3, 0))), -2)


def _edge_terms(
    factor: GroupedReprojection,
    state: State,
    constants: AdjointConstants,
    held: _PoseConstants | None,
    part: slice,
    ends_of_places: Tensor,
    used: Counted,
) -> Tensor:
    """The part of phi that comes from the edges of a slice of groups."""
    plan, size = factor.plan, factor.plan.size
    use, scale = used
    b, group = len(factor.rays), plan.group_pair[part]
    kk = plan.kk[part.start * size : part.stop * size]
    rotation, t = relative_motion(state[POSES].value, plan)
    depth = state[INVERSE_DEPTHS].value.index_select(1, kk).view(b, -1, 1, size)
    motion = t.index_select(1, group)
    # Only what counts is projected: the rest may be so far off that its products with zero weights are NaN.
    v = view(rotation.index_select(1, group), motion, factor.rays[:, part], depth, use)
    j_d = (motion[..., :2, :] - v.xy * motion[..., 2:, :]) * v.inv_z
    residual = torch.where(use, factor.target[:, part] - v.xy, 0.0)
    weight = torch.where(use, factor.weight[:, part], 0.0)
    if scale is not None:
        weight = weight * scale
    steps = torch.stack((constants.lambda_l, constants.delta_l), 1).index_select(2, kk).view(b, 2, -1, 1, size)
    flow = j_d[:, :, None] * steps.transpose(1, 2)  # J lambda and J delta, (B, G, 2 directions, 2 axes, M)
    if held is None:
        return (weight * flow[:, :, 0] * (residual - flow[:, :, 1])).sum()

    jacobian = torch.cat(pose_jacobian(v), -2).view(b, -1, 6, 2 * size)
    adjoint = _adjoint(rotation, t)
    # Along both directions, frame j moves relative to frame i by xi_j - Ad_ij xi_i.
    xi = torch.stack((held.lambda_p, held.delta_p), -1)
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
    e_j, e_i = (held.e.index_select(0, x).view(b, -1, size, 6) for x in ends_of_places.view(-1, 2).unbind(1))
    e = (e_j - e_i @ adjoint.index_select(1, group).mT).mT[..., None, :]  # (B, G, 6, 1, M)
    linear = (jacobian.unflatten(-1, (2, size)) * e).sum(-3)
    c = held.c.index_select(1, kk).view(b, -1, 1, size)
    return total + (weight * (quadratic + j_d * (linear + j_d * c))).sum()


def group_measurements(
    centres: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    plan: EdgePlan,
    poses: StateBlock,
    *,
    max_residual: float,
    bounds: tuple[float, float] | None,
    kernel: Kernel,
) -> GroupedReprojection:
    """The factor of edges in their given order.

    Args:
        centres: ``(B, K, 2)`` pixels.
        intrinsics: ``(B, N, 4)``.
        targets, weights: ``(B, E, 2)`` pixels and pixels^-2.
        plan: layout of the edges.
        poses: state block of the poses, for the frames that are free.
        max_residual: pixels; a longer residual does not count.
        bounds: ``(width, height)`` of the feature map, or None.
        kernel: robust kernel.
    """
    shape = (len(centres), plan.groups, plan.size, 2)
    f_i, c_i = intrinsics.index_select(1, plan.pair_i[plan.group_pair])[:, :, None].split(2, -1)
    f_j, c_j = intrinsics.index_select(1, plan.pair_j[plan.group_pair])[:, :, None].split(2, -1)
    source = (centres.index_select(1, plan.kk).view(shape) - c_i) / f_i
    rays = torch.cat((source, torch.ones_like(source[..., :1])), -1).mT.contiguous()
    target, weight = targets.index_select(1, plan.order).view(shape), weights.index_select(1, plan.order).view(shape)
    # A weight that is not finite is none at all, as is that of a target that nothing can be near; the empty places of a
    # group have none either. Both are left out here, as autograd would multiply them by zero further down.
    known = ((target.abs() <= LARGEST) & (weight.abs() < math.inf)).all(-1, keepdim=True)
    target = (torch.where(known, target, 0.0) - c_j) / f_j
    weight = torch.where(plan.filled[..., None] & known, weight, 0.0)
    weight = weight * (f_j * f_j)
    gate = Gate(max_residual, f_j.detach().mT, kernel=kernel)
    if bounds is not None:
        middle = torch.stack([centres.new_full((), side) for side in bounds]) / 2  # a copy would wait for the device
        gate = replace(gate, offset=(c_j.detach() - middle).mT, reach=middle[:, None] + MARGIN)
    assert poses.slot is not None
    index = sum_index(plan, poses.slot, poses.free, len(centres))
    return GroupedReprojection(rays, target.mT.contiguous(), weight.mT.contiguous(), plan, gate, index)
