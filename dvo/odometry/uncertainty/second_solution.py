"""Second solutions of a window: other motions that its measurements support nearly as well (:mod:`dvo.ba.multistart`).

The curvature of the cost at one minimum says nothing of another one. While the motion is small, or the scene has little
texture, a window may have two of similar cost, and the tracker may be at the wrong one. Each solution then has a
probability, by its cost, and the distances between them are a part of the uncertainty of the pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dvo.ba.multistart import PRESENT, RESTARTS, Solution, multistart
from dvo.ba.patch_problem import PatchProblem
from dvo.odometry.uncertainty.displacement import TOLERANCE
from dvo.odometry.uncertainty.gauge import Gauge, relative_error

INDEPENDENT = 10.0
"""Number of independent residuals that the probability of a solution is computed for. A window has a thousand, but
those of a patch, and of neighbouring ones, share their errors (docs/uncertainty.md)."""
MIN_PROBABILITY = 0.05
"""Probability below which a solution is left out."""
DISTANCE = 4.0
"""Normalised squared distance, for each degree of freedom, below which two solutions are one: a window that determines
its pose loosely has many of nearly the same cost, which its covariance contains."""


@dataclass(frozen=True)
class SecondSolution:
    """Another solution of a window.

    Attributes:
        probability: that it is the right one.
        error: ``(6,)`` right tangent ``[tau, phi]`` of the newest pose that leads to it, under the gauge.
        solution: its poses and patches.
    """

    probability: float
    error: np.ndarray
    solution: Solution


def window_solutions(problem: PatchProblem) -> list[Solution]:
    """Solutions of a window from all starts (:data:`dvo.ba.multistart.RESTARTS`), the present one first.

    Args:
        problem: of the window. Measured depths do not take part.

    Returns:
        The solutions.
    """
    found = multistart(problem.with_values(factors=()), RESTARTS)
    return sorted(found, key=lambda solution: solution.start != PRESENT)


def second_solutions(
    solved: Sequence[Solution], gauge: Gauge, covariance: np.ndarray, metric: np.ndarray
) -> list[SecondSolution]:
    """Solutions that differ from the present one, with their probabilities.

    The likelihood of a solution of cost ``c``, for ``n`` independent residuals of unknown variance, is proportional to
    ``c^(-n/2)``.

    Args:
        solved: the present solution, followed by others.
        gauge: under which the newest poses are compared.
        covariance: ``(6, 6)`` of the newest pose, see :data:`DISTANCE`.
        metric: of :func:`dvo.odometry.uncertainty.displacement.flow_metric`. Solutions whose newest poses displace the
            scene in the image by less than its :data:`~dvo.odometry.uncertainty.displacement.TOLERANCE` are one too.

    Returns:
        The others, best first; those of a probability below :data:`MIN_PROBABILITY` are left out.
    """
    now, information = solved[0], np.linalg.pinv(covariance, hermitian=True) / len(covariance)

    def differs(error: np.ndarray) -> bool:
        return bool(error @ metric @ error > TOLERANCE**2 and error @ information @ error > DISTANCE)

    different: list[tuple[float, np.ndarray, Solution]] = []
    others = (other for other in solved[1:] if math.isfinite(other.cost))
    for other in sorted(others, key=lambda other: other.cost):
        error = relative_error(now.problem.poses_cw, other.problem.poses_cw, gauge)
        if np.isfinite(error).all() and all(map(differs, [error, *(error - known for _, known, _ in different)])):
            different.append((_likelihood(other.cost, now.cost), error, other))
    total = 1 + sum(weight for weight, _, _ in different)
    found = [SecondSolution(weight / total, error, other) for weight, error, other in different]
    return [other for other in found if other.probability >= MIN_PROBABILITY]


def _likelihood(cost: float, now: float) -> float:
    """Likelihood over that of the present solution; 1 if both costs vanish."""
    tiny = np.finfo(np.float64).tiny
    exponent = -INDEPENDENT / 2 * (math.log(max(cost, tiny)) - math.log(max(now, tiny)))
    return math.exp(min(exponent, 100.0))
