"""One damped Gauss-Newton step as a differentiable function.

Forward assembles ``H delta = g`` without recording a graph. Backward needs only one more solve with the same factor,
and the derivative of one scalar; see :mod:`dvo.ba.layer.adjoint`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from dvo.ba.layer.adjoint import adjoint_constants, gradients
from dvo.ba.layer.schur import SchurFactor, eliminate
from dvo.ba.options import BADamping
from dvo.ba.problem import NormalEquations, Problem
from dvo.core.errors import DvoError
from dvo.geometry.precision import full_precision


def normal_equations(problem: Problem, depth_damping: float) -> tuple[NormalEquations, list[Any]]:
    """Sum of the contributions of all factors, with damping of the eliminated block, and the memos of the factors.

    Raises:
        DvoError: a problem without factors.
    """
    total: NormalEquations | None = None
    memos = []
    for factor in problem.factors:
        equations, memo = factor.normal_equations(problem.state)
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


class GaussNewtonStep(torch.autograd.Function):
    """``(problem, damping, *problem.tensors())`` to steps ``(B, P)`` of the reduced system and ``(B, K)`` of the
    eliminated block. Gradients flow to the tensors."""

    @staticmethod
    def forward(ctx: Any, problem: Problem, damping: BADamping, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        # The tensors are those of the problem; they are arguments for autograd to see them.
        equations, memos = normal_equations(problem, damping.depth)
        solver = reduced_system(equations, damping)
        dp, dl = solver.solve(equations.g_p, equations.g_l[..., None])
        ctx.problem, ctx.damping, ctx.memos = problem, damping, memos
        ctx.save_for_backward(*tensors, solver.h_pl, solver.q, solver.factor, solver.ok, dp, dl)
        return dp, dl[..., 0]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *tensors, h_pl, q, factor, ok, dp, dl = ctx.saved_tensors
        out: list[Tensor | None] = [None] * len(tensors)
        needed = [i for i in range(len(tensors)) if ctx.needs_input_grad[i + 2]]
        with full_precision(dp.device):
            lp, ll = SchurFactor(h_pl, q, factor, ok).solve(grads[0], grads[1][..., None])
            constants = adjoint_constants(
                ctx.damping.relative, h_pl[..., 0], q[..., 0, 0], lp, dp, ll[..., 0], dl[..., 0]
            )
            for i, gradient in zip(needed, gradients(ctx.problem, tensors, needed, constants, ctx.memos), strict=True):
                out[i] = gradient
        return None, None, *out


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
