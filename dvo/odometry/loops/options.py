"""Settings of loop closure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dvo.core.settings import Range, check_settings


@dataclass(frozen=True)
class LoopOptions:
    """Settings of loop closure (:mod:`dvo.odometry.loops.finder`), a table in those of the tracker (``loop``).

    Attributes:
        seconds: smallest time between the two visits of a place in a segment.
        every: kept keyframes between two searches.
        neighbours: keyframes before and after each of the two that are matched along.
        steps: of a search that are taken with a frame, each about as long as an update of the network.
        descriptor: name of the descriptor of images by which places are found again
            (:data:`dvo.odometry.loops.place_descriptors.PLACE_DESCRIPTORS`).
        delay: frames between the beginning of a correction and the frame that takes its result, so that tracking goes
            on meanwhile; 0 to do it within a frame, and searches as well.

    Raises:
        DvoError: a value of another type or out of range.

    Example:
        >>> odometry = dvo.load("small", loop={"seconds": 5.0, "every": 3})
    """

    RANGES: ClassVar[dict[str, Range]] = {
        "seconds": (0, 1e6), "every": (1, 10**4), "neighbours": (0, 8), "steps": (1, 10**4), "delay": (0, 10**4),
    }  # fmt: skip

    seconds: float = 10.0
    every: int = 6
    neighbours: int = 1
    steps: int = 1
    delay: int = 8
    descriptor: str = "grid"

    def __post_init__(self) -> None:
        check_settings(self, self.RANGES)
