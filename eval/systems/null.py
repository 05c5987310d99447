"""Null system: a straight line at constant speed, no rotation, images unread.

Its errors are those of a system without information, the zero line of every table (on short forward windows it scores
around one percent of the path).
"""

from __future__ import annotations

import numpy as np

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status


class NullMotion:
    """Moves one unit per second along the optical axis of the first frame."""

    name = "null"

    def __init__(self, seed: int = 0) -> None:
        self._times: list[float] = []
        self._size = (0, 0)

    def track(self, frame: Frame) -> Estimate:
        self._times.append(frame.timestamp)
        self._size = (frame.camera.width, frame.camera.height)
        return Estimate(frame.timestamp, self._poses()[-1], Status.TRACKING, 0.0)

    def finish(self) -> Result:
        trajectory = Trajectory(np.array(self._times), self._poses())
        return Result(trajectory, SparseMap(), len(self._times), 0, {"working_size": list(self._size)})

    def _poses(self) -> np.ndarray:
        poses = np.zeros((len(self._times), 7))
        poses[:, 6] = 1
        if self._times:
            poses[:, 2] = np.array(self._times) - self._times[0]
        return poses
