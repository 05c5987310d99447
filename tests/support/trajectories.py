"""Trajectories for tests of errors: moved into another world, and cut into segments."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from dvo.data.trajectory import Trajectory
from dvo.metrics import transform
from dvo.metrics.segment_metrics import rows_of
from dvo.odometry.protocol import Segment


def moved(trajectory: Trajectory, scale: float, turn: float) -> Trajectory:
    """The trajectory in another world."""
    return transform(trajectory, scale, Rotation.from_rotvec([0, turn, 0.1]).as_matrix(), np.array([5.0, -1, 2]))


def segment(trajectory: Trajectory, joined_to: int | None = None) -> Segment:
    """The trajectory as a segment."""
    return Segment(trajectory, float(trajectory.timestamps[0]), float(trajectory.timestamps[-1]), joined_to)


def cut(trajectory: Trajectory, *bounds: int) -> list[Trajectory]:
    """Pieces of the trajectory, cut before these rows."""
    edges = [0, *bounds, len(trajectory)]
    return [rows_of(trajectory, np.arange(a, b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]
