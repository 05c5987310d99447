"""System for the evaluation: a camera that stands still."""

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status


class StandingStill:
    """Gives every frame the same pose, ``height`` metres above the origin."""

    name = "standing-still"

    def __init__(self, height: float = 0.0) -> None:
        self._pose, self._times = np.array([0.0, -height, 0, 0, 0, 0, 1]), []

    def track(self, frame):
        self._times.append(frame.timestamp)
        return Estimate(frame.timestamp, self._pose, Status.TRACKING, 1.0)

    def finish(self):
        times = np.array(self._times)
        return Result(Trajectory(times, np.tile(self._pose, (len(times), 1))), SparseMap(), len(times), 0)
