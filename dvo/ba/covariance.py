"""Marginal covariance of poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import torch
from torch import Tensor

from dvo.ba.blocks import POSES
from dvo.ba.layer.linearisation import landmark_count, landmark_part, reduced_part
from dvo.ba.layer.schur import SchurFactor
from dvo.ba.layer.step import normal_equations, reduced_system
from dvo.ba.options import BADamping
from dvo.ba.problem import NormalEquations, Problem
from dvo.core.context import full_precision
from dvo.core.errors import DvoError
from dvo.geometry import se3


@torch.no_grad()
def pose_covariance(
    problem: Problem,
    frames: Sequence[int],
    damping: BADamping = BADamping(),  # noqa: B008
    block: str = POSES,
    sigma: float = 1.0,
    constraint: Tensor | None = None,
) -> Tensor:
    """Joint marginal covariance of chosen poses: their part of the inverse Hessian of all unknowns.

    It is a covariance if the weights of all factors are inverse variances, in units of ``sigma^-2``. Absolute damping
    stays in the Hessian, where it acts as a weak prior on directions that nothing measures, for example the scale of a
    monocular problem with one fixed pose; relative damping is left out. A ``constraint`` holds one direction exactly
    instead: it borders the Hessian (Triggs et al., "Bundle adjustment - a modern
    synthesis", section 9).

    Args:
        problem: at its solution.
        frames: ``m`` elements of the block of poses.
        damping: absolute damping of poses and inverse depths.
        block: name of the block.
        sigma: standard deviation of a measurement of weight 1, by which the result is scaled. For the confidence of a
            network see :attr:`dvo.odometry.patch.config.TrackerConfig.sigma`.
        constraint: ``(B, N, d)`` coefficients of the tangents of all poses whose sum is held at zero, for example
            :func:`size_gradient`; those of fixed poses are ignored. The direction may be one that nothing measures.

    Returns:
        ``(B, d m, d m)`` covariance of the left tangents (``d = 6``: ``[tau, phi]``), zero for fixed poses; infinite on
        the diagonal where the Hessian is not positive definite.

    Raises:
        DvoError: a frame that is not in the block.
    """
    state = problem.state
    count = state[block].value.shape[1]
    bad = [x for x in frames if not 0 <= x < count]
    if bad:
        raise DvoError(f"frame {bad[0]} outside 0..{count - 1}", field="frames", remedy="give frames that exist")
    index = torch.tensor(list(frames), dtype=torch.long, device=state[block].value.device)
    column = None if constraint is None else _column(problem, block, constraint)
    rows = state.rows(block, index).flatten()
    with full_precision(state[block].value.device):
        # The reduced Hessian is a difference: in single precision, a weight of 1e8 leaves nothing of the small ones.
        exact = problem.with_tensors([x.double() for x in problem.tensors()])
        equations, _ = normal_equations(exact, damping.depth)
        solver, prior = _reduced(equations, damping, column)
        good = _keeps_digits(equations, solver, damping)
        found = _marginal(solver, rows, column)
        if not bool(good.all()):
            found = torch.where(good[:, None, None], found, _marginal(_from_rows(exact, damping, prior), rows, column))
    return (sigma**2 * found).to(state[block].value.dtype)


@torch.no_grad()
def marginal_covariance(
    equations: NormalEquations, rows: Tensor, damping: BADamping, constraint: Tensor | None = None
) -> Tensor:
    """Part of the inverse Hessian; see :func:`pose_covariance`.

    Args:
        equations: of all unknowns, with the damping of the inverse depths.
        rows: ``(r,)`` of the reduced system; one past the last stands for something fixed.
        damping: that of the poses is added.
        constraint: ``(B, P)`` coefficients of the unknowns of the reduced system whose sum is held at zero.

    Returns:
        ``(B, r, r)`` in double precision, as a marginal is the inverse of a difference; infinite on the diagonal where
        the Hessian is not positive definite.
    """
    equations = NormalEquations(*(getattr(equations, field.name).double() for field in fields(equations)))
    solver, _ = _reduced(equations, damping, constraint)
    return _marginal(solver, rows, constraint)


def _reduced(
    equations: NormalEquations, damping: BADamping, constraint: Tensor | None
) -> tuple[SchurFactor, Tensor | None]:
    """Factor of the reduced Hessian; with a constraint the row ``(B, P)`` of a prior that is part of it.

    The prior on the constrained sum makes the system regular, and changes nothing where the sum is zero.
    """
    prior = None
    if constraint is not None:
        a = constraint.double()
        mean = equations.h_pp.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
        share = mean / a.square().sum(1, keepdim=True).clamp(min=torch.finfo(a.dtype).tiny)
        equations = replace(equations, h_pp=equations.h_pp + (share * a)[:, :, None] * a[:, None])
        prior = share.sqrt() * a
    return reduced_system(equations, replace(damping, relative=0.0)), prior


def _marginal(solver: SchurFactor, rows: Tensor, constraint: Tensor | None) -> Tensor:
    """Part of the inverse of a factored Hessian; see :func:`marginal_covariance`."""
    b, size = solver.factor.shape[:2]
    # One unit column for each row; that of something fixed, past the last row, is zero.
    columns = torch.nn.functional.one_hot(rows, size + 1)[:, :size].T.to(solver.factor).expand(b, -1, -1)
    if constraint is not None:
        columns = torch.cat((columns, constraint.double()[..., None]), -1)
    # The inverse of L L^T between columns is the product of their L^-1.
    half = torch.linalg.solve_triangular(solver.factor, columns, upper=False)
    covariance = half.mT @ half
    if constraint is not None:
        last = covariance[:, :-1, -1:]
        covariance = covariance[:, :-1, :-1] - last @ last.mT / covariance[:, -1:, -1:]
    good = (solver.ok & torch.isfinite(covariance).all(-1).all(-1))[:, None, None]
    infinite = torch.diag_embed(torch.full_like(covariance.diagonal(dim1=-2, dim2=-1), torch.inf))
    return torch.where(good, covariance, infinite)


def _keeps_digits(equations: NormalEquations, solver: SchurFactor, damping: BADamping) -> Tensor:
    """``(B,)`` bool: what rounding did to the reduced Hessian is small against its least eigenvalue."""
    factor = solver.factor
    eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device).expand_as(factor)
    inverse = torch.linalg.solve_triangular(factor, eye, upper=False).square().sum((1, 2))
    error = torch.finfo(factor.dtype).eps * equations.h_pp.diagonal(dim1=-2, dim2=-1).sum(-1)
    # A factorisation that failed at first has more damping, 1e-6 of the largest entry or more.
    of_landmarks = (solver.h_pl[..., 0].square() * solver.q[:, None, :, 0, 0]).sum(-1)
    diagonal = equations.h_pp.diagonal(dim1=-2, dim2=-1) - of_landmarks + damping.pose
    if diagonal.shape[1]:
        more = (factor.square().sum(-1) - diagonal).abs().amax(1)
        return solver.ok & (error * inverse < 1e-3) & (more <= 1e-7 * diagonal.abs().amax(1))
    return solver.ok


def _from_rows(problem: Problem, damping: BADamping, prior: Tensor | None) -> SchurFactor:
    """Factor of the reduced Hessian by QR of its rows. They are not squared, so that it keeps twice the digits.

    The rows of a landmark are projected off its column, which leaves rows of the reduced system.
    """
    state, values = problem.state, problem.state.values()
    size, count = state.size, landmark_count(state)
    rows, columns, places = [], [], []
    for factor in problem.factors:
        linear = factor.linearise(values)
        jacobian, at = reduced_part(linear, state)
        root = linear.weight.sqrt()
        unit = torch.nn.functional.one_hot(at, size + 1)[..., :size].to(jacobian)
        rows.append((root[..., None] * (jacobian @ unit)).flatten(1, 2))
        found = landmark_part(linear, state)
        column, place = (torch.zeros_like(root), at.new_full((root.shape[1],), count)) if found is None else found
        columns.append((root * column).flatten(1))
        places.append(place.repeat_interleave(root.shape[2]))
    a, b, place = torch.cat(rows, 1), torch.cat(columns, 1), torch.cat(places)
    # Damping of a landmark is a row of its own, without a reduced part.
    batch = len(a)
    own = torch.arange(count, device=place.device)
    a = torch.cat((a, a.new_zeros(batch, count, size)), 1)
    b = torch.cat((b, b.new_full((batch, count), damping.depth**0.5)), 1)
    place = torch.cat((place, own))
    square = b.new_zeros(batch, count + 1).index_add_(1, place, b.square())
    along = a.new_zeros(batch, count + 1, size).index_add_(1, place, b[..., None] * a)
    share = torch.where(square > 0, 1 / square, 0.0)[..., None] * along
    a = a - b[..., None] * share.index_select(1, place)
    eye = torch.eye(size, dtype=a.dtype, device=a.device).expand(batch, -1, -1)
    more = [damping.pose**0.5 * eye, *([] if prior is None else [prior[:, None]])]
    a = torch.cat((a, *more), 1)
    # The longest rows first: then the short ones lose nothing to them.
    order = a.square().sum(-1).argsort(1, descending=True)
    a = a.gather(1, order[..., None].expand_as(a))
    good = torch.isfinite(a).all(-1).all(-1)
    r = torch.linalg.qr(torch.where(good[:, None, None], a, 0.0), mode="r")[1]
    good = good & (r.diagonal(dim1=-2, dim2=-1) != 0).all(-1)
    none = a.new_zeros(batch, size, 0, 1)
    return SchurFactor(none, none[:, 0, :, :, None], torch.where(good[:, None, None], r.mT, eye), good)


def size_gradient(poses_cw: Tensor, reference: int, members: Sequence[int]) -> Tensor:
    """Gradient of half the sum of squared distances of camera centres from that of one camera.

    As the constraint of :func:`pose_covariance`, with the reference fixed, it fixes the scale of a monocular problem:
    the RMS distance of the members from the reference does not change.

    Args:
        poses_cw: ``(B, N, 7)`` world to camera.
        reference: position of the camera that distances are taken from.
        members: positions of the others.

    Returns:
        ``(B, N, 6)`` by the left tangents ``[tau, phi]`` of the members, of which ``phi`` has no part; zero for all
        other poses.
    """
    index = torch.tensor(list(members), dtype=torch.long, device=poses_cw.device)
    chosen = poses_cw.index_select(1, index)
    # A centre moves by -R^T tau, and is at c - c_0 = -R^T t from the reference if t is that of T_member T_reference^-1.
    relative = se3.relative(poses_cw[:, reference : reference + 1].expand_as(chosen), chosen)
    gradient = poses_cw.new_zeros(*poses_cw.shape[:2], 6)
    gradient[:, index, :3] = relative[..., :3]
    return gradient


def _column(problem: Problem, block: str, constraint: Tensor) -> Tensor:
    """Constraint ``(B, N, d)`` on the unknowns of the reduced system, ``(B, P)``."""
    state = problem.state
    rows = state.rows(block, torch.arange(constraint.shape[1], device=constraint.device)).flatten()
    column = constraint.new_zeros(len(constraint), state.size + 1)  # fixed poses share the row past the last
    column[:, rows] = constraint.flatten(1)
    return column[:, : state.size]
