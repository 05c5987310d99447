"""Appending of one keyframe graph to another, as its last recording."""

from __future__ import annotations

from dataclasses import replace

from dvo.map.map import Map
from dvo.map.measurements import ArchivedEdges


def append_graph(graph: Map, other: Map) -> tuple[int, int]:
    """Append the content of a graph; its segments keep their worlds.

    The bound of the archive becomes the sum of both, so that nothing is released.

    Args:
        graph: with an empty window and a recording that has been begun and has no frames; changed in place.
        other: with an empty window and a single recording; not changed.

    Returns:
        Numbers to add to the keyframes and to the segments of the other one.
    """
    keyframe, segment = graph.recording.keyframe, graph.recording.segment
    archive, config = graph.archive, graph.archive.config
    archive.config = replace(config, max_bytes=config.max_bytes + other.archive.config.max_bytes)
    for frame in other.archive.keyframes:
        anchor = None if frame.anchor is None else frame.anchor + keyframe
        archive.add(replace(frame, identifier=frame.identifier + keyframe, anchor=anchor))
    for part in other.archive.parts:
        archive.add_edges(moved_edges(part.unpack(), keyframe))
    log = graph.log
    for record in other.log.frames:
        anchor = None if record.anchor is None else record.anchor + keyframe
        log.frames.append(replace(record, anchor=anchor, segment=record.segment + segment))
    for gone, (kept, relative) in other.log.removed.items():
        log.reanchor(gone + keyframe, kept + keyframe, relative)
    for identifier, pose_cw in other.log.poses.items():
        log.set_pose(identifier + keyframe, pose_cw)
    starts = [(first + keyframe, number if number < 0 else number + segment) for first, number in other.starts]
    graph.starts[-1:] = starts
    graph.worlds |= {number + segment: world + segment for number, world in other.worlds.items()}
    graph.segment += other.segment
    graph.loops += other.loops
    return keyframe, segment


def moved_edges(edges: ArchivedEdges, keyframe: int) -> ArchivedEdges:
    """Edges with other numbers of their keyframes.

    Args:
        edges: the measurements.
        keyframe: number to add.

    Returns:
        The edges.
    """
    source, target = (numbers + numbers.dtype.type(keyframe) for numbers in (edges.source, edges.target))
    return replace(edges, source=source, target=target)
