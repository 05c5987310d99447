"""An odometry that knows the answer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Result, Segment, SparseMap, Status


class FakeOdometry:
    """Knows the answer: pose ``motion(t)``, with optional lost frames and frames at which it calls something.

    From each frame of ``new_segment`` on, poses belong to a further segment, with a world and a scale of its own.
    """

    name = "fake"

    def __init__(
        self,
        motion: Callable[[float], np.ndarray],
        lost: tuple[int, ...] = (),
        at_frame: dict[int, Callable[[], None]] | None = None,
        new_segment: tuple[int, ...] = (),
        reason: str = "black image",
    ) -> None:
        self.motion, self.lost, self.at_frame = motion, lost, at_frame or {}
        self.new_segment, self.reason = new_segment, reason
        self.frames: list[Frame] = []
        self.asked: dict[str, Any] = {}

    def segment_of(self, frame: Frame) -> int:
        return sum(frame.index >= first for first in self.new_segment)

    def pose_wc(self, frame: Frame) -> np.ndarray:
        pose = np.array(self.motion(frame.timestamp), float)
        segment = self.segment_of(frame)
        pose[:3] = pose[:3] * (1 + segment) + 10 * segment
        return pose

    def track(self, frame: Frame) -> Estimate:
        self.at_frame.get(frame.index, lambda: None)()
        self.frames.append(frame)
        if frame.index in self.lost:
            return Estimate(frame.timestamp, None, Status.LOST, 0.0, self.segment_of(frame), self.reason)
        return Estimate(frame.timestamp, self.pose_wc(frame), Status.TRACKING, 1.0, self.segment_of(frame))

    def finish(self) -> Result:
        kept = [frame for frame in self.frames if frame.index not in self.lost]
        segments = []
        for number in sorted({self.segment_of(frame) for frame in kept}):
            part = [frame for frame in kept if self.segment_of(frame) == number]
            times, poses = np.array([f.timestamp for f in part]), np.array([self.pose_wc(f) for f in part])
            segments.append(Segment(Trajectory(times, poses), float(times[0]), float(times[-1])))
        nothing = Trajectory(np.zeros(0), np.zeros((0, 7)))
        return Result(
            max(segments, key=len).trajectory if segments else nothing,
            SparseMap(
                np.linspace(-1, 1, 30, dtype=np.float32).reshape(10, 3), np.arange(30, dtype=np.uint8).reshape(10, 3)
            ),
            len(self.frames),
            len(self.frames) - len(kept),
            {"config": {"patches": 3}, "working_size": (64, 48)},
            tuple(segments),
        )


def curve(seconds: float) -> np.ndarray:
    """``(7,)`` pose on a smooth curve in all three dimensions, turning."""
    angle = 0.4 * seconds
    position = [np.cos(angle), 0.3 * np.sin(2 * angle), np.sin(angle) + 0.2 * seconds]
    return np.array([*position, 0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2)])
