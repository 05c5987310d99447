"""Focal length and principal point of a camera, from the measurements of a segment.

As with the readout time (:mod:`dvo.odometry.global_ba.self_calibration`), the focal length is the one under which the
measurements agree best: for a value of it poses and inverse depths are solved for, and the value with the lowest robust
cost is wanted. Rotation and nearby structure tell it; for a camera that drives straight ahead a wrong focal length is
nearly made up for by other depths, and the cost stays flat. The principal point is found in the same way, each of its
coordinates on its own, at the focal length of least cost.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from dvo.ba.patch_problem import PatchProblem
from dvo.geometry import se3
from dvo.map.map import Map
from dvo.map.recordings import increasing_times
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions, extrapolated, solve_part, thinned
from dvo.odometry.global_ba.rolling_shutter import PoseTrack, Shutter, as_global_shutter
from dvo.odometry.global_ba.self_calibration import Minimum, profile_minimum

MIN_KEYFRAMES = 20
"""Frames of a segment below which nothing is concluded."""
FARTHEST = 1.2
"""Largest distance of the values that are tried from the first one, in logarithms."""
ASIDE = 0.08
"""Largest distance of a principal point that is tried from that of the graph, focal lengths."""

MIN_CONTRAST = 0.005
"""Contrast of the coarse minimum below which no finer one is looked for."""

QUICK_FRAMES = 40
"""Frames of a quick look, if there are fewer keyframes."""

_STEPS = 0.08, 0.02  # distance of the values that are tried, in logarithms: coarse, then fine
_ASIDE_STEP = 0.01  # distance of the principal points that are tried, focal lengths
_ITERATIONS = 6
_FAR = 4.0  # extrapolation, times the distance that is known
_SHUTTER_ROUNDS = 2  # solutions with corrected measurements, each from the motion of the last


_UNKNOWN = Minimum(0.0, np.inf, 0.0)


@dataclass(frozen=True)
class FocalProfile:
    """Cost of the measurements over the focal length.

    Attributes:
        minimum: value and deviation are logarithms of the factor to the focal length of the graph.
        contrast: relative increase of the cost from its minimum to a focal length that is longer, and to one that is
            shorter, by a fifth, the lesser of the two; 0 for too few frames.
        aside: value and deviation, in focal lengths, of the way from the principal point of the graph to that of least
            cost, to the right and down; with infinite deviations if they were not looked for.
    """

    minimum: Minimum
    contrast: float
    aside: tuple[Minimum, Minimum] = field(default_factory=lambda: (_UNKNOWN, _UNKNOWN))


def find_focal(
    graph: Map,
    segment: int,
    shutter: Shutter,
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008 (frozen)
    *,
    beyond: float | None = None,
) -> FocalProfile:
    """Estimate the focal length, one factor of fx and fy, and if wanted the principal point.

    Args:
        graph: the segment is archived and adjusted; it is not changed.
        segment: its number.
        shutter: timing of the rows; a rolling shutter that is not corrected is taken for another focal length.
        options: of the adjustment; its last kernel counts.
        beyond: logarithm of a factor; a profile whose minimum is nearer to the first value is of no interest. This is a
            quick look, without the principal point: at the keyframes, with dropped ones up to :data:`QUICK_FRAMES`, and
            with measurements that are corrected for a rolling shutter once.

    Returns:
        The profile; that of the coarse steps alone where it is flat (:data:`MIN_CONTRAST`), or of no interest, then
        with a contrast of 0. An infinite deviation if
        the cost still falls at the end of the range, or for fewer than :data:`MIN_KEYFRAMES` frames.
    """
    frames = graph.members(segment)
    if len(frames) < MIN_KEYFRAMES:
        return FocalProfile(_UNKNOWN, 0.0)
    part, times = graph.problem(True, segment), increasing_times(graph, frames)
    if beyond is not None:
        part, shutter = _corrected(part, times, shutter), replace(shutter, readout=0.0)
        kept = torch.tensor([frame.anchor is None for frame in frames])
        if not part.factors:
            part = part.select(thinned(kept, max(QUICK_FRAMES, int(kept.sum()))))
    solve = _Solver(
        part.planned(), times, shutter,
        replace(options, kernels=options.kernels[-1:], iterations=_ITERATIONS),
    )  # fmt: skip
    freedom = len(part.patches)
    coarse = profile_minimum(solve, 0.0, _STEPS[0], -FARTHEST, FARTHEST, freedom)
    # The minimum of a single valley is less than a step away from the lowest point that was tried.
    if (
        not np.isfinite(coarse.deviation)
        or beyond is not None
        and abs(coarse.value) <= min(_STEPS[0] / 2, beyond - _STEPS[0])
    ):
        return FocalProfile(coarse, 0.0)

    def contrast_at(value: float) -> float:
        sides = [solve(value + side * float(np.log(1.2))) for side in (-1, 1)]
        return min(sides) / here - 1 if (here := solve(value)) > 0 else 0.0

    flat = contrast_at(coarse.value)
    if flat < MIN_CONTRAST:
        return FocalProfile(coarse, flat)
    fine = profile_minimum(solve, coarse.value, _STEPS[1], -FARTHEST, FARTHEST, freedom)
    found = FocalProfile(replace(fine, gain=coarse.gain), contrast_at(fine.value))
    if beyond is not None:
        return found

    def aside(cost: Callable[[float], float]) -> Minimum:
        return profile_minimum(cost, 0.0, _ASIDE_STEP, -ASIDE, ASIDE, freedom)

    right = aside(lambda x: solve(fine.value, x))
    at = right.value if np.isfinite(right.deviation) else 0.0
    down = aside(lambda y: solve(fine.value, at, y))
    return replace(found, aside=(right, down))


def _corrected(part: PatchProblem, times: Tensor, shutter: Shutter) -> PatchProblem:
    """Measurements as a global shutter would have made them, by the present poses."""
    if shutter.readout <= 0:
        return part
    index, track = torch.arange(len(part.poses_cw)), PoseTrack.through(times, part.poses_cw)
    depths = part.inverse_depths.reshape(len(index), -1)
    return as_global_shutter(part, part.poses_cw, depths, index, track, shutter)


def _along(first: tuple[float, ...], second: tuple[float, ...], third: tuple[float, ...]) -> float | None:
    """Way from the second value to the third over that from the first to the second; None if they are on no line."""
    a, b = np.subtract(second, first), np.subtract(third, second)
    ratio = float(a @ b / (a @ a))
    return ratio if abs(ratio) <= _FAR and np.linalg.norm(b - ratio * a) < 1e-9 else None


class _Solver:
    """Cost of the best poses and depths for an intrinsic matrix; begins from those of the nearest one."""

    def __init__(self, part: PatchProblem, times: Tensor, shutter: Shutter, options: AdjustmentOptions) -> None:
        self.part, self.times, self.shutter, self.options = part, times, shutter, options
        self.index = torch.arange(len(part.poses_cw))
        depths = part.patches[:, 2, 0, 0].reshape(len(part.poses_cw), -1)
        self.known: dict[tuple[float, float, float], tuple[Tensor, Tensor]] = {(0.0, 0.0, 0.0): (part.poses_cw, depths)}

    def __call__(self, log_factor: float, right: float = 0.0, down: float = 0.0) -> float:
        focal, centre = self.part.intrinsics.split(2, 1)
        wanted = log_factor, right, down
        moved = centre + focal * torch.tensor([[right, down]], dtype=focal.dtype)
        part = self.part.with_values(intrinsics=torch.cat([focal * float(np.exp(log_factor)), moved], 1))
        nearest = sorted(self.known, key=lambda known: (math.dist(known, wanted), known))
        poses, depths = self.known[nearest[0]]
        if len(nearest) > 1 and (ratio := _along(nearest[1], nearest[0], wanted)) is not None:
            poses, depths = extrapolated(poses, depths, *self.known[nearest[1]], ratio)
        cost, fixed = 0.0, self.index < 1
        for _ in range(_SHUTTER_ROUNDS if self.shutter.readout > 0 else 1):
            seen = part
            if self.shutter.readout > 0:
                track = PoseTrack.through(self.times, poses)
                seen = as_global_shutter(part, poses, depths, self.index, track, self.shutter)
            poses, depths, cost = solve_part(seen, poses, depths, fixed, self.options)
        self.known[wanted] = se3.normalise(poses), depths
        return cost
