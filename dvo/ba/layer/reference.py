"""Plain twin of :mod:`dvo.ba.layer.step`: one dense system of all unknowns, differentiated by autograd. Slow; the
specification.

It uses the generic linearisation of every factor and nothing of the fast paths: no groups of edges, no Schur
complement, no implicit differentiation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from dvo.ba.blocks import INTRINSICS, INVERSE_DEPTHS, POSES
from dvo.ba.layer.layer import make_problem
from dvo.ba.layer.linearisation import landmark_count, landmark_part, reduced_part
from dvo.ba.options import BADamping, BAOptions, BAResult
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import Factor, Problem, StateBlock

_DEFAULT = BAOptions()


def dense_rows(problem: Problem) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Residuals ``(B, R)``, weights ``(B, R)`` and Jacobians ``(B, R, P)``, ``(B, R, K)`` of all factors."""
    state, values = problem.state, problem.state.values()
    parts = []
    for factor in problem.factors:
        linear = factor.linearise(values)
        b, f, d = linear.residual.shape
        jacobian, rows = reduced_part(linear, state)
        at = torch.nn.functional.one_hot(rows, state.size + 1)[..., :-1].to(jacobian)
        dense = torch.einsum("bfdr,frp->bfdp", jacobian, at)
        by_landmark = jacobian.new_zeros(b, f, d, landmark_count(state))
        found = landmark_part(linear, state)
        if found is not None:
            at = torch.nn.functional.one_hot(found[1], landmark_count(state) + 1)[:, :-1].to(jacobian)
            by_landmark = found[0][..., None] * at[:, None]
        parts.append((linear.residual.flatten(1), linear.weight.flatten(1), dense.flatten(1, 2),
                      by_landmark.flatten(1, 2)))  # fmt: skip
    residual, weight, jac_p, jac_l = (torch.cat(x, 1) for x in zip(*parts, strict=True))
    return residual, weight, jac_p, jac_l


def dense_step(problem: Problem, damping: BADamping) -> tuple[Tensor, Tensor]:
    """Step ``(B, P)`` of the reduced unknowns and ``(B, K)`` of the eliminated ones from one joint system."""
    r, w, jac_p, jac_l = dense_rows(problem)
    p, k = jac_p.shape[-1], jac_l.shape[-1]
    eye = torch.eye(k, dtype=r.dtype, device=r.device)
    h_pp, e = jac_p.mT @ (w[..., None] * jac_p), jac_p.mT @ (w[..., None] * jac_l)
    c = jac_l.mT @ (w[..., None] * jac_l) + damping.depth * eye
    g = (torch.cat((jac_p, jac_l), -1) * (w * r)[..., None]).sum(1)
    held = problem.state.landmarks is not None and problem.state[problem.state.landmarks].held
    if held:
        c = eye.expand_as(c)
    # Damping is defined on the reduced system, so its diagonal is needed before the joint one can be written.
    s = h_pp - e @ torch.linalg.solve(c, e.mT)
    extra = s.diagonal(dim1=1, dim2=2) * damping.relative + damping.pose
    joint = torch.cat((torch.cat((h_pp + torch.diag_embed(extra), e), -1), torch.cat((e.mT, c), -1)), -2)
    both = torch.linalg.solve(joint, g)
    return both[:, :p], both[:, p:]


def solve_reference(problem: Problem, iterations: int, damping: BADamping) -> Problem:
    """As :func:`dvo.ba.layer.step.gauss_newton`."""
    for _ in range(iterations):
        problem = replace(problem, state=problem.state.moved(*dense_step(problem, damping)))
    return problem


def bundle_adjust_reference(
    poses_cw: Tensor,
    patches: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    options: BAOptions = _DEFAULT,
    *,
    factors: Iterable[Factor] = (),
    blocks: Mapping[str, StateBlock] | None = None,
) -> BAResult:
    """As :func:`dvo.ba.layer.layer.bundle_adjust`, without checks, cost and covariance."""
    given = poses_cw, patches, intrinsics, targets, weights, ii, jj, kk
    asked = PatchProblem(*given, options.sensors, tuple(factors), blocks or {})
    problem = make_problem(asked, options, grouped=False)
    state = solve_reference(problem, options.iterations, options.damping).state
    row = state[INVERSE_DEPTHS].value[:, :, None, None, None].expand_as(patches[:, :, :1])
    if not state[INVERSE_DEPTHS].held:
        patches = torch.cat((patches[:, :, :2], row), 2)
    further = {name: state[name].value for name in blocks or {}}
    return BAResult(state[POSES].value, patches, state[INTRINSICS].value, blocks=further)
