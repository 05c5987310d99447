"""Bundle adjustment from several starts, to leave a wrong minimum, and the rule by which a solution is preferred.

Over a short baseline the images of a scene are nearly those of its relief reversed, seen under the opposite motion
(Koenderink and van Doorn, "Affine structure from motion", JOSA A 1991; Oliensis, "The least-squares error for structure
from infinitesimal motion", IJCV 2005). Both are minima of the reprojection error, and iterations do not lead from one
to the other. A tracker that began with the wrong one stays with it, although later frames fit it badly. A large moving
body is another reason to begin with a wrong motion. So a problem is solved from several starts, and the solutions are
ranked by one cost, :meth:`dvo.ba.patch_problem.PatchProblem.robust_cost`.

A start is a function of the problem and of the options of the solution. Those here take other depths with the poses
that these suggest, or nothing of the present values at all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import torch
from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.ba.limits import depth_range_of
from dvo.ba.options import BAOptions, damping_at
from dvo.ba.patch_problem import KERNEL, MAX_RESIDUAL, PatchProblem
from dvo.ba.solve import solve
from dvo.ba.sparse.global_adjust import GlobalBAOptions
from dvo.ba.sparse.levenberg import LMOptions
from dvo.geometry import se3

Start = Callable[[PatchProblem, GlobalBAOptions], PatchProblem]
"""Values to start from, by a problem at its present values and the options of the solution."""

PRESENT = "present"
"""Name of the start that keeps the values of the problem."""
MARGIN = 0.95
"""Share of the cost of the present solution that the cost of another one has to be below to be preferred."""
ABANDON = 2.0
"""Factor of the cost of the present solution above which a start is abandoned after half of its iterations."""
OPTIONS = GlobalBAOptions(
    kernel=KERNEL, max_residual=MAX_RESIDUAL, solver=LMOptions(max_iterations=8, tolerance=1e-3)
)  # fmt: skip
"""Options of a solution from each start."""

AS_THEY_ARE = replace(OPTIONS, solver=replace(OPTIONS.solver, max_iterations=0))
"""Options that rank the starts without a further solution."""

_WIDE = 5.0  # width of the kernel over that of the solution while only the poses move, which are far off then
_FAR = 1e-3  # inverse depth at which translation moves nothing
_COLD_UPDATES = 10  # calls of bundle adjustment without a starting point


@dataclass(frozen=True)
class Solution:
    """Solution of a problem.

    Attributes:
        start: name of its start.
        problem: at the solution, on the CPU in double precision.
        cost: :meth:`dvo.ba.patch_problem.PatchProblem.robust_cost` with the kernel of the options.
    """

    start: str
    problem: PatchProblem
    cost: float


class Begun(Protocol):
    """Work that another thread has begun, or will."""

    def withdraw(self) -> bool:
        """Take the work back; True if it has not begun, and never will."""
        ...

    def result(self) -> Solution:
        """Result of the work, waited for if need be."""
        ...


Beside = Callable[[Callable[[], Solution]], Begun]
"""Function that gives work to another thread."""


def multistart(
    problem: PatchProblem,
    starts: Mapping[str, Start],
    options: GlobalBAOptions = OPTIONS,
    abandon: float = ABANDON,
    beside: Beside | None = None,
) -> list[Solution]:
    """Solve a problem from several starts.

    Args:
        problem: one graph. It is solved on the CPU in double precision, which not every accelerator has.
        starts: by name; that of the present values, if they are one, is :data:`PRESENT`.
        options: of each solution; their range of depths is widened for a near scene. Without iterations the starts are
            ranked as they are.
        abandon: see :data:`ABANDON`.
        beside: gives a part of the starts to another thread, with the same solutions; None to take all here.

    Returns:
        The solutions, least cost first; without those that were abandoned.

    Example:
        >>> found = multistart(problem, {"present": present, "reversed": reversed_relief})
        >>> best = preferred(found)
    """
    problem = problem.exact()
    if len(problem.inverse_depths):
        median = float(problem.inverse_depths.median())
        options = replace(options, depth_range=depth_range_of(median, options.depth_range))

    def solved(name: str, now: PatchProblem, iterations: int) -> Solution:
        steps = replace(options.solver, max_iterations=iterations)
        result = solve(now, replace(options, solver=steps))
        blocks = {name: block.with_value(result.blocks[name]) for name, block in now.blocks.items()}
        now = now.with_values(poses_cw=se3.normalise(result.poses_cw), patches=result.patches, blocks=blocks)
        return rated(name, now, result.cost / now.total_weight)  # which is its robust cost

    def rated(name: str, now: PatchProblem, cost: float) -> Solution:
        return Solution(name, now, cost if cost == cost else float("inf"))

    def begun(name: str) -> Solution:
        with torch.no_grad():
            return solved(name, starts[name](problem, options), half)

    count, limit = options.solver.max_iterations, float("inf")
    half, found, others = count // 2, [], [name for name in starts if name != PRESENT]
    tasks = {} if beside is None else {name: beside(partial(begun, name)) for name in others}
    with torch.no_grad():
        if PRESENT in starts:
            found.append(solved(PRESENT, starts[PRESENT](problem, options), count))
            limit = abandon * found[0].cost
        taken = {name: begun(name) for name in reversed(others) if name not in tasks or tasks[name].withdraw()}
        for name in others:
            first = taken[name] if name in taken else tasks[name].result()
            if first.cost <= limit:
                found.append(solved(name, first.problem, count - half))
    return sorted(found, key=lambda solution: solution.cost)


def preferred(found: Sequence[Solution]) -> Solution:
    """The solution to go on with: the best one, unless the present one is nearly as good.

    Args:
        found: of :func:`multistart`.

    Returns:
        The present solution, if another one does not lower its cost by :data:`MARGIN`.
    """
    now = next((solution for solution in found if solution.start == PRESENT), None)
    return now if now is not None and not clearly_lower(found[0].cost, now.cost) else found[0]


def clearly_lower(cost: float, present: float) -> bool:
    """The rule of :func:`preferred` for two costs.

    Args:
        cost: of another solution.
        present: cost of the present one.

    Returns:
        True if the other one is preferred.
    """
    return cost < MARGIN * present


def present(problem: PatchProblem, options: GlobalBAOptions) -> PatchProblem:
    """Start from the present values.

    Args:
        problem, options: see :data:`Start`.

    Returns:
        The problem.
    """
    return problem


def mirrored(inverse_depth: Tensor) -> Tensor:
    """Mirror inverse depths at their median, within 0.1 and 3 times the median.

    Args:
        inverse_depth: of any shape.

    Returns:
        Values of the same shape.
    """
    median = inverse_depth.median()
    return (2 * median - inverse_depth).clamp(0.1 * median, 3 * median)


def reversed_relief(problem: PatchProblem, options: GlobalBAOptions) -> PatchProblem:
    """Start from the relief mirrored at its median, and the poses that suit it.

    Args:
        problem, options: see :data:`Start`.

    Returns:
        The problem at these values.
    """
    return _posed(problem.with_values(inverse_depths=mirrored(problem.inverse_depths)), options)


def equal_depths(problem: PatchProblem, options: GlobalBAOptions) -> PatchProblem:
    """Start from the median inverse depth for all patches, and the poses that suit it.

    Args:
        problem, options: see :data:`Start`.

    Returns:
        The problem at these values.
    """
    depths = problem.inverse_depths
    return _posed(problem.with_values(inverse_depths=depths.median().expand_as(depths).clone()), options)


def from_nothing(problem: PatchProblem, options: GlobalBAOptions) -> PatchProblem:
    """Start from one pose for all frames and inverse depths of 1: all of them are solved for under strong damping.

    Args:
        problem: its first pose stays.
        options: see :data:`Start`.

    Returns:
        The problem at these values.
    """
    return _cold(problem, se3.identity(len(problem.poses_cw), dtype=problem.poses_cw.dtype))


def rotations_first(problem: PatchProblem, options: GlobalBAOptions) -> PatchProblem:
    """Start from one pose and inverse depths of 1; the rotations are found first, as if every point were far away.

    It fails on other problems than :func:`from_nothing` does.

    Args:
        problem, options: see :func:`from_nothing`.

    Returns:
        The problem at these values.
    """
    poses = se3.identity(len(problem.poses_cw), dtype=problem.poses_cw.dtype)
    far = _at(problem, poses, torch.full_like(problem.inverse_depths, _FAR))
    turned = solve(far, BAOptions(motion_only=True, iterations=4)).poses_cw
    return _cold(problem, torch.cat([torch.zeros_like(turned[:, :3]), turned[:, 3:]], 1))


def _posed(problem: PatchProblem, options: GlobalBAOptions) -> PatchProblem:
    """Poses that suit the depths, which stay."""
    wide = Kernel("huber", _WIDE * options.kernel.width)
    steps = replace(options.solver, max_iterations=options.solver.max_iterations // 2)
    found = solve(problem, replace(options, kernel=wide, move_depths=False, solver=steps))
    return problem.with_values(poses_cw=se3.normalise(found.poses_cw))


def _at(problem: PatchProblem, poses_cw: Tensor, inverse_depths: Tensor) -> PatchProblem:
    """The reprojection alone at other values, in the precision of the window's kernels: a start needs no more."""
    now = problem.with_values(poses_cw=poses_cw, inverse_depths=inverse_depths, factors=(), blocks={})
    names = ("poses_cw", "patches", "intrinsics", "targets", "weights")
    return now.with_values(**{name: getattr(now, name).float() for name in names})


def _cold(problem: PatchProblem, poses_cw: Tensor) -> PatchProblem:
    now = _at(problem, poses_cw, torch.ones_like(problem.inverse_depths))
    for update in range(_COLD_UPDATES):
        # What is wrong with a problem is found by the first of them.
        result = solve(now, BAOptions(damping=damping_at(update), check=None if update == 0 else False))
        now = now.with_values(poses_cw=result.poses_cw, patches=result.patches)
    found = now.poses_cw.to(problem.poses_cw)
    moved = se3.compose(found, problem.poses_cw[:1].expand_as(found))
    return problem.with_values(poses_cw=se3.normalise(moved), inverse_depths=now.inverse_depths)


DEPTH_STARTS: dict[str, Start] = {"reversed": reversed_relief, "equal": equal_depths}
"""Other depths than the present ones."""
RESTARTS: dict[str, Start] = {PRESENT: present, **DEPTH_STARTS}
"""Starts of a problem that has a solution."""
COLD_STARTS: dict[str, Start] = {"nothing": from_nothing, "rotations": rotations_first}
"""Starts of a problem without one."""
