"""Recall of true revisits from scores of all pairs of keyframes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

RIGHT = 0.3
"""Least shared view of a true revisit."""
WRONG = 0.01
"""Shared view below which a candidate shows another place; between the two, neither right nor wrong."""
COUNTS = (1, 3, 5)
LOWEST = -9.0


class Recall(NamedTuple):
    """Recall on one sequence.

    Attributes:
        queries: keyframes that are true revisits.
        first: share of them with a right one among the first 1, 3 and 5 candidates.
        precise: share of them whose first candidate is right and scores higher than the first candidate of any keyframe
            of the sequence that shows another place: recall at a precision of 100 % by the score alone.
    """

    queries: int
    first: tuple[float, ...]
    precise: float


def recall_of(scores: np.ndarray, shared: np.ndarray, allowed: np.ndarray, apart: int = 0) -> Recall:
    """Recall from scores.

    Args:
        scores: ``(N, N)`` of keyframes (rows) with candidates (columns).
        shared: ``(N, N)`` shared view.
        allowed: ``(N, N)`` bool, the pairs that are asked for.
        apart: numbers of two candidates differ by more, see :meth:`dvo.map.places.PlaceIndex.query`.

    Returns:
        The recall; of no queries nan.
    """
    scores, shared = np.where(allowed, scores, LOWEST), np.where(allowed, shared, 0)
    queries = shared.max(1) >= RIGHT
    order = np.argsort(-scores, axis=1, kind="stable")
    candidates = [_spread(row, apart)[: max(COUNTS)] for row in order]
    right = np.zeros((len(scores), max(COUNTS)), bool)
    for number, row in enumerate(candidates):
        right[number, : len(row)] = shared[number, row] >= RIGHT
    best = order[:, 0]
    rows = np.arange(len(scores))
    top, overlap = scores[rows, best], shared[rows, best]
    others = top[allowed.any(1) & (overlap < WRONG)]
    bar = others.max() if len(others) else LOWEST
    if not queries.any():
        return Recall(0, (float("nan"),) * len(COUNTS), float("nan"))
    first = tuple(float(right[queries, :count].any(1).mean()) for count in COUNTS)
    return Recall(int(queries.sum()), first, float((right[queries, 0] & (top[queries] > bar)).mean()))


def _spread(order: np.ndarray, apart: int) -> np.ndarray:
    """First candidates of an order whose numbers differ by more than ``apart``."""
    chosen: list[int] = []
    for number in order:
        if len(chosen) == max(COUNTS):
            break
        if all(abs(number - other) > apart for other in chosen):
            chosen.append(int(number))
    return np.array(chosen)
