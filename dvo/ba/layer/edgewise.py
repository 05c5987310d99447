"""Patch reprojection of one camera by compiled loops over the edges.

:mod:`dvo.ba.layer.grouped` is the twin: it takes any device, and its derivatives are of any order. Nothing is sorted
here, and a whole solution is one call where no other factor takes part. First derivatives have kernels only then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.ba.blocks import INTRINSICS, INVERSE_DEPTHS, POSES
from dvo.ba.edges import plan_edges
from dvo.ba.kernels import Kernel
from dvo.ba.layer import step
from dvo.ba.layer.grouped import GroupedReprojection, group_measurements
from dvo.ba.layer.reprojection import MARGIN, PatchReprojection
from dvo.ba.layer.step import normal_equations
from dvo.ba.layer.transforms import composed, finite, pulled_back
from dvo.ba.options import BADamping
from dvo.ba.problem import Factor, Linearisation, NormalEquations, Problem, State
from dvo.core.kernels import is_transformed, use_kernels
from dvo.geometry.bounds import MIN_Z_VALID

Array = np.ndarray[Any, Any]
ROBUST = {"none": 0, "huber": 1, "cauchy": 2}
"""Robust kernels by their numbers in compiled code."""


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
        return tuple(float(x) for x in gate), ROBUST[self.kernel.name]


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
    tensors = problem.tensors()
    recorded = torch.is_grad_enabled() and any(x.requires_grad for x in tensors)
    solve = _Recorded.apply if recorded else partial(_taken, None)
    poses, inverse_depths = solve(problem, _Settings(iterations, damping, depth_range), *tensors)
    return Problem(state.with_values({POSES: poses, INVERSE_DEPTHS: inverse_depths}), problem.factors)


@dataclass(frozen=True)
class _Settings:
    """Arguments of :func:`gauss_newton`."""

    iterations: int
    damping: BADamping
    depth_range: tuple[float, float]

    def numbers(self) -> tuple[float, ...]:
        """Those of the kernels."""
        damping = self.damping
        return tuple(float(x) for x in (damping.pose, damping.relative, damping.depth, *self.depth_range))


def _constants(problem: Problem, settings: _Settings) -> tuple[Any, ...]:
    """Arguments of the kernels from the edges to the damping."""
    state, factor = problem.state, problem.factors[0]
    assert isinstance(factor, EdgewiseReprojection)
    held = state[INVERSE_DEPTHS].held
    return *factor._edges(), _rows(state), state.size, not held, *factor._gate(), *settings.numbers()


def _taken(path: list[Array] | None, problem: Problem, settings: _Settings, *tensors: Tensor) -> tuple[Tensor, ...]:
    """New poses and inverse depths; values of both before each step are added to the path."""
    from dvo.ba.layer.edgewise_kernels import take_steps

    poses, inverse_depths, *measured = (x.detach().contiguous().numpy() for x in tensors)
    poses, inverse_depths = poses.copy(), inverse_depths.copy()
    arguments: tuple[Any, ...] = (poses, inverse_depths, *measured, *_constants(problem, settings))
    count: tuple[Any, ...] = (int(settings.iterations) if path is None else 1,)
    if path is None:
        take_steps(*arguments, *count)
    else:
        for _ in range(settings.iterations):
            path += [poses.copy(), inverse_depths.copy()]
            take_steps(*arguments, *count)
    return torch.from_numpy(poses), torch.from_numpy(inverse_depths)


def _by_twin(problem: Problem, settings: _Settings, *tensors: Tensor) -> tuple[Tensor, ...]:
    """The same by operations that autograd records, any number of times."""
    problem = problem.with_tensors(tensors)
    factor = problem.factors[0]
    assert isinstance(factor, EdgewiseReprojection)
    problem = Problem(problem.state, (factor._grouped(problem.state),))
    state = step.gauss_newton(problem, settings.iterations, settings.damping).state
    return state[POSES].value, state[INVERSE_DEPTHS].value


class _Recorded(torch.autograd.Function):
    """``(problem, settings, *problem.tensors())`` to new poses and inverse depths, with a compiled adjoint."""

    @staticmethod
    def forward(ctx: Any, problem: Problem, settings: _Settings, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.problem, ctx.settings, ctx.path, ctx.count = problem, settings, [], len(tensors)
        # Indices are saved for autograd to notice if they are changed before the backward pass.
        ctx.save_for_backward(*tensors, *problem.indices())
        return _taken(ctx.path, problem, settings, *tensors)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        step.refuse_batch(grads[0])
        tensors = ctx.saved_tensors[: ctx.count]
        needed = [i for i in range(len(tensors)) if ctx.needs_input_grad[i + 2]]
        found: Sequence[Tensor | None]
        if torch.is_grad_enabled() or is_transformed():
            twin = partial(_by_twin, ctx.problem, ctx.settings)
            found = composed(partial(pulled_back, twin, needed, len(tensors)), *tensors, *grads)
        else:
            every = _taken_back(ctx.path, ctx.problem, ctx.settings, tensors, grads)
            found = [every[i] for i in needed]
        out: list[Tensor | None] = [None] * len(tensors)
        for i, gradient in zip(needed, finite(found, grads), strict=True):
            out[i] = gradient
        return None, None, *out

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> None:
        step.refuse_dual_numbers()


def _taken_back(
    path: list[Array], problem: Problem, settings: _Settings, tensors: Sequence[Tensor], grads: Sequence[Tensor]
) -> list[Tensor]:
    """Gradients by all tensors from those by the new poses and inverse depths."""
    from dvo.ba.layer.edgewise_kernels import take_back_step

    measured = [x.detach().contiguous().numpy() for x in tensors[2:]]
    constants = _constants(problem, settings)
    sums = [x.double().contiguous().numpy().copy() for x in grads] + [np.zeros(x.shape) for x in measured]
    for at in range(len(path) - 2, -1, -2):
        arguments: tuple[Any, ...] = (path[at], path[at + 1], *measured, *constants, *sums)
        take_back_step(*arguments)
    # Poses are unit quaternions: what would change their length has no meaning, and the kernel does not compute it.
    q, d_q = path[0][..., 3:].astype(np.float64), sums[0][..., 3:]
    square = np.maximum((q * q).sum(-1, keepdims=True), 1e-12)
    d_q -= q * ((q * d_q).sum(-1, keepdims=True) / square)
    return [torch.from_numpy(x).float() for x in sums]


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
    return torch.from_numpy(dp).to(state[POSES].value), torch.from_numpy(dl).to(state[POSES].value)
