"""Self-calibration: readout time of a rolling shutter, from the measurements of a segment.

The readout time is the one under which the measurements agree best: for a value of it poses and depths are solved for,
and the value with the lowest robust cost is wanted. No ground truth takes part. With a global shutter the cost grows
from zero on; a motion that cannot tell leaves it flat, and then there is no correction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.map.map import Map
from dvo.map.recordings import count_earlier, increasing_times
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions, adjust_segment, extrapolated, solve_part
from dvo.odometry.global_ba.rolling_shutter import PoseTrack, Shutter, as_global_shutter

_FRAMES = 80  # of a segment that are looked at, those with most motion
_MIN_FRAMES = 20  # frames below which nothing is concluded
_GAIN = 0.02  # relative decrease of the cost below which a readout time is not believed
_STEP = 0.2  # distance of the values that are tried, frame intervals
_MAX_READOUT = 1.2  # end of the range, frame intervals: a minimum near one interval needs a neighbour on both sides
_ITERATIONS = 4


@dataclass(frozen=True)
class Minimum:
    """Lowest point of a profile.

    Attributes:
        value: of the parameter.
        deviation: standard deviation of the value; inf if the lowest point is at the end of the range.
        gain: relative decrease of the cost from the first value to the lowest one that was tried.
    """

    value: float
    deviation: float
    gain: float


def profile_minimum(
    cost: Callable[[float], float], start: float, step: float, low: float, high: float, freedom: int
) -> Minimum:
    """Walk downhill from a value in steps, and fit a parabola to the lowest three points.

    Args:
        cost: profile of the parameter.
        start: first value.
        step: distance of the points.
        low, high: range of the parameter.
        freedom: number of independent residuals, which scales the deviation.

    Returns:
        The minimum.
    """
    known = {0: cost(start)}
    at = 0
    while True:
        for index in (at - 1, at + 1):
            if index not in known and low - 1e-12 <= start + index * step <= high + 1e-12:
                known[index] = cost(start + index * step)
        best = min((at, at - 1, at + 1), key=lambda index: known.get(index, np.inf))
        if best == at:
            break
        at = best
    left, here, right = known.get(at - 1), known[at], known.get(at + 1)
    gain = 1 - here / known[0] if known[0] > 0 else 0.0
    if left is None or right is None or left + right - 2 * here <= 0:
        return Minimum(start + at * step, np.inf, gain)
    curvature = (left + right - 2 * here) / step**2
    value = start + at * step + (left - right) / (2 * curvature * step)
    return Minimum(value, float(np.sqrt(2 * here / max(freedom, 1) / curvature)), gain)


def find_readout(
    graph: Map,
    segment: int,
    rows: float,
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008 (frozen)
) -> Minimum:
    """Estimate the readout time of the camera, in seconds.

    Args:
        graph: the segment is archived and adjusted for a global shutter; it is not changed.
        segment: its number.
        rows: height of the feature map.
        options: of the adjustment.

    Returns:
        The readout time, with an infinite deviation if the cost still falls beyond the frame interval; 0 with a gain of
        0 for too few frames.
    """
    frames = graph.members(segment)
    identifiers = np.array([frame.identifier for frame in frames])
    earlier = count_earlier(graph, identifiers)  # keyframes of a map, whose camera may be another one
    if len(frames) - earlier < _MIN_FRAMES:
        return Minimum(0.0, np.inf, 0.0)
    times = increasing_times(graph, frames)
    now = graph.poses_cw(identifiers)
    own = [np.median(frame.inverse_depth) for frame in frames[earlier:]]
    first = earlier + _busiest(now[earlier:], float(np.median(own)))
    last = min(first + _FRAMES, len(frames)) - 1
    part = graph.problem(True, segment, int(identifiers[first]) if first else 0, int(identifiers[last]))
    part = part.edges(part.kk % 2 == 0).planned()  # half of the patches tell it as well
    index = torch.from_numpy(np.searchsorted(identifiers, part.identifiers.numpy()))
    fixed = index <= first
    depths = part.patches[:, 2, 0, 0].reshape(len(index), -1)
    settings = replace(options, kernels=options.kernels[-1:], iterations=_ITERATIONS)

    known: dict[float, tuple[Tensor, Tensor]] = {}

    def cost(readout: float) -> float:
        poses, now_depths = now[index], depths
        near = sorted(known, key=lambda value: (abs(value - readout), value))[:2]
        if near:
            poses, now_depths = known[near[0]]
        if len(near) == 2:
            ratio = (readout - near[0]) / (near[0] - near[1])
            poses, now_depths = extrapolated(poses, now_depths, *known[near[1]], ratio)
        found = 0.0
        # Without a trend to follow, a second round with the motion that the first has found.
        for _ in range(2 if readout > 0 and len(near) < 2 else 1):
            now[index] = poses
            track = PoseTrack.through(times, now)
            seen = as_global_shutter(part, poses, now_depths, index, track, Shutter(readout, rows))
            poses, now_depths, found = solve_part(seen, poses, now_depths, fixed, settings)
        known[readout] = poses, now_depths
        return found

    interval = float((times[1:] - times[:-1])[earlier:].median())
    return profile_minimum(cost, 0.0, _STEP * interval, 0.0, _MAX_READOUT * interval, depths.numel() // 2)


def adjust_segments(
    graph: Map,
    segments: Sequence[int],
    shutter: Shutter,
    estimate: bool,
    options: AdjustmentOptions = AdjustmentOptions(),  # noqa: B008 (frozen)
) -> dict[str, float | str]:
    """Final adjustment of segments; the readout time is that of the camera, or is estimated if the camera states none.

    Args:
        graph: all segments are archived; their poses and inverse depths are replaced.
        segments: their numbers; those of earlier recordings are left out.
        shutter: of the camera; a readout time of 0 is estimated from the longest segment.
        estimate: whether it is estimated, or a global shutter is assumed.
        options: of the adjustment.

    Returns:
        ``readout`` in seconds, and ``readout_from``: ``camera``, ``images``, or ``none`` for a global shutter.
    """
    own = (segment for segment in segments if segment >= graph.recording.segment)
    segments = sorted({graph.world_of(segment) for segment in own})  # joined ones are solved as one
    source = "camera" if shutter.readout > 0 else "none"
    sizes = {segment: adjust_segment(graph, segment, options, shutter) for segment in segments}
    if estimate and source == "none" and sizes:
        found = find_readout(graph, max(sizes, key=lambda segment: sizes[segment]), shutter.rows, options)
        if found.gain >= _GAIN and found.value > 0 and np.isfinite(found.deviation):
            shutter, source = replace(shutter, readout=found.value), "images"
            # All segments are near their solution already.
            corrected = replace(options, kernels=options.kernels[-1:], restart_frames=0)
            for segment in segments:
                adjust_segment(graph, segment, corrected, shutter)
    return {"readout": shutter.readout, "readout_from": source}


def _busiest(poses_cw: Tensor, inverse_depth: float) -> int:
    """Index of the first frame of the stretch with most motion, relative to a scene of the given inverse depth."""
    motion = se3.log(se3.relative(poses_cw[:-1], poses_cw[1:]))
    speed = motion[:, :3].norm(dim=1) * inverse_depth + motion[:, 3:].norm(dim=1)
    total = torch.cat([speed.new_zeros(1), speed.cumsum(0)])
    count = max(1, len(total) - _FRAMES)
    return int((total[-count:] - total[:count]).argmax())
