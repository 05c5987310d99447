"""State of a tracker between two frames, beside its graph and what is cached for it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from dvo.odometry.checks.check_pairs import CheckPairs
from dvo.odometry.frames.fixed_pixels import FixedPixels
from dvo.odometry.frames.frame_sequence import FrameSequence
from dvo.odometry.frames.front_end import View
from dvo.odometry.global_ba.rolling_shutter import Shutter
from dvo.odometry.patch.map_tables import MapTable
from dvo.odometry.protocol import Estimate
from dvo.odometry.quality import Quality


@dataclass
class TrackerState:
    """State of :class:`dvo.odometry.patch.tracker.PatchOdometry`.

    Attributes:
        generator: of the patch centres.
        sequence: order, size and intervals of the frames.
        keyframes: number of identifiers of keyframes given so far.
        tracked: frames of the segment since its initialisation.
        waited: frames of the segment before it.
        initialised: the segment is.
        ambiguous: its window may have a second solution (:mod:`dvo.odometry.uncertainty.second_solution`).
        finished: no frame is taken any more.
        adjustable: segments that were initialised.
        waiting: frames with content since tracking was lost.
        joining: cause of the interruption that the next frame has to be joined across; empty for none.
        skipped: the interruption is a gap in time.
        last: last working image and its estimate; None before the first frame.
        world: that of the last pose of the segment (:meth:`KeyframeGraph.world_of`); -1 before its first one.
        shutter: timing of the rows of the last frame.
        info: metadata for run.json.
        fixed: pixels that are fixed to the images.
        hidden: share of the last image that they are, without those of a given mask.
        checks: measurements that take no part in the trajectory.
        started: timestamp of the first measured pose, seconds; None before it.
        quality: of the result, after ``finish``.
        map: of the file that the tracker was loaded from, until the first frame of the new recording.
    """

    generator: torch.Generator
    sequence: FrameSequence
    keyframes: int = 0
    tracked: int = 0
    waited: int = 0
    initialised: bool = False
    ambiguous: bool = False
    finished: bool = False
    adjustable: list[int] = field(default_factory=list)
    waiting: list[View] = field(default_factory=list)
    joining: str = ""
    skipped: bool = False
    last: tuple[np.ndarray, Estimate] | None = None
    world: int = -1
    shutter: Shutter = Shutter(0.0, 1.0)
    info: dict[str, object] = field(default_factory=dict)
    map: MapTable | None = None
    fixed: FixedPixels = field(default_factory=FixedPixels)
    hidden: float = 0.0
    checks: CheckPairs = field(default_factory=CheckPairs)
    started: float | None = None
    quality: Quality | None = None

    def begin_segment(self) -> None:
        """Forget the segment that has been closed."""
        self.initialised, self.joining, self.skipped, self.tracked, self.world = False, "", False, 0, -1
        self.ambiguous, self.waited = False, 0

    def enter(self, segment: int, world: int) -> bool:
        """Record the world of a pose.

        Args:
            segment: number of its segment.
            world: number of the earliest segment with the same world.

        Returns:
            True if the pose is the first one since the segment was joined to this world.
        """
        before, self.world = self.world, world
        return world not in (segment, before)
