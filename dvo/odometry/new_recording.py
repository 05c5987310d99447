"""New recordings in an old map: a tracker that begins again in the graph of a finished one.

The recording begins a segment with a world of its own. Its keyframes are compared with those of the map as with those
of any other segment (:mod:`dvo.odometry.loop_closure`); a confirmed loop moves the segment into the world and the scale
of the map, whose keyframes stay where they are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from dvo.data.image_header import image_size
from dvo.errors import DvoError
from dvo.graph.places import PlaceIndex
from dvo.graph.recordings import begin_recording
from dvo.odometry.config import PRESETS, TrackerConfig, with_changes
from dvo.odometry.frame_sequence import RequiredSize
from dvo.odometry.front_end import encode_image
from dvo.odometry.loop_closure import loop_closer

if TYPE_CHECKING:
    from dvo.graph.keyframe_graph import KeyframeGraph
    from dvo.odometry.tracker import PatchOdometry


def new_recording(
    old: PatchOdometry, *, seed: int | None = None, preset: str = "default", **overrides: Any
) -> PatchOdometry:
    """Tracker of a new recording in the map of another one.

    Args:
        old: with keyframes; finished if it is not yet. Its graph is taken over: do not use it any more.
        seed: of the patch centres; None for that of the map.
        preset: settings on top of those of the map, a name in :data:`dvo.odometry.config.PRESETS`.
        overrides: single settings, by the names of :class:`dvo.odometry.config.TrackerConfig`; they win.

    Returns:
        The tracker, before its first frame.

    Raises:
        DvoError: an unknown or invalid setting, one that does not go with the map, or a map in which no place can be
            recognised.
    """
    from dvo.odometry.tracker import PatchOdometry

    config = with_changes(old.config, preset, PRESETS, {"loops": True, **overrides})
    _check(old, config)
    old.finish()
    found = PatchOdometry(
        old.model, config, seed=old.seed if seed is None else seed, device=old.device, name=old.name,
        archive=old.graph.archive.config, weights=old.weights,
    )  # fmt: skip
    _take_over(found.graph, old.graph)
    found.state.keyframes, found.state.adjustable = old.state.keyframes, list(old.state.adjustable)
    found.loops = loop_closer(found.model, config, found.graph, found.device, found.state)
    found.loops.loops[:] = old.loops.loops
    finder = found.loops.finder
    finder.kept[:] = _kept(old)
    with torch.inference_mode():
        finder.places = describe_places(old)
    if not len(finder.places) or not any(finder.matcher.can_match(found.graph.archive[k]) for k in finder.kept):
        remedy = "make the map from a longer recording, with weights of as many features as small"
        raise DvoError("holds no keyframes that can be recognised", field="map", remedy=remedy)
    require_size(found)
    return found


def require_size(odometry: PatchOdometry) -> None:
    """Demand working images of the size of those of the map, before the first frame of a recording.

    Args:
        odometry: with or without keyframes of earlier recordings.
    """
    size = images_size(odometry.graph)
    if size is not None:
        odometry.state.sequence.required = RequiredSize(size, odometry.config.pixels)


def images_size(graph: KeyframeGraph) -> tuple[int, int] | None:
    """Width and height of the archived images, which all have one size; None without images.

    Args:
        graph: of a tracker.
    """
    sizes = (image_size(frame.jpeg.tobytes()) for frame in graph.archive if frame.jpeg is not None)
    return next((size for size in sizes if size is not None), None)


def describe_places(odometry: PatchOdometry) -> PlaceIndex:
    """Descriptors of the keyframes of a finished tracker; those of one without loops are computed from its images.

    Args:
        odometry: not changed.

    Returns:
        The index; empty for a network without a descriptor.
    """
    places, descriptor = odometry.loops.finder.places, odometry.loops.finder.descriptor
    if len(places) or descriptor is None:
        return places
    places = PlaceIndex(descriptor.dimensions)
    for identifier in _kept(odometry):
        image = odometry.graph.archive[identifier].image()
        if image is not None:
            maps = encode_image(odometry.model, image, odometry.device).matching
            places.add(identifier, descriptor(image, maps))
    return places


def _kept(odometry: PatchOdometry) -> list[int]:
    """Keyframes of initialised segments that were not dropped."""
    graph, segments = odometry.graph, set(odometry.state.adjustable)
    kept = (frame.identifier for frame in graph.archive if frame.anchor is None)
    return [identifier for identifier in kept if graph.segment_of(identifier) in segments]


def _check(old: PatchOdometry, config: TrackerConfig) -> None:
    """Refuse settings under which nothing could be recognised, or that the graph does not allow."""
    if config.patches != old.config.patches:
        remedy = f"leave out patches, or give {old.config.patches}"
        raise DvoError(f"is {config.patches}, the map has {old.config.patches}", field="patches", remedy=remedy)
    if not config.loops or old.model.config.fine_channels:
        reason = "a network with a fine level closes no loops" if config.loops else "loops are turned off"
        remedy = "make the map with the weights small" if config.loops else "turn them on (loops=True)"
        raise DvoError(f"a map is recognised by loops, but {reason}", field="loops", remedy=remedy)


def _take_over(graph: KeyframeGraph, old: KeyframeGraph) -> None:
    """Put the content of a graph with an empty window into a new one, and begin a recording in it."""
    graph.archive, graph.log = old.archive, old.log
    graph.segment, graph.starts, graph.worlds, graph.loops = old.segment, old.starts, old.worlds, old.loops
    graph.recordings, graph.metric = old.recordings, old.metric
    begin_recording(graph)
