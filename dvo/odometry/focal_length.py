"""Focal length of a camera, from the measurements of a segment.

As with the readout time (:mod:`dvo.odometry.self_calibration`), the focal length is the one under which the
measurements agree best: for a value of it poses and inverse depths are solved for, and the value with the lowest robust
cost is wanted. Rotation and nearby structure tell it; for a camera that drives straight ahead a wrong focal length is
nearly made up for by other depths, and the cost stays flat.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.graph.problem import GraphProblem
from dvo.odometry.final_adjustment import AdjustmentOptions, solve_part
from dvo.odometry.rolling_shutter import PoseTrack, Shutter, as_global_shutter
from dvo.odometry.self_calibration import Minimum, profile_minimum

FEWEST = 20
"""Frames of a segment below which nothing is concluded."""
FARTHEST = 1.2
"""Largest distance of the values that are tried from the first one, in logarithms."""

_STEPS = 0.08, 0.02  # distance of the values that are tried, in logarithms: coarse, then fine
_ITERATIONS = 6
_SHUTTER_ROUNDS = 2  # solutions with corrected measurements, each from the motion of the last


@dataclass(frozen=True)
class FocalProfile:
    """Cost of the measurements over the focal length.

    Attributes:
        minimum: value and deviation are logarithms of the factor to the focal length of the graph.
        contrast: relative increase of the cost from its minimum to a focal length that is longer, and to one that is
            shorter, by a fifth, the lesser of the two; 0 for too few frames.
    """

    minimum: Minimum
    contrast: float


def find_focal(
    graph: KeyframeGraph,
    segment: int,
    shutter: Shutter,
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008 (frozen)
) -> FocalProfile:
    """Estimate the focal length, one factor of fx and fy.

    Args:
        graph: the segment is archived and adjusted; it is not changed.
        segment: its number.
        shutter: timing of the rows; a rolling shutter that is not corrected is taken for another focal length.
        options: of the adjustment; its last kernel counts.

    Returns:
        The profile; an infinite deviation if the cost still falls at the end of the range, or for fewer than
        :data:`FEWEST` frames.
    """
    frames = graph.members(segment)
    if len(frames) < FEWEST:
        return FocalProfile(Minimum(0.0, np.inf, 0.0), 0.0)
    part = graph.problem(True, segment)
    solve = _Solver(
        part, torch.tensor([frame.timestamp for frame in frames], dtype=torch.float64), shutter,
        replace(options, kernels=options.kernels[-1:], iterations=_ITERATIONS),
    )  # fmt: skip
    freedom = len(part.patches)
    coarse = profile_minimum(solve, 0.0, _STEPS[0], -FARTHEST, FARTHEST, freedom)
    if not np.isfinite(coarse.deviation):
        return FocalProfile(coarse, 0.0)
    fine = profile_minimum(solve, coarse.value, _STEPS[1], -FARTHEST, FARTHEST, freedom)
    here = solve(fine.value)
    sides = [solve(fine.value + side * float(np.log(1.2))) for side in (-1, 1)]
    return FocalProfile(replace(fine, gain=coarse.gain), min(sides) / here - 1 if here > 0 else 0.0)


class _Solver:
    """Cost of the best poses and depths for a factor of the focal length; begins from those of the nearest factor."""

    def __init__(self, part: GraphProblem, times: Tensor, shutter: Shutter, options: AdjustmentOptions) -> None:
        self.part, self.times, self.shutter, self.options = part, times, shutter, options
        self.index = torch.arange(len(part.poses_cw))
        depths = part.patches[:, 2, 0, 0].reshape(len(part.poses_cw), -1)
        self.known: dict[float, tuple[Tensor, Tensor]] = {0.0: (part.poses_cw, depths)}

    def __call__(self, log_factor: float) -> float:
        focal, centre = self.part.intrinsics.split(2, 1)
        part = replace(self.part, intrinsics=torch.cat([focal * float(np.exp(log_factor)), centre], 1))
        nearest = min(self.known, key=lambda known: (abs(known - log_factor), known))
        poses, depths = self.known[nearest]
        cost, fixed = 0.0, self.index < 1
        for _ in range(_SHUTTER_ROUNDS if self.shutter.readout > 0 else 1):
            seen = part
            if self.shutter.readout > 0:
                track = PoseTrack.through(self.times, poses)
                seen = as_global_shutter(part, poses, depths, self.index, track, self.shutter)
            poses, depths, cost = solve_part(seen, poses, depths, fixed, self.options)
        self.known[log_factor] = se3.normalise(poses), depths
        return cost
