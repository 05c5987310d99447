"""Errors of a trajectory: of one, of one in segments, of relative poses."""

from dvo.metrics.conventions import other_convention
from dvo.metrics.metrics import (
    MINIMUM_MATCHES,
    Alignment,
    Metrics,
    align_trajectory,
    associate,
    evaluate,
    fit_alignment,
    relative_errors,
    relative_rotation_errors,
    stands_still,
    transform,
)

__all__ = [
    "MINIMUM_MATCHES",
    "Alignment",
    "Metrics",
    "align_trajectory",
    "associate",
    "evaluate",
    "fit_alignment",
    "other_convention",
    "relative_errors",
    "relative_rotation_errors",
    "stands_still",
    "transform",
]
