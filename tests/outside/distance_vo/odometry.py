"""Odometry of :class:`distance_vo.network.DistanceNet`: straight ahead, as far as the network says."""

import numpy as np
import torch

from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status


class DistanceOdometry:
    """Adds up distances along the optical axis."""

    def __init__(self, weights, *, device="cpu", seed=0, config=None, gain=1.0):
        if not gain > 0:
            raise DvoError(f"must be positive, got {gain}", field="gain", remedy="give 1")
        self.model, self.name, self.gain = weights.model.to(device).eval(), f"dvo-{weights.name}", gain
        self._before, self._pose, self._rows = None, np.array([0.0, 0, 0, 0, 0, 0, 1]), []

    @torch.inference_mode()
    def track(self, frame):
        image = torch.from_numpy(frame.image).permute(2, 0, 1)
        if self._before is not None:
            ahead = self.gain * float(self.model(torch.stack([self._before, image])[None]))
            self._pose = self._pose + [0, 0, ahead, 0, 0, 0, 0]
        self._before = image
        self._rows.append((frame.timestamp, self._pose))
        return Estimate(frame.timestamp, self._pose, Status.TRACKING, 1.0)

    def finish(self):
        times = np.array([time for time, _ in self._rows])
        poses = np.array([pose for _, pose in self._rows]).reshape(-1, 7)
        return Result(Trajectory(times, poses), SparseMap(), len(times), 0)
