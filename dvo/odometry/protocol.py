"""What an odometry is: a thing that is fed frames and asked for a trajectory.

The learned tracker and every classical baseline stand behind :class:`Odometry`; the CLI, the eval harness, the plots
and the tests know nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol, runtime_checkable

import numpy as np

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory


class Status(StrEnum):
    """State of the tracker after a frame."""

    INITIALISING = "initialising"
    TRACKING = "tracking"
    LOST = "lost"


@dataclass(frozen=True)
class Estimate:
    """What is known right after a frame.

    Attributes:
        timestamp: seconds, of the frame.
        pose_wc: ``(7,)`` float64 camera to world, or None while nothing is known.
        status: state of the tracker.
        confidence: in [0, 1]; comparable within one run only.
    """

    timestamp: float
    pose_wc: np.ndarray | None
    status: Status
    confidence: float = 0.0


@dataclass(frozen=True)
class SparseMap:
    """Coloured points in the world frame of the trajectory.

    Attributes:
        points: ``(M, 3)`` float32.
        colors: ``(M, 3)`` uint8 RGB.
    """

    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))


@dataclass(frozen=True)
class Result:
    """What is known after the last frame.

    Attributes:
        trajectory: one row for every frame that was tracked (initialisation back-filled); lost frames have no row.
        map: the sparse coloured map, empty for systems without one.
        frames_read: frames fed.
        frames_lost: frames fed that have no row.
        info: facts for run.json (JSON-able): working resolution, intrinsics, number of keyframes.
    """

    trajectory: Trajectory
    map: SparseMap
    frames_read: int
    frames_lost: int
    info: dict[str, Any] = field(default_factory=dict)


@runtime_checkable
class Odometry(Protocol):
    """A visual odometry. One object tracks one sequence."""

    name: str

    def track(self, frame: Frame) -> Estimate:
        """Take the next frame (timestamps strictly increasing)."""
        ...

    def finish(self) -> Result:
        """Refine once more and return everything. May be called after any number of frames, also none or one."""
        ...
