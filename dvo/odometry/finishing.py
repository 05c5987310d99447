"""End of a sequence: final adjustment of its segments, their scale, and metadata of the run."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.odometry.config import TrackerConfig
from dvo.odometry.loop_closure import LoopCloser
from dvo.odometry.metric_scale import settle_scale
from dvo.odometry.self_calibration import adjust_segments
from dvo.odometry.tracker_state import TrackerState


def finish_segments(
    graph: KeyframeGraph, state: TrackerState, config: TrackerConfig, loops: LoopCloser
) -> dict[str, Any]:
    """Adjust the segments of a finished sequence, and bring them to metres if the scale is known.

    Args:
        graph: everything is archived; changed in place.
        state: of the tracker.
        config: of the tracker.
        loops: whose measurements are scaled along.

    Returns:
        Metadata for run.json, see :func:`dvo.odometry.self_calibration.adjust_segments` and
        :func:`dvo.odometry.metric_scale.settle_scale`.
    """
    info: dict[str, Any] = {}
    if config.final_adjustment and state.adjustable:
        options = config.estimate_readout, config.adjustment
        info |= adjust_segments(graph, state.adjustable, state.shutter, *options)
    return info | settle_scale(graph, state.adjustable, config.scale, loops)


def run_information(
    graph: KeyframeGraph, state: TrackerState, config: TrackerConfig, loops: LoopCloser, seed: int
) -> dict[str, Any]:
    """Metadata of a recording for run.json; of a map without a frame of a new recording, those of the map.

    Args:
        graph: of the tracker.
        state: of the tracker, with the entries of its parts.
        config: of the tracker.
        loops: of the tracker.
        seed: of the patch centres.
    """
    if state.map is not None:
        return {**state.map.info, "seed": state.map.seed, "config": asdict(state.map.config)}
    begun, keyframes = graph.recording, graph.log.poses
    return {
        **state.info, **loops.information(), "keyframes": sum(k >= begun.keyframe for k in keyframes),
        "seed": seed, "initialised": any(k >= begun.segment for k in state.adjustable), "config": asdict(config),
    }  # fmt: skip
