"""New recordings in a map: a tracker that begins in the graph of earlier ones.

The recording begins a segment with a world of its own. Its keyframes are compared with those of the map as with those
of any other segment (:mod:`dvo.odometry.loops.closure`); a confirmed loop moves the segment into the world and the
scale of the map, whose keyframes stay where they are.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import torch

from dvo.core.errors import DvoError
from dvo.data.images.image_header import image_size
from dvo.map.recordings import begin_recording
from dvo.odometry.frames.front_end import encode_image
from dvo.odometry.loops.finder import LoopFinder
from dvo.odometry.patch.state import TrackerState

if TYPE_CHECKING:
    from dvo.map.keyframe_graph import KeyframeGraph
    from dvo.models.patch_vo import PatchVO


def begin_in_map(graph: KeyframeGraph, finder: LoopFinder, state: TrackerState) -> None:
    """Begin the recording of a tracker in its map, with the first frame.

    Args:
        graph: of the map, with an empty window.
        finder: of loops, which holds the keyframes of the map.
        state: of the tracker.

    Raises:
        DvoError: a map in which no place can be recognised.
    """
    if not len(finder.places) or not any(finder.matcher.can_match(graph.archive[k]) for k in finder.kept):
        remedy = "make the map from a longer recording, with weights of as many features as small"
        raise DvoError("holds no keyframes that can be recognised", field="map", remedy=remedy)
    begin_recording(graph)
    state.map = None


def images_size(graph: KeyframeGraph) -> tuple[int, int] | None:
    """Width and height of the archived images, which all have one size; None without images.

    Args:
        graph: of a tracker.
    """
    sizes = (image_size(frame.jpeg.tobytes()) for frame in graph.archive if frame.jpeg is not None)
    return next((size for size in sizes if size is not None), None)


def take_places(finder: LoopFinder, model: PatchVO, segments: Collection[int], device: torch.device) -> None:
    """Give a finder the keyframes of a map, and the descriptors of those that have none yet, from their images.

    Args:
        finder: of a graph that has been read, with the descriptors of the file; changed in place.
        model: the network.
        segments: that were initialised.
        device: of the network.
    """
    graph, last = finder.graph, max(finder.places.identifiers.tolist(), default=-1)
    anchored = (frame for frame in graph.archive if frame.anchor is None)
    kept = [frame for frame in anchored if graph.segment_of(frame.identifier) in segments]
    finder.kept[:] = [frame.identifier for frame in kept]
    if finder.descriptor is None:
        return
    for frame in kept:
        image = frame.image() if frame.identifier > last else None
        if image is not None:
            maps = encode_image(model, image, device).matching
            finder.places.add(frame.identifier, finder.descriptor(image, maps))
