"""End of a sequence: final adjustment of its segments, their scale, and metadata of the run."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

from dvo.map.keyframe_graph import KeyframeGraph
from dvo.odometry.checks.measures import measure_quality
from dvo.odometry.global_ba.focal_length import find_focal
from dvo.odometry.global_ba.self_calibration import adjust_segments
from dvo.odometry.loops.closure import LoopCloser
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.state import TrackerState
from dvo.odometry.protocol import Result
from dvo.odometry.quality import (
    CALIBRATE,
    MAX_SHIFT_GAIN,
    WRONG_BEND,
    WRONG_FOCAL,
    Quality,
)
from dvo.odometry.scale.metric_scale import settle_scale

SURE_CONTRAST = 0.02
"""Increase of the cost at focal lengths a fifth off above which the motion tells the focal length."""


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
        Metadata for run.json, see :func:`dvo.odometry.global_ba.self_calibration.adjust_segments` and
        :func:`dvo.odometry.scale.metric_scale.settle_scale`.
    """
    info: dict[str, Any] = {}
    if config.final_adjustment and state.adjustable:
        options = config.estimate_readout, config.adjustment
        info |= adjust_segments(graph, state.adjustable, state.shutter, *options)
    return info | settle_scale(graph, state.adjustable, config.scale, loops)


def judge_result(
    graph: KeyframeGraph, result: Result, state: TrackerState, config: TrackerConfig, stride: int
) -> Quality:
    """Quality of the result of a finished sequence; a good one is asked for its camera too.

    Poses and depths can make up for a wrong lens, so that the measurements agree and nothing else tells it. Distortion
    that is not in the calibration moves the corners as a crop that floats does.

    Args:
        graph: adjusted.
        result: of the sequence.
        state: of the tracker.
        config: of the tracker.
        stride: of the feature maps, pixels of the working image.

    Returns:
        Measures and verdict, see :mod:`dvo.odometry.quality`.
    """
    own = [k for k in state.adjustable if k >= graph.recording.segment]
    readout = state.info.get("readout", 0.0)
    shutter = replace(state.shutter, readout=readout if isinstance(readout, float) else 0.0)
    quality = measure_quality(
        graph, result, own, state.checks, stride=stride, shutter=shutter, first=state.started, fixed=state.hidden
    )
    if not (own and (quality.verdict == "good" or quality.crop > MAX_SHIFT_GAIN)):
        return quality
    longest = max(own, key=lambda segment: len(graph.members(segment)))
    profile = find_focal(graph, longest, shutter, config.adjustment, beyond=WRONG_FOCAL)
    step, sure = profile.minimum.value, profile.contrast >= SURE_CONTRAST
    if profile.bend.value > WRONG_BEND:
        lens = f"eucm, alpha {profile.bend.value:.2f}, beta 1"
        reason = f"the measurements fit a lens with more barrel distortion ({lens})"
    elif quality.verdict == "good" and sure and abs(step) > WRONG_FOCAL:
        reason = f"the measurements fit a focal length {math.exp(step):.2f} times the one that is used"
    else:
        return quality
    return replace(quality, verdict="doubtful", reason=reason, remedy=CALIBRATE)


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
