"""Self-calibration: focal length and readout time of the shutter under which the measurements of a segment agree best.

Both are found by their profile: for a value of the parameter all poses and depths are solved for, and the value with the
lowest robust cost is wanted. No ground truth takes part, and a motion that cannot tell leaves the cost flat.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Minimum:
    """Lowest point of a profile.

    Attributes:
        value: of the parameter.
        deviation: standard deviation of the value; inf if the profile has no minimum within the range.
        gain: relative decrease of the cost from the first value to this one.
    """

    value: float
    deviation: float
    gain: float


def profile_minimum(
    cost: Callable[[float], float], start: float, step: float, low: float, high: float, freedom: int
) -> Minimum:
    """Walk downhill from a value in steps, and fit a parabola to the lowest three points.

    Args:
        cost: profile of the parameter.
        start: first value.
        step: distance of the points.
        low, high: range of the parameter.
        freedom: number of independent residuals; scales the deviation, as the cost is in pixels.

    Returns:
        The minimum.
    """
    known = {0: cost(start)}
    at = 0

    def value(index: int) -> float:
        return start + index * step

    def look(index: int) -> float | None:
        if index not in known and low - 1e-12 <= value(index) <= high + 1e-12:
            known[index] = cost(value(index))
        return known.get(index)

    while True:
        neighbours = [(found, index) for index in (at - 1, at + 1) if (found := look(index)) is not None]
        best = min(neighbours, default=(known[at], at))
        if best[0] >= known[at]:
            break
        at = best[1]
    left, here, right = known.get(at - 1), known[at], known.get(at + 1)
    gain = 1 - here / max(known[0], 1e-300)
    if left is None or right is None:
        return Minimum(value(at), float("inf"), gain)
    curvature = (left + right - 2 * here) / step**2
    if curvature <= 0:
        return Minimum(value(at), float("inf"), gain)
    shift = (left - right) / (2 * curvature * step)
    deviation = (2 * here / max(freedom, 1) / curvature) ** 0.5
    return Minimum(value(at) + shift, deviation, gain)
