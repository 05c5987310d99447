"""Settings of loop closure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from dvo.settings import Range, check_settings


@dataclass(frozen=True)
class LoopOptions:
    """Settings of loop closure (:mod:`dvo.odometry.loops`).

    Attributes:
        seconds: smallest time between the two visits of a place in a segment.
        every: kept keyframes between two searches.
        pace: seconds between two kept keyframes above which the later one counts as several towards the next search.
        neighbours: keyframes before and after each of the two that are matched along.
        likeness: smallest similarity of the descriptors of a candidate by retrieval, in [-1, 1].
        retrieved: candidates by retrieval, at most.
        apart: identifiers of two such candidates differ by more than this.
        overlap: smallest share of the patches in view of a candidate by proximity.
        near: candidates by proximity, at most; ``seconds`` apart.
        guessed: least number of patches that agree on the pose of a candidate
            (:func:`dvo.odometry.loop_guess.order_pairs`).
        matched: candidates that are verified by the network, at most.
        updates: updates of the network before a candidate with fewer than ``hopeful`` inliers is refused, further ones
            before one with fewer than ``weak_inliers`` is, and further ones of a loop.
        hopeful: share of inliers among all patches of both visits.
        inliers: the same, with which a match is a loop.
        weak_inliers: the same, with which it is one if the pose agrees with the present one as closely as two loops
            that confirm each other (:mod:`dvo.odometry.loop_check`).
        steps: of a search that are taken with a frame, each about as long as an update of the network.
        delay: frames between the beginning of a correction and the frame that takes its result, so that tracking goes
            on meanwhile; 0 to do it within a frame, and searches as well.
        patience: searches after a loop within which a second one has to confirm it.
        translation, rotation, scale: largest differences of the corrections of two loops that confirm each other, in
            median depths, degrees, and as a ratio less one; largest corrections of a loop with few inliers.
        adjust_delay: as ``delay``, of a global adjustment (:mod:`dvo.odometry.graph_adjustment`).
        adjust_iterations: steps of a global adjustment beside tracking with each of its kernels, at most.
        adjust_frames, adjust_edges: newest keyframes of a world, and measurements between them, that it solves for, at
            most; those before are held.

    Raises:
        DvoError: a value of another type or out of range.
    """

    RANGES: ClassVar[dict[str, Range]] = {
        "seconds": (0, 1e6), "every": (1, 10**4), "pace": (1e-3, 1e6), "neighbours": (0, 8), "likeness": (-1, 1),
        "retrieved": (0, 100), "apart": (0, 10**4), "overlap": (0, 1), "near": (0, 100), "guessed": (0, 10**4),
        "matched": (0, 100), "hopeful": (0, 1), "inliers": (0, 1), "weak_inliers": (0, 1), "delay": (0, 10**4),
        "steps": (1, 10**4), "patience": (1, 100), "translation": (0, 1e3), "rotation": (0, 180),
        "scale": (0, 10), "adjust_delay": (0, 10**4), "adjust_iterations": (1, 1000), "adjust_frames": (3, 10**6),
        "adjust_edges": (1, 10**9),
    }  # fmt: skip

    seconds: float = 10.0
    every: int = 6
    pace: float = 0.5
    neighbours: int = 1
    likeness: float = 0.3
    retrieved: int = 8
    apart: int = 6
    overlap: float = 0.3
    near: int = 2
    guessed: int = 8
    matched: int = 3
    updates: tuple[int, int, int] = (2, 2, 8)
    hopeful: float = 0.03
    inliers: float = 0.4
    weak_inliers: float = 0.12
    steps: int = 1
    delay: int = 8
    patience: int = 4
    translation: float = 0.2
    rotation: float = 3.0
    scale: float = 0.1
    adjust_delay: int = 40
    adjust_iterations: int = 5
    adjust_frames: int = 600
    adjust_edges: int = 300_000

    def __post_init__(self) -> None:
        check_settings(self, self.RANGES)
