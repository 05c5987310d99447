"""Marginal covariance of poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dvo.ba.blocks import POSES
from dvo.ba.options import BADamping
from dvo.ba.problem import Problem
from dvo.ba.step import normal_equations, reduced_system
from dvo.errors import DvoError
from dvo.geometry.precision import full_precision


@torch.no_grad()
def pose_covariance(
    problem: Problem,
    frames: Sequence[int],
    damping: BADamping = BADamping(),  # noqa: B008
    block: str = POSES,
    sigma: float = 1.0,
) -> Tensor:
    """Joint marginal covariance of chosen poses: their part of the inverse Hessian of all unknowns.

    It is a covariance if the weights of all factors are inverse variances, in units of ``sigma^-2``. Absolute damping
    stays in the Hessian, where it acts as a weak prior on directions that nothing measures, for example the scale of a
    monocular problem with one fixed pose; relative damping is left out.

    Args:
        problem: at its solution.
        frames: ``m`` elements of the block of poses.
        damping: absolute damping of poses and inverse depths.
        block: name of the block.
        sigma: standard deviation of a measurement of weight 1, by which the result is scaled. For the confidence of a
            network see :attr:`dvo.odometry.config.TrackerConfig.sigma`.

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
    with full_precision(state[block].value.device):
        equations, _ = normal_equations(problem, damping.depth)
        solver = reduced_system(equations, replace(damping, relative=0.0))
    index = torch.tensor(list(frames), dtype=torch.long, device=state[block].value.device)
    rows = state.rows(block, index).flatten()
    # One unit column for each tangent; the column of a fixed pose, past the last row, is zero.
    columns = torch.nn.functional.one_hot(rows, state.size + 1)[:, : state.size].T.to(solver.factor)
    inverse = torch.cholesky_solve(columns.expand(len(solver.factor), -1, -1), solver.factor)
    covariance = sigma**2 * (columns.T @ inverse)
    good = (solver.ok & torch.isfinite(covariance).all(-1).all(-1))[:, None, None]
    infinite = torch.diag_embed(torch.full_like(covariance[..., 0], torch.inf))
    return torch.where(good, covariance, infinite)
