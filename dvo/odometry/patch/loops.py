"""Loop closure as the settings of the tracker ask for it."""

from __future__ import annotations

from collections.abc import Callable

import torch

from dvo.map.correction import Carried
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.places import PlaceIndex
from dvo.models.patch_vo import PatchVO
from dvo.odometry.loops.closure import LoopCloser
from dvo.odometry.loops.finder import LoopFinder
from dvo.odometry.loops.joint_window import GroupMatcher
from dvo.odometry.loops.place_descriptors import PLACE_DESCRIPTORS, PlaceDescriptor
from dvo.odometry.maintenance.adjuster import Adjuster
from dvo.odometry.maintenance.maintenance import MapMaintenance
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.state import TrackerState


def loop_closer(
    model: PatchVO, config: TrackerConfig, graph: KeyframeGraph, device: torch.device, state: TrackerState,
    follow: Callable[[Carried], None],
) -> LoopCloser:  # fmt: skip
    """Loop closure of a tracker.

    Args:
        model: the network.
        config: of the tracker.
        graph: of the tracker.
        device: of the computation.
        state: of the tracker.
        follow: is told how the newest poses of each world have moved.
    """
    build = PLACE_DESCRIPTORS.resolve(config.loop.descriptor)
    described: PlaceDescriptor | None = build(model.config.feature_channels)
    places = PlaceIndex(1 if described is None else described.dimensions)
    finder = LoopFinder(graph, GroupMatcher(model, config.measuring, device), places, described, config.loop)
    adjuster = Adjuster(graph, lambda: state.shutter, config.adjustment, config.adjust_after_loop)
    maintenance = MapMaintenance(config.real_time, config.loop.steps)
    return LoopCloser(graph, finder, config.loops, maintenance, adjuster, follow)
