"""What a tracker writes down as it goes: where every frame hangs, what left the window, the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from dvo.data.trajectory import Trajectory
from dvo.geometry import se3
from dvo.odometry.protocol import SparseMap

_IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])


@dataclass
class FrameRecord:
    """A frame of the video: its pose is ``relative`` after that of keyframe ``anchor`` (world to camera)."""

    timestamp: float
    anchor: int
    relative: np.ndarray
    lost: bool = False


class Chronicle:
    """Frames by the keyframes that they hang on, final poses of keyframes, and points.

    Attributes:
        frames: a record for every frame that was read, in order of time.
    """

    def __init__(self) -> None:
        self.frames: list[FrameRecord] = []
        self._settled: dict[int, np.ndarray] = {}
        self._points: list[np.ndarray] = []
        self._colors: list[np.ndarray] = []

    def add(self, timestamp: float, anchor: int) -> FrameRecord:
        """A frame with the pose of keyframe ``anchor``."""
        self.frames.append(FrameRecord(timestamp, anchor, _IDENTITY))
        return self.frames[-1]

    def rehang(self, gone: int, anchor: int, relative_cw: np.ndarray, oldest: int) -> None:
        """Keyframe ``gone`` is no more: its frames hang on ``anchor`` from now on.

        Args:
            relative_cw: ``(7,)`` pose of ``gone`` after that of ``anchor``.
            oldest: keyframe of the window; frames that hang on older ones end the search.
        """
        relative = torch.from_numpy(relative_cw)
        for record in reversed(self.frames):
            if record.anchor == gone:
                record.relative = se3.compose(torch.from_numpy(record.relative), relative).numpy()
                record.anchor = anchor
            elif record.anchor < oldest:
                break

    def settle(self, keyframe: int, pose_cw: np.ndarray) -> None:
        """The pose ``(7,)`` of a keyframe is final."""
        self._settled[keyframe] = pose_cw

    def add_points(self, points: np.ndarray, colors: np.ndarray) -> None:
        """World points ``(N, 3)`` and their RGB ``(N, 3)`` uint8."""
        self._points.append(points)
        self._colors.append(colors)

    @property
    def keyframes(self) -> int:
        """How many keyframes have settled."""
        return len(self._settled)

    def trajectory(self) -> Trajectory:
        """Every frame that was not lost and whose keyframe has settled, camera to world."""
        kept = [record for record in self.frames if not record.lost and record.anchor in self._settled]
        rows = np.zeros((0, 7))
        if kept:
            relative = torch.from_numpy(np.stack([record.relative for record in kept]))
            anchors = torch.from_numpy(np.stack([self._settled[record.anchor] for record in kept]))
            rows = se3.normalise(se3.inverse(se3.compose(relative, anchors))).numpy()
        return Trajectory(np.array([record.timestamp for record in kept], dtype=np.float64), rows)

    def map(self) -> SparseMap:
        """All points."""
        points = np.concatenate([np.zeros((0, 3), np.float32), *self._points])
        return SparseMap(points, np.concatenate([np.zeros((0, 3), np.uint8), *self._colors]))
