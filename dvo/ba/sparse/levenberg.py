"""Levenberg-Marquardt with acceptance of steps.

Shared by the sparse problems of this package; not differentiable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar, get_args

from dvo.ba.checks import check_kind, check_number, check_whole
from dvo.ba.sparse.block_matrix import CGOptions, LinearSolver
from dvo.core.errors import DvoError
from dvo.core.settings import shown

MIN_DIAGONAL, MAX_DIAGONAL = 1e-6, 1e32
"""Bounds of the diagonal that damping is a fraction of, as in Ceres: directions without measurement are damped too."""


@dataclass(frozen=True)
class LMOptions:
    """Levenberg-Marquardt.

    Attributes:
        max_iterations: steps tried at most.
        tolerance: relative decrease of the cost by an accepted step below which it has converged.
        damping: at the start, a fraction of the Hessian's diagonal.
        decrease: the damping falls to no less than this fraction of itself after a step.
        solver: of the linear system, see :data:`dvo.ba.sparse.block_matrix.LinearSolver`.
        cg: options of conjugate gradients.

    Raises:
        DvoError: a value of another type, a negative number, or an unknown solver.
    """

    max_iterations: int = 50
    tolerance: float = 1e-6
    damping: float = 1e-4
    decrease: float = 1 / 3
    solver: LinearSolver = "auto"
    cg: CGOptions = field(default_factory=CGOptions)

    def __post_init__(self) -> None:
        check_whole(self.max_iterations, "max_iterations")
        for name, high in (("tolerance", 1.0), ("damping", 1e16), ("decrease", 1.0)):
            check_number(getattr(self, name), name, 0.0, high)
        if self.solver not in get_args(LinearSolver):
            known = ", ".join(get_args(LinearSolver))
            raise DvoError(f"unknown solver {shown(self.solver)}", field="solver", remedy=f"use one of {known}")
        check_kind(self.cg, "cg", CGOptions)


State = TypeVar("State")
Step = TypeVar("Step")
Step_co = TypeVar("Step_co", covariant=True)


class LinearSystem(Protocol[Step_co]):
    """Normal equations at one linearisation point."""

    def step(self, damping: float, options: LMOptions) -> tuple[Step_co, float]:
        """Solution with ``damping`` times the diagonal added, and the decrease of the cost that it predicts."""


@dataclass(frozen=True)
class LMOutcome(Generic[State]):
    """Result of :func:`levenberg_marquardt`.

    Attributes:
        state: with the lowest cost.
        initial_cost, cost: before and after.
        iterations: steps tried.
        converged: whether a criterion was met before the limit of iterations.
    """

    state: State
    initial_cost: float
    cost: float
    iterations: int
    converged: bool


def levenberg_marquardt(
    state: State,
    linearise: Callable[[State], LinearSystem[Step]],
    cost: Callable[[State], float],
    move: Callable[[State, Step], State],
    options: LMOptions,
) -> LMOutcome[State]:
    """Minimise ``cost``; a step that does not lower it is undone.

    The damping follows the gain ratio (Nielsen 1999; Madsen, Nielsen and Tingleff, "Methods for non-linear least
    squares problems", 2004).

    Args:
        state: where to start.
        linearise: normal equations at a state.
        cost: half the sum of (robust) squared residuals at a state.
        move: state after a step.
        options: when to stop, and the linear solver.
    """
    now = initial = cost(state)
    damping, growth, converged, tried = options.damping, 2.0, False, 0
    system = linearise(state) if options.max_iterations > 0 else None
    while system is not None and tried < options.max_iterations:
        tried += 1
        step, predicted = system.step(damping, options)
        moved = move(state, step)
        new = cost(moved)
        if new < now:  # False for NaN
            decrease, gain = now - new, (now - new) / predicted if predicted > 0 else 0.0
            state, now = moved, new
            damping, growth = damping * max(options.decrease, 1 - (2 * gain - 1) ** 3), 2.0
            if decrease <= options.tolerance * now:
                converged = True
                break
            if tried < options.max_iterations:
                system = linearise(state)
        else:
            if 0 <= predicted <= options.tolerance * 1e-3 * now:
                converged = True
                break
            damping, growth = damping * growth, growth * 2
            if damping > 1e16:
                break
    return LMOutcome(state, initial, now, tried, converged)
