"""One damped Gauss-Newton step as a differentiable function.

Forward assembles ``H delta = g`` without recording a graph. Backward needs only one more solve with the same factor,
and the derivative of one scalar; see :mod:`dvo.ba.layer.adjoint`. A backward pass that is itself recorded
(``create_graph``), or run within ``torch.func``, differentiates the step as autograd records it: :func:`plain_step`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dvo.ba.layer.adjoint import adjoint_constants, gradients
from dvo.ba.layer.schur import SchurFactor, damped, eliminate, factorise, invert_blocks
from dvo.ba.layer.transforms import Tensors, composed, finite, pulled_back
from dvo.ba.limits import LARGEST
from dvo.ba.options import BADamping
from dvo.ba.problem import NormalEquations, Problem
from dvo.core.context import full_precision
from dvo.core.errors import DvoError
from dvo.core.kernels import is_batched, is_transformed


def normal_equations(problem: Problem, depth_damping: float) -> tuple[NormalEquations, list[Any]]:
    """Sum of the contributions of all factors, with damping of the eliminated block, and the memos of the factors.

    Raises:
        DvoError: a problem without factors.
    """
    total: NormalEquations | None = None
    memos: list[Any] = []
    for factor in problem.factors:
        try:
            equations, memo = factor.normal_equations(problem.state)
        except (RuntimeError, IndexError) as error:
            if memos and type(error).__name__ != "OutOfMemoryError":  # the first factor is not from outside
                reason = str(error).partition("\n")[0]
                raise DvoError(
                    f"{type(factor).__name__} does not fit: {reason}", field="factors",
                    remedy="give it indices and shapes of this problem",
                ) from error  # fmt: skip
            raise
        memos.append(memo)
        if total is None:
            h_ll = equations.h_ll + depth_damping
            total = NormalEquations(equations.h_pp, equations.h_pl, h_ll, equations.g_p, equations.g_l)
        else:
            total = total + equations
    if total is None:
        raise DvoError("a problem without factors", remedy="give at least one factor")
    landmarks = problem.state.landmarks
    if landmarks is not None and problem.state[landmarks].held:
        # As if nothing observed them: they get no step.
        total = dataclasses.replace(total, h_ll=torch.zeros_like(total.h_ll))
    return total, memos


def reduced_system(equations: NormalEquations, damping: BADamping) -> SchurFactor:
    """Eliminate the landmarks and factor the damped reduced system."""
    h_pl, h_ll = equations.h_pl[..., None], equations.h_ll[..., None, None]
    return eliminate(equations.h_pp, h_pl, h_ll, damping.pose, damping.relative)


def solved(problem: Problem, damping: BADamping) -> tuple[SchurFactor, Tensor, Tensor, list[Any]]:
    """Factor of the system, step ``(B, P)`` of the reduced and ``(B, K)`` of the eliminated block, memos.

    An element of the batch with a step that is too long moves nothing, and has neither ``q`` nor ``ok``.
    """
    equations, memos = normal_equations(problem, damping.depth)
    solver = reduced_system(equations, damping)
    dp, dl = solver.solve(equations.g_p, equations.g_l[..., None])
    dl = dl[..., 0]
    # The usual case at the cost of one look, where a look costs no wait.
    if dp.device.type == "cpu" and torch.cat((dp, dl), 1).abs().amax().item() <= problem.state.longest:
        return solver, dp, dl, memos
    short = problem.state.is_short(dp)
    q = torch.where(short[..., None, None], solver.q, 0.0)
    solver = SchurFactor(solver.h_pl, q, solver.factor, solver.ok & short[:, 0])
    return solver, torch.where(short, dp, 0.0), torch.where(short & (dl.abs() <= LARGEST), dl, 0.0), memos


def plain_step(problem: Problem, damping: BADamping) -> tuple[Tensor, Tensor]:
    """The steps of :class:`GaussNewtonStep` by operations that autograd records, any number of times."""
    with torch.no_grad():
        _, dp, dl, _ = solved(problem, damping)
        short = problem.state.is_short(dp)
    equations, _ = normal_equations(problem, damping.depth)
    q = invert_blocks(equations.h_ll[..., None, None])[..., 0, 0]
    weighted = equations.h_pl * q[:, None]
    s = damped(equations.h_pp - weighted @ equations.h_pl.mT, damping.pose, damping.relative)
    with torch.no_grad():
        factor, ok = factorise(s)
        boost = factor @ factor.mT - s  # a constant, as in the first derivative
    good = (ok & short[:, 0])[:, None, None]
    eye = torch.eye(s.shape[-1], dtype=s.dtype, device=s.device)
    s = torch.where(good, s + torch.where(good, boost, 0.0), eye)
    y = equations.g_p - (weighted @ equations.g_l[..., None])[..., 0]
    moved = torch.linalg.solve_ex(s, torch.where(good[:, 0], y, 0.0)[..., None])[0][..., 0]
    depths = q * (equations.g_l - (equations.h_pl.mT @ moved[..., None])[..., 0])
    return torch.where(good[:, 0], moved, dp), torch.where(short & (depths.detach().abs() <= LARGEST), depths, 0.0)


class GaussNewtonStep(torch.autograd.Function):
    """``(problem, damping, *problem.tensors())`` to steps ``(B, P)`` of the reduced system and ``(B, K)`` of the
    eliminated block. Gradients flow to the tensors."""

    @staticmethod
    def forward(ctx: Any, problem: Problem, damping: BADamping, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        # The tensors are those of the problem; they are arguments for autograd to see them.
        solver, dp, dl, memos = solved(problem, damping)
        ctx.problem, ctx.damping, ctx.memos, ctx.count = problem, damping, memos, len(tensors)
        # Indices are saved for autograd to notice if they are changed before the backward pass.
        kept = *tensors, *problem.indices()
        ctx.save_for_backward(*kept, solver.h_pl, solver.q, solver.factor, solver.ok, dp, dl)
        return dp, dl

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        refuse_batch(grads[0])
        *kept, h_pl, q, factor, ok, dp, dl = ctx.saved_tensors
        tensors = kept[: ctx.count]
        out: list[Tensor | None] = [None] * len(tensors)
        needed = [i for i in range(len(tensors)) if ctx.needs_input_grad[i + 2]]
        found: Sequence[Tensor | None]
        with full_precision(dp.device):
            if torch.is_grad_enabled() or is_transformed():
                step = partial(_recorded, ctx.problem, ctx.damping)
                found = composed(partial(pulled_back, step, needed, len(tensors)), *tensors, *grads)
            else:
                lp, ll = SchurFactor(h_pl, q, factor, ok).solve(grads[0], grads[1][..., None])
                constants = adjoint_constants(ctx.damping.relative, h_pl[..., 0], q[..., 0, 0], lp, dp, ll[..., 0], dl)
                found = gradients(ctx.problem, tensors, needed, constants, ctx.memos)
        for i, gradient in zip(needed, finite(found, grads), strict=True):
            out[i] = gradient
        return None, None, *out

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> None:
        refuse_dual_numbers()


def refuse_batch(gradient: Tensor) -> None:
    """Raises:
    DvoError: a gradient of ``torch.autograd.grad(..., is_grads_batched=True)``.
    """
    if is_batched(gradient):
        raise DvoError(
            "a batch of gradients (is_grads_batched, vectorize)", field="bundle_adjust",
            remedy="use torch.func.vmap of torch.func.vjp, or torch.func.jacrev",
        )  # fmt: skip


def refuse_dual_numbers() -> None:
    """Raises:
    DvoError: always.
    """
    raise DvoError("dual numbers are not followed", field="bundle_adjust", remedy="use torch.func.jvp")


def _recorded(problem: Problem, damping: BADamping, *tensors: Tensor) -> Tensors:
    return plain_step(problem.with_tensors(tensors), damping)


def gauss_newton(problem: Problem, iterations: int, damping: BADamping) -> Problem:
    """Damped Gauss-Newton steps without acceptance test, differentiable from end to end.

    Args:
        problem: the factors at the starting values.
        iterations: number of steps.
        damping: see :class:`dvo.ba.options.BADamping`.

    Returns:
        The problem at its new values. Where the system cannot be solved, nothing moves.

    Raises:
        DvoError: a problem without factors.
    """
    if all(block.unknowns == 0 for block in problem.state.blocks.values()):
        return problem
    for _ in range(iterations):
        dp, dl = GaussNewtonStep.apply(problem, damping, *problem.tensors())
        problem = Problem(problem.state.moved(dp, dl), problem.factors)
    return problem
