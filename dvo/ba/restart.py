"""Bundle adjustment started anew, to leave a wrong minimum.

Over a short baseline the images of a scene are nearly those of its relief reversed, seen under the opposite motion
(Koenderink and van Doorn, "Affine structure from motion", JOSA A 1991; Oliensis, "The least-squares error for structure
from infinitesimal motion", IJCV 2005). Both are minima of the reprojection error, and iterations do not lead from one
to the other. A tracker that began with the wrong one stays with it, although later frames fit it badly. A large moving
body is another reason to begin with a wrong motion. Solutions are therefore started anew from reversed and from equal
depths, with the poses that these suggest, and compared by their robust cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from dvo.ba.global_adjust import GlobalBAOptions, global_bundle_adjust
from dvo.ba.kernels import Kernel
from dvo.ba.levenberg import LMOptions
from dvo.geometry import se3


def reversed_relief(inverse_depth: Tensor) -> Tensor:
    """Mirror inverse depths at their median, within 0.1 and 3 times the median.

    Args:
        inverse_depth: of any shape.

    Returns:
        Values of the same shape.
    """
    median = inverse_depth.median()
    return (2 * median - inverse_depth).clamp(0.1 * median, 3 * median)


def equal_depths(inverse_depth: Tensor) -> Tensor:
    """Replace inverse depths by their median.

    Args:
        inverse_depth: of any shape.

    Returns:
        Values of the same shape.
    """
    return inverse_depth.median().expand_as(inverse_depth).clone()


STARTS: dict[str, Callable[[Tensor], Tensor]] = {"reversed": reversed_relief, "equal": equal_depths}
"""Inverse depths to start from, by those of a solution."""

Measured = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""Intrinsics, targets, weights, ``ii``, ``jj``, ``kk``, see :func:`restart`."""


@dataclass(frozen=True)
class RestartOptions:
    """Options of :func:`restart`.

    Attributes:
        wide: robust kernel while only the poses move, which are far off then.
        kernel: robust kernel of the solution and of the comparison.
        max_residual: pixels; a longer residual has a constant cost.
        resection: iterations for the poses alone.
        iterations: of the solution, at most.
        abandon: a start is abandoned after half of the iterations if its cost is above that of the present solution by
            this factor.
        tolerance: relative decrease of the cost by a step below which a solution has converged.
        margin: a new solution is preferred if its cost is below this share of the cost of the old one.
    """

    wide: Kernel = Kernel("huber", 0.5)
    kernel: Kernel = Kernel("cauchy", 0.1)
    max_residual: float = 32.0
    resection: int = 4
    iterations: int = 8
    abandon: float = 2.0
    tolerance: float = 1e-3
    margin: float = 0.95


def restart(
    poses_cw: Tensor,
    patches: Tensor,
    measured: Measured,
    fixed: Tensor,
    start: str,
    options: RestartOptions = RestartOptions(),  # noqa: B008 (frozen)
) -> tuple[Tensor, Tensor, float]:
    """Solve from other inverse depths: first for the poses, then for everything.

    Args:
        poses_cw: ``(N, 7)`` of a solution.
        patches: ``(K, 3, p, p)`` of a solution.
        measured: intrinsics ``(N, 4)``, targets and weights ``(E, 2)``, ``ii``, ``jj``, ``kk`` ``(E,)``; see
            :func:`dvo.ba.global_adjust.global_bundle_adjust`.
        fixed: ``(N,)`` bool, poses that stay.
        start: name in :data:`STARTS`.
        options: iterations and kernels.

    Returns:
        Poses ``(N, 7)``, patches, and the cost with ``options.kernel``.
    """
    patches = patches.clone()
    patches[:, 2] = STARTS[start](patches[:, 2])
    steps = LMOptions(max_iterations=options.resection, tolerance=options.tolerance)
    settings = GlobalBAOptions(
        fixed=fixed, kernel=options.wide, max_residual=options.max_residual, move_depths=False, solver=steps
    )
    poses_cw = se3.normalise(global_bundle_adjust(poses_cw, patches, *measured, settings).poses_cw)
    return _solve(poses_cw, patches, measured, fixed, options, options.iterations)


@dataclass(frozen=True)
class Solution:
    """Solution of a problem.

    Attributes:
        start: name in :data:`STARTS`; empty for the present solution.
        poses_cw: ``(N, 7)`` world to camera.
        patches: ``(K, 3, p, p)``.
        cost: with :attr:`RestartOptions.kernel`.
    """

    start: str
    poses_cw: Tensor
    patches: Tensor
    cost: float


def solutions(
    poses_cw: Tensor,
    patches: Tensor,
    measured: Measured,
    fixed: Tensor,
    options: RestartOptions = RestartOptions(),  # noqa: B008 (frozen)
) -> list[Solution]:
    """Solve from all :data:`STARTS`.

    Args:
        poses_cw, patches, measured, fixed, options: see :func:`restart`.

    Returns:
        The present solution, refined, and those of the starts that were not abandoned.
    """
    half, rest = options.iterations // 2, options.iterations - options.iterations // 2
    found = [Solution("", *_solve(poses_cw, patches, measured, fixed, options, options.iterations))]
    for start in STARTS:
        part = restart(poses_cw, patches, measured, fixed, start, replace(options, iterations=half))
        if part[2] <= options.abandon * found[0].cost:
            found.append(Solution(start, *_solve(part[0], part[1], measured, fixed, options, rest)))
    return found


def better_solution(found: Sequence[Solution], options: RestartOptions = RestartOptions()) -> Solution | None:  # noqa: B008
    """Best of other solutions, if its cost is lower than that of the present one by the margin.

    Args:
        found: of :func:`solutions`.
        options: the margin.

    Returns:
        The solution; None if the present one is better.
    """
    now, *others = found
    best = min(others, key=lambda other: other.cost, default=now)
    return best if best.cost < options.margin * now.cost else None


def better_start(
    poses_cw: Tensor,
    patches: Tensor,
    measured: Measured,
    fixed: Tensor,
    options: RestartOptions = RestartOptions(),  # noqa: B008 (frozen)
) -> Solution | None:
    """Best of the :data:`STARTS`, if it leads to a lower cost than the present solution.

    Args:
        poses_cw, patches, measured, fixed, options: see :func:`restart`; the present solution is refined first.

    Returns:
        Its solution; None if the present one is better.
    """
    return better_solution(solutions(poses_cw, patches, measured, fixed, options), options)


def _solve(
    poses_cw: Tensor, patches: Tensor, measured: Measured, fixed: Tensor, options: RestartOptions, iterations: int
) -> tuple[Tensor, Tensor, float]:
    """Poses, patches and cost after some iterations with the last kernel."""
    steps = LMOptions(max_iterations=iterations, tolerance=options.tolerance)
    settings = GlobalBAOptions(fixed=fixed, kernel=options.kernel, max_residual=options.max_residual, solver=steps)
    found = global_bundle_adjust(poses_cw, patches, *measured, settings)
    return se3.normalise(found.poses_cw), found.patches, found.cost
