"""Patch reprojection of one camera without gradients, by compiled loops over the edges.

:mod:`dvo.ba.layer.grouped` is the twin: it takes any device and records gradients. Nothing is sorted here, and a whole
solution is one call where no other factor takes part.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.ba.blocks import INTRINSICS, INVERSE_DEPTHS, POSES
from dvo.ba.edges import plan_edges
from dvo.ba.kernels import Kernel
from dvo.ba.layer.grouped import GroupedReprojection, group_measurements
from dvo.ba.layer.reprojection import MARGIN, PatchReprojection
from dvo.ba.layer.step import normal_equations
from dvo.ba.options import BADamping
from dvo.ba.problem import Factor, Linearisation, NormalEquations, Problem, State
from dvo.core.kernels import use_kernels
from dvo.geometry.projection import MIN_Z_VALID

Array = np.ndarray[Any, Any]
_ROBUST = {"none": 0, "huber": 1, "cauchy": 2}


@dataclass(frozen=True)
class EdgewiseReprojection(Factor):
    """Reprojection residuals of edges in any order.

    Attributes:
        centres, intrinsics, targets, weights: ``(B, K, 2)``, ``(B, N, 4)``, ``(B, E, 2)`` and ``(B, E, 2)``, pixels.
        ii, jj, kk: ``(E,)`` source frame, target frame and patch.
        max_residual, bounds, kernel: see :class:`dvo.ba.layer.reprojection.PatchReprojection`.
        pairs, ends: see :func:`dvo.ba.layer.edgewise_kernels.frame_pairs`.
    """

    centres: Tensor
    intrinsics: Tensor
    targets: Tensor
    weights: Tensor
    ii: Tensor
    jj: Tensor
    kk: Tensor
    max_residual: float
    bounds: tuple[float, float] | None
    kernel: Kernel
    pairs: Array = field(repr=False)
    ends: Array = field(repr=False)

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        edges = self.ii, self.jj, self.kk, self.ii, self.jj
        generic = PatchReprojection(
            self.centres, self.targets, self.weights, *edges, None, self.max_residual, self.bounds, self.kernel
        )
        linear = generic.linearise({**values, INTRINSICS: self.intrinsics})
        of_state = linear.blocks[:3], linear.indices[:3], linear.jacobians[:3]
        return Linearisation(linear.residual, linear.weight, *of_state)

    def normal_equations(self, state: State) -> tuple[NormalEquations, Any]:
        depths = state[INVERSE_DEPTHS]
        if not self._is_for_kernels(state):
            return self._grouped(state).normal_equations(state)[0], None
        from dvo.ba.layer.edgewise_kernels import add_reprojection

        (b, k), p = depths.value.shape, state.size
        h_pp, h_lp, h_ll = np.zeros((b, p, p)), np.zeros((b, k, p)), np.zeros((b, k))
        g_p, g_l = np.zeros((b, p)), np.zeros((b, k))
        values = self._values(state)
        constants: tuple[Any, ...] = (*self._edges(), _rows(state), not depths.held, *self._gate())
        for of_element in zip(*values, h_pp, h_lp, h_ll, g_p, g_l, strict=True):
            given, sums = of_element[: len(values)], of_element[len(values) :]
            add_reprojection(*given, *constants, *sums)
        # In double precision, which those of further factors are added to.
        full, mixed, *rest = (torch.from_numpy(x) for x in (h_pp, h_lp, h_ll, g_p, g_l))
        return NormalEquations(full, mixed.mT, *rest), None

    def _grouped(self, state: State) -> GroupedReprojection:
        """The twin."""
        plan = plan_edges(self.ii, self.jj, self.kk, self.intrinsics.shape[1], self.centres.shape[1])
        gate: dict[str, Any] = dict(max_residual=self.max_residual, bounds=self.bounds, kernel=self.kernel)
        measured = self.centres, self.intrinsics, self.targets, self.weights
        return group_measurements(*measured, plan, state[POSES], **gate)

    def _is_for_kernels(self, state: State) -> bool:
        return use_kernels(state[POSES].value, state[INVERSE_DEPTHS].value, *self.tensors())

    def _values(self, state: State) -> list[Array]:
        values = state[POSES].value, state[INVERSE_DEPTHS].value, *self.tensors()
        return [x.detach().contiguous().numpy() for x in values]

    def _edges(self) -> tuple[Array, ...]:
        return *(x.contiguous().numpy() for x in (self.ii, self.jj, self.kk)), self.pairs, self.ends

    def _gate(self) -> tuple[tuple[float, ...], int]:
        width, height = (0.0, 0.0) if self.bounds is None else self.bounds
        margin = math.inf if self.bounds is None else MARGIN
        middle = width / 2, height / 2
        gate = MIN_Z_VALID, self.max_residual, *middle, middle[0] + margin, middle[1] + margin, self.kernel.width
        return tuple(float(x) for x in gate), _ROBUST[self.kernel.name]


def measured_edges(
    centres: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    *,
    max_residual: float,
    bounds: tuple[float, float] | None,
    kernel: Kernel,
) -> EdgewiseReprojection | None:
    """The factor, unless an index is out of range or shapes do not belong together.

    Args:
        centres, intrinsics, targets, weights, ii, jj, kk, max_residual, bounds, kernel: see
            :class:`EdgewiseReprojection`.
    """
    from dvo.ba.layer.edgewise_kernels import frame_pairs

    if any(x.shape[-2:] != (len(ii), 2) for x in (targets, weights)) or not len(ii) == len(jj) == len(kk):
        return None
    ii, jj, kk = ii.contiguous(), jj.contiguous(), kk.contiguous()
    good, pairs, ends = frame_pairs(ii.numpy(), jj.numpy(), kk.numpy(), intrinsics.shape[1], centres.shape[1])
    if not good:
        return None
    return EdgewiseReprojection(
        centres, intrinsics, targets, weights, ii, jj, kk, max_residual, bounds, kernel, pairs, ends
    )  # fmt: skip


def _rows(state: State) -> Array:
    """First row ``(N,)`` of each pose in the reduced system, -1 for one that stays."""
    poses = state[POSES]
    assert poses.slot is not None
    slot = poses.slot.numpy()
    return np.where((slot < poses.free) & (not poses.held), state.offsets[POSES] + 6 * slot, -1)


def gauss_newton(problem: Problem, iterations: int, damping: BADamping, depth_range: tuple[float, float]) -> Problem:
    """As :func:`dvo.ba.layer.step.gauss_newton`, of a problem whose first factor is :class:`EdgewiseReprojection`.

    Args:
        problem: the factors at the starting values.
        iterations: number of steps.
        damping: see :class:`dvo.ba.options.BADamping`.
        depth_range: inverse depths are clamped to it.

    Returns:
        The problem at its new values. Where the system cannot be solved, nothing moves.
    """
    state = problem.state
    if iterations == 0 or all(block.unknowns == 0 for block in state.blocks.values()):
        return problem
    if len(problem.factors) > 1 or len(state.blocks) > 2:
        for _ in range(iterations):
            state = state.moved(*_step(problem, damping))
            problem = Problem(state, problem.factors)
        return problem
    from dvo.ba.layer.edgewise_kernels import take_steps

    factor, held = problem.factors[0], state[INVERSE_DEPTHS].held
    assert isinstance(factor, EdgewiseReprojection)
    values = factor._values(state)
    poses, inverse_depths = values[0].copy(), values[1].copy()
    numbers = [float(x) for x in (damping.pose, damping.relative, damping.depth, *depth_range)]
    of_edges = *values[2:], *factor._edges(), _rows(state), state.size, not held, *factor._gate()
    arguments: tuple[Any, ...] = (poses, inverse_depths, *of_edges, *numbers, int(iterations))
    take_steps(*arguments)
    found = {POSES: torch.from_numpy(poses), INVERSE_DEPTHS: torch.from_numpy(inverse_depths)}
    return Problem(state.with_values(found), problem.factors)


def _step(problem: Problem, damping: BADamping) -> tuple[Tensor, Tensor]:
    """Steps ``(B, P)`` of the reduced system and ``(B, K)`` of the eliminated block."""
    from dvo.ba.layer.edgewise_kernels import solve_reduced

    state = problem.state
    equations, _ = normal_equations(problem, damping.depth)
    parts = equations.h_pp, equations.h_pl.mT, equations.h_ll, equations.g_p, equations.g_l
    h_pp, h_lp, h_ll, g_p, g_l = (x.detach().contiguous().numpy() for x in parts)
    widths = [(block.unknowns * block.dim, block.longest) for block in state.blocks.values() if not block.eliminated]
    longest = np.repeat([float(limit) for _, limit in widths], [width for width, _ in widths])
    numbers = float(damping.pose), float(damping.relative), longest
    dp, dl = np.empty_like(g_p), np.empty_like(g_l)
    for b in range(len(g_p)):
        solve_reduced(h_pp[b], h_lp[b], h_ll[b], g_p[b], g_l[b], *numbers, dp[b], dl[b])
    return torch.from_numpy(dp).float(), torch.from_numpy(dl).float()
