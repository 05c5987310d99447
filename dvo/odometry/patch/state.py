"""State of a tracker between two frames, beside its graph and what is cached for it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto

import numpy as np
import torch

from dvo.odometry.checks.check_pairs import CheckPairs
from dvo.odometry.frames.fixed_pixels import FixedPixels
from dvo.odometry.frames.front_end import View
from dvo.odometry.frames.gate import Admitted
from dvo.odometry.global_ba.rolling_shutter import Shutter
from dvo.odometry.patch.map_tables import MapTable
from dvo.odometry.protocol import Estimate
from dvo.odometry.quality import Quality

RESTART_AGES = frozenset({4, 8, 16, 32})
"""Numbers of frames after the initialisation at which its solution is compared with others."""
RETRY_EVERY = 8
"""Frames from one comparison to the next as long as another solution is nearly as good."""


class Phase(Enum):
    """What a tracker does with the next frame that has content."""

    INITIALISING = auto()  # adds it to a window without poses
    TRACKING = auto()  # inserts it into the window
    INTERRUPTED = auto()  # joins it with the window across lost frames or a gap, or a new segment begins


@dataclass(frozen=True)
class Interruption:
    """What separates the next frame from the window.

    Attributes:
        reason: in words.
        is_gap: time has passed, and no frame was lost before it.
    """

    reason: str
    is_gap: bool = False


@dataclass
class TrackerState:
    """State of :class:`dvo.odometry.patch.tracker.PatchOdometry`.

    Attributes:
        generator: of the patch centres.
        keyframes: number of identifiers of keyframes given so far.
        tracked: frames of the segment since its initialisation.
        waited: frames of the segment before it.
        phase: of the segment.
        interruption: while the phase is ``INTERRUPTED``, what the next frame has to be joined across.
        ambiguous: its window may have a second solution (:mod:`dvo.odometry.uncertainty.second_solution`).
        adjustable: segments that were initialised.
        waiting: frames with content since tracking was lost.
        last: estimate of the last frame; None before the first one.
        world: that of the last pose of the segment (:meth:`KeyframeGraph.world_of`); -1 before its first one.
        shutter: timing of the rows of the last frame.
        info: metadata for run.json.
        fixed: pixels that are fixed to the images.
        hidden: share of the last image that they are, without those of a given mask.
        beginning: frames of the recording, as long as it may begin anew; None after that.
        checks: measurements that take no part in the trajectory.
        started: timestamp of the first measured pose, seconds; None before it.
        quality: of the result, after ``finish``.
        guess: ``(7,)`` pose ``T_cw`` of the present frame by alignment, for the network to begin with; None: none.
        map: of the file that the tracker was loaded from, until the first frame of the new recording.
    """

    generator: torch.Generator
    keyframes: int = 0
    tracked: int = 0
    waited: int = 0
    phase: Phase = Phase.INITIALISING
    interruption: Interruption | None = None
    ambiguous: bool = False
    adjustable: list[int] = field(default_factory=list)
    waiting: list[View] = field(default_factory=list)
    last: Estimate | None = None
    world: int = -1
    shutter: Shutter = Shutter(0.0, 1.0)
    info: dict[str, object] = field(default_factory=dict)
    map: MapTable | None = None
    fixed: FixedPixels = field(default_factory=FixedPixels)
    hidden: float = 0.0
    beginning: list[Admitted] | None = field(default_factory=list)
    checks: CheckPairs = field(default_factory=CheckPairs)
    started: float | None = None
    quality: Quality | None = None
    guess: np.ndarray | None = None

    @property
    def initialised(self) -> bool:
        """True if the segment has poses."""
        return self.phase is not Phase.INITIALISING

    @property
    def restart_due(self) -> bool:
        """True if a second solution is looked for now (:func:`dvo.odometry.patch.initialisation.leave_minimum`).

        The first frames have too little parallax to tell a relief from the reversed one; later frames have more: at
        :data:`RESTART_AGES`, and each :data:`RETRY_EVERY` frames as long as the window is ambiguous.
        """
        return self.tracked in RESTART_AGES or (self.ambiguous and self.tracked % RETRY_EVERY == 0)

    def begin_segment(self) -> None:
        """Forget the segment that has been closed."""
        self.phase, self.interruption, self.tracked, self.world = Phase.INITIALISING, None, 0, -1
        self.ambiguous, self.waited = False, 0

    def initialise(self, segment: int) -> None:
        """Begin to track a segment.

        Args:
            segment: its number.
        """
        self.phase = Phase.TRACKING
        self.adjustable.append(segment)

    def interrupt(self, reason: str, *, is_gap: bool = False) -> str:
        """Note that the next frame does not follow the window; what has interrupted it first counts.

        Args:
            reason: in words.
            is_gap: time has passed without a frame.

        Returns:
            The reason that counts.
        """
        if self.phase is Phase.TRACKING:
            self.phase, self.interruption = Phase.INTERRUPTED, Interruption(reason, is_gap)
        return reason if self.interruption is None else self.interruption.reason

    def resume(self) -> str:
        """Note that a frame was joined with the window.

        Returns:
            Reason of a break before it: that of a gap in time, where no lost frame tells of it.
        """
        gap = "" if self.interruption is None or not self.interruption.is_gap else self.interruption.reason
        self.phase, self.interruption = Phase.TRACKING, None
        return gap

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
