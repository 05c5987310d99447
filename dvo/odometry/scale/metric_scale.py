"""Scale of finished segments in metres, from depth frames, a known height of the camera or known distances.

Measured depths take part in every bundle adjustment; here their agreement with the result is told. A known distance
between two times, or a known height over the ground, would be a factor that touches the scale of a world alone, because
scale is a free direction of every other measurement: the optimum of the whole problem is that of the problem without
the factor, scaled so that the factor holds. That is what happens here, after the final adjustment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory, interpolate
from dvo.map.archive import ArchivedKeyframe
from dvo.map.correction import Moved, rescale
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.odometry.depth.depth_factor import metres_of_unit
from dvo.odometry.depth.scale_options import ScaleOptions
from dvo.odometry.loops.closure import LoopCloser
from dvo.odometry.scale.ground_plane import ground_height

_MIN_DEPTHS = 20  # measured depths that a world needs
_SYSTEMATIC = (
    0.01  # relative error of the scale that all measured depths of a recording share, see docs/metric_scale.md
)


@dataclass(frozen=True)
class ObservedScale:
    """Scale of a world.

    Attributes:
        factor: metres that the unit of the world was long before it was scaled; nan if it was not found.
        deviation: standard deviation of the factor relative to it; nan if it is not known, as for a single distance.
        observations: number of them: depths, keyframes with a ground plane, or distances.
        problem: cause for a scale that was not found, empty otherwise.
    """

    factor: float
    deviation: float = math.nan
    observations: int = 0
    problem: str = ""

    @property
    def found(self) -> bool:
        """True if the scale is known."""
        return math.isfinite(self.factor) and self.factor > 0


def settle_scale(
    graph: KeyframeGraph, segments: Sequence[int], options: ScaleOptions, loops: LoopCloser | None = None
) -> dict[str, Any]:
    """Bring segments to metres, and tell from what their scale came.

    Args:
        graph: all segments are archived; poses and inverse depths are scaled in place where the source asks for it.
        segments: numbers of those that were initialised; those of earlier recordings are left out.
        options: source of the scale.
        loops: whose measurements are scaled along.

    Returns:
        ``scale`` for run.json, with ``source``, ``unit`` (metres, if any segment is in metres) and an entry for each
        segment; nothing without a source, unless a recording was recognised in a map in metres.
    """
    begun = graph.recording.segment
    own = sorted({segment for segment in segments if segment >= begun})
    known: dict[int, ObservedScale] = {}
    for world in sorted({graph.world_of(segment) for segment in own}):
        if world in graph.metric:  # of a map, which stays as it is
            known[world] = ObservedScale(1.0)
        elif options.source != "none" and world >= begun:
            known[world] = observe(graph, world, own, options)
            if known[world].found:
                if not options.measures:
                    units = rescale(graph, world, known[world].factor)
                    if loops is not None:
                        loops.moved(Moved(units))
                graph.metric[world] = options.source
    if not known:
        return {}
    entries = [
        {
            "segment": segment - begun,
            "source": graph.metric.get(graph.world_of(segment), "none") if graph.world_of(segment) >= begun else "map",
            **_facts(known[graph.world_of(segment)]),
        }
        for segment in own
        if graph.world_of(segment) in known
    ]
    source = "map" if options.source == "none" else options.source
    unit = "metres" if any(entry["source"] != "none" for entry in entries) else "arbitrary"
    return {"scale": {"source": source, "unit": unit, "segments": entries}}


def observe(graph: KeyframeGraph, world: int, segments: Sequence[int], options: ScaleOptions) -> ObservedScale:
    """Estimate the scale of a world from the source of the options.

    Args:
        graph: its segments are archived.
        world: its number.
        segments: numbers of the segments that may belong to it.
        options: source of the scale, not ``none``.

    Returns:
        The scale, or why it was not found.
    """
    if options.measures:
        return scale_of_depths(graph.members(world))
    if options.source == "height":
        kept = [frame for frame in graph.members(world) if frame.anchor is None]
        poses = graph.poses_cw(np.array([frame.identifier for frame in kept])).numpy()
        found = ground_height(kept, poses, options.tilt)
        if not math.isfinite(found.height):
            problem = f"no ground plane: found below {found.keyframes} of {found.looked_at} keyframes"
            return ObservedScale(math.nan, observations=found.keyframes, problem=problem)
        return ObservedScale(options.height / found.height, found.deviation, found.keyframes)
    rows = [graph.log.trajectory(k) for k in segments if graph.world_of(k) == world]
    times, poses_wc = np.concatenate([r.timestamps for r in rows]), np.concatenate([r.poses_wc for r in rows])
    order = np.argsort(times, kind="stable")
    return scale_of_distances(Trajectory(times[order], poses_wc[order]), options.distances)


def scale_of_depths(frames: Sequence[ArchivedKeyframe]) -> ObservedScale:
    """Agreement of a solution with its measured depths, which are part of it already.

    Args:
        frames: archived keyframes of one world.

    Returns:
        Factor 1. Its standard deviation is that of the mean over the keyframes, where the depths of one frame share the
        errors of its registration, and count as one observation; and of 1 % that all depths share, as by the
        calibration of the cameras.
    """
    logs = [
        np.log(metres_of_unit(f.inverse_depth.astype(np.float64), f.measured.astype(np.float64)))
        for f in frames
        if f.measured is not None
    ]
    logs = [values for values in logs if len(values)]
    count = sum(map(len, logs))
    if count < _MIN_DEPTHS:
        return ObservedScale(math.nan, observations=count, problem=f"too few measured depths: {count}")
    medians = np.array([np.median(values) for values in logs])
    spread = 1.4826 * float(np.median(np.abs(medians - np.median(medians))))
    return ObservedScale(1.0, math.hypot(spread / math.sqrt(len(medians)), _SYSTEMATIC), count)


def scale_of_distances(trajectory: Trajectory, distances: Sequence[tuple[float, float, float]]) -> ObservedScale:
    """Least-squares scale of a trajectory from distances between its positions.

    Args:
        trajectory: of one world.
        distances: ``(from, to, metres)``, times in seconds.

    Returns:
        Scale ``sum(l D) / sum(l^2)`` of lengths ``l`` and distances ``D``, of those whose times lie within the
        trajectory, with a standard deviation from the residuals if there are several.
    """
    if not len(trajectory):
        return ObservedScale(math.nan, problem="no poses")
    start, end = trajectory.timestamps[[0, -1]]
    pairs = [row for row in distances if start - 1e-6 <= row[0] and row[1] <= end + 1e-6]
    if not pairs:
        asked = ", ".join(f"{first:g} to {last:g}" for first, last, _ in distances[:3])
        return ObservedScale(math.nan, problem=f"the segment, {start:.2f} to {end:.2f} s, does not cover {asked} s")
    lengths, metres = np.zeros(len(pairs)), np.array([row[2] for row in pairs])
    for k, row in enumerate(pairs):
        times = np.clip(np.array(row[:2]), start, end)
        ends = interpolate(trajectory, times, max_gap=np.inf).positions
        lengths[k] = np.linalg.norm(ends[1] - ends[0])
    if lengths.max() < 1e-9:
        return ObservedScale(math.nan, problem="the camera does not move between the two times")
    factor = float((lengths * metres).sum() / (lengths**2).sum())
    if len(pairs) == 1:
        return ObservedScale(factor, observations=1)
    variance = ((factor * lengths - metres) ** 2).sum() / (len(pairs) - 1) / (lengths**2).sum()
    return ObservedScale(factor, math.sqrt(float(variance)) / factor, len(pairs))


def _facts(scale: ObservedScale) -> dict[str, Any]:
    """Entries of run.json; numbers that are not known are None."""
    numbers = {"factor": scale.factor, "deviation": scale.deviation}
    facts: dict[str, Any] = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
    return facts | {"observations": scale.observations} | ({"problem": scale.problem} if scale.problem else {})
