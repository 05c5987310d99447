"""Bundle adjustment of camera poses and 3-D points: Levenberg-Marquardt with acceptance of steps.

The second use of the Schur solver in this package: landmarks are points with 3x3 blocks instead of inverse depths.
Intrinsics and distortion are constant. Not differentiable; for maps and for problems from files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.ba.bal import PointProblem
from dvo.ba.layer.schur import eliminate, factorise, solve_with
from dvo.core.context import use_threads
from dvo.core.kernels import available
from dvo.geometry import se3, so3

Array = np.ndarray[Any, Any]

MIN_DIAGONAL, MAX_DIAGONAL = 1e-6, 1e32
"""Bounds of the diagonal that damping is a fraction of, as in Ceres: unobserved directions are damped too."""


@dataclass(frozen=True)
class PointSolution:
    """Outcome of :func:`solve_points`.

    Attributes:
        problem: with the new poses and points.
        initial_cost, cost: half the sum of squared residuals, pixels squared, before and after.
        iterations: steps tried.
        converged: a criterion was met before the limit of iterations.
    """

    problem: PointProblem
    initial_cost: float
    cost: float
    iterations: int
    converged: bool


def residuals(problem: PointProblem) -> Tensor:
    """Reprojection residuals ``(O, 2)``, measured less projected position, pixels."""
    return _project(problem)[0]


def _project(problem: PointProblem) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Residuals ``(O, 2)``, points in the camera ``(O, 3)``, d pixel / d point ``(O, 2, 3)``, R ``(C, 3, 3)``"""
    rotation = so3.matrix(problem.poses_cw[:, 3:])
    seen = (rotation[problem.camera] @ problem.points[problem.point][..., None])[..., 0]
    seen = seen + problem.poses_cw[problem.camera, :3]
    z = seen[:, 2:]
    z = torch.where(z.abs() < 1e-12, 1e-12, z)
    xy = seen[:, :2] / z
    focal, centre = problem.intrinsics[problem.camera].split(2, -1)
    k1, k2 = problem.radial[problem.camera].split(1, -1)
    r2 = (xy * xy).sum(-1, keepdim=True)
    radial = 1 + r2 * (k1 + r2 * k2)
    residual = problem.pixels - (focal * radial * xy + centre)
    by_xy = (2 * (k1 + 2 * k2 * r2) * xy)[..., None, :] * xy[..., None] + torch.diag_embed(radial.expand(-1, 2))
    xy_by_point = torch.cat((torch.diag_embed(1 / z.expand(-1, 2)), -(xy / z)[..., None]), -1)
    return residual, seen, focal[..., None] * (by_xy @ xy_by_point), rotation


def _normal_equations(problem: PointProblem, fixed: int) -> tuple[Tensor, ...]:
    """``h_pp (1, 6n, 6n)``, ``h_pl (1, 6n, K, 3)``, ``h_ll (1, K, 3, 3)``, ``g_p (1, 6n)``, ``g_l (1, K, 3)``."""
    residual, seen, by_point, rotation = _project(problem)
    cameras, points = len(problem.poses_cw), len(problem.points)
    j_p = torch.cat((by_point, -by_point @ so3.hat(seen)), -1)  # left perturbation: d point = tau + phi x point
    j_l = by_point @ rotation[problem.camera]
    zeros = problem.points.new_zeros
    blocks = zeros(cameras, 6, 6).index_add(0, problem.camera, j_p.mT @ j_p)
    g_p = zeros(cameras, 6).index_add(0, problem.camera, (j_p.mT @ residual[..., None])[..., 0])
    h_ll = zeros(points, 3, 3).index_add(0, problem.point, j_l.mT @ j_l)
    g_l = zeros(points, 3).index_add(0, problem.point, (j_l.mT @ residual[..., None])[..., 0])
    cell = problem.camera * points + problem.point
    h_pl = zeros(cameras * points, 6, 3).index_add(0, cell, j_p.mT @ j_l).view(cameras, points, 6, 3)
    h_pp = torch.block_diag(*blocks[fixed:]) if fixed < cameras else zeros(0, 0)
    h_pl = h_pl[fixed:].transpose(1, 2).reshape(-1, points, 3)
    return tuple(x[None] for x in (h_pp, h_pl, h_ll, g_p[fixed:].flatten(), g_l))


class _Plain:
    """Steps and costs by PyTorch; the equations are kept until the problem is another."""

    def __init__(self, problem: PointProblem, fixed: int) -> None:
        self._fixed, self._at = fixed, problem
        self._equations = _normal_equations(problem, fixed)

    def cost(self, problem: PointProblem) -> float:
        """Half the sum of squared residuals."""
        return 0.5 * float(residuals(problem).square().sum())

    def step(self, problem: PointProblem, damping: float) -> tuple[Tensor, Tensor, float]:
        """Steps ``(P,)`` of the cameras and ``(K, 3)`` of the points, and the decrease of the cost expected of them."""
        if problem is not self._at:
            self._at, self._equations = problem, _normal_equations(problem, self._fixed)
        h_pp, h_pl, h_ll, g_p, g_l = self._equations
        d_p = damping * h_pp.diagonal(dim1=1, dim2=2).clamp(MIN_DIAGONAL, MAX_DIAGONAL)
        d_l = damping * h_ll.diagonal(dim1=2, dim2=3).clamp(MIN_DIAGONAL, MAX_DIAGONAL)
        solver = eliminate(h_pp + torch.diag_embed(d_p), h_pl, h_ll + torch.diag_embed(d_l))
        dp, dl = solver.solve(g_p, g_l)
        predicted = 0.5 * float((dp * (d_p * dp + g_p)).sum() + (dl * (d_l * dl + g_l)).sum())
        return dp[0], dl[0], predicted


class _Compiled:
    """The same by compiled loops over the points, which take no place for pairs of a camera and a point unseen."""

    def __init__(self, order: Array, start: Array, fixed: int) -> None:
        self._order, self._start, self._fixed = order, start, fixed

    def cost(self, problem: PointProblem) -> float:
        from dvo.ba.point_kernels import half_squares

        arguments = *_arrays(problem), problem.point.contiguous().numpy(), problem.pixels.contiguous().numpy()
        return float(half_squares(*arguments))

    def step(self, problem: PointProblem, damping: float) -> tuple[Tensor, Tensor, float]:
        from dvo.ba.point_kernels import point_steps, reduced_points

        size, points = 6 * max(0, len(problem.poses_cw) - self._fixed), len(problem.points)
        s, x, g_p, d_p = np.zeros((size, size)), np.zeros(size), np.zeros(size), np.zeros(size)
        mixed, q = np.zeros((len(self._order), 3, 6)), np.zeros((points, 3, 3))
        g_l, d_l, dl = np.zeros((points, 3)), np.zeros((points, 3)), np.zeros((points, 3))
        place = self._order, self._start, self._fixed
        numbers = float(damping), MIN_DIAGONAL, MAX_DIAGONAL
        given = *_arrays(problem), problem.pixels.contiguous().numpy(), *place, *numbers
        arguments: tuple[Any, ...] = (*given, s, x, g_p, d_p, mixed, q, g_l, d_l)
        reduced_points(*arguments)
        step = solve_with(*factorise(torch.from_numpy(s)[None]), torch.from_numpy(x)[None])[0]
        dp = step.numpy()
        twice = point_steps(problem.camera.contiguous().numpy(), *place, mixed, q, g_l, d_l, dp, dl)
        return step, torch.from_numpy(dl), 0.5 * float((dp * (d_p * dp + g_p)).sum() + twice)


def _arrays(problem: PointProblem) -> tuple[Any, ...]:
    """Rotations, poses, intrinsics, distortion, points, and the camera of each observation."""
    p = problem
    tensors = so3.matrix(p.poses_cw[:, 3:]), p.poses_cw, p.intrinsics, p.radial, p.points, p.camera
    return tuple(x.contiguous().numpy() for x in tensors)


def _compiled(problem: PointProblem, fixed: int) -> _Compiled | None:
    """Kernels for a problem, None where they do not serve."""
    p = problem
    floats = p.poses_cw, p.intrinsics, p.radial, p.points, p.pixels
    if not available() or any(x.device.type != "cpu" or x.dtype != torch.float64 or x.requires_grad for x in floats):
        return None
    from dvo.ba.point_kernels import by_point

    camera, point = p.camera.contiguous().numpy(), p.point.contiguous().numpy()
    good, order, start = by_point(camera, point, len(p.poses_cw), len(p.points))
    return _Compiled(order, start, int(fixed)) if good else None


def solve_points(
    problem: PointProblem,
    *,
    fixed: int = 0,
    max_iterations: int = 100,
    tolerance: float = 1e-6,
    damping: float = 1e-4,
) -> PointSolution:
    """Minimise half the sum of squared reprojection errors over poses and points.

    Damping is a fraction of the Hessian's diagonal and follows the gain ratio (Nielsen 1999); a step that does not
    lower the cost is undone. Without fixed cameras, only the damping fixes the gauge.

    Args:
        fixed: how many leading cameras stay.
        max_iterations: steps tried at most.
        tolerance: relative decrease of the cost by an accepted step below which it has converged.
        damping: initial fraction.

    Returns:
        The best poses and points found, with the cost before and after.

    Example:
        >>> solution = solve_points(read_bal("problem-21-11315-pre.txt"), fixed=1)
        >>> solution.cost / solution.initial_cost
    """
    use_threads()
    system = _compiled(problem, fixed) or _Plain(problem, fixed)
    cost = initial = system.cost(problem)
    growth, converged = 2.0, False
    tried = 0
    while tried < max_iterations:
        tried += 1
        dp, dl, predicted = system.step(problem, damping)
        moved = _moved(problem, dp, dl, fixed)
        new_cost = system.cost(moved)
        gain = (cost - new_cost) / predicted if predicted > 0 else -1.0
        if new_cost < cost:  # False for NaN
            decrease, problem, cost = cost - new_cost, moved, new_cost
            damping, growth = damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), 2.0
            if decrease <= tolerance * cost:
                converged = True
                break
        else:
            damping, growth = damping * growth, growth * 2
            if damping > 1e16 or predicted <= 1e-15 * cost:
                converged = predicted <= tolerance * cost
                break
    return PointSolution(problem, initial, cost, tried, converged)


def _moved(problem: PointProblem, dp: Tensor, dl: Tensor, fixed: int) -> PointProblem:
    poses = problem.poses_cw
    poses = torch.cat((poses[:fixed], se3.retract(poses[fixed:], dp.view(-1, 6))))
    return problem.moved(poses, problem.points + dl)
