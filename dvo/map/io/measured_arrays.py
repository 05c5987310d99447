"""Measured depths of archived keyframes as arrays, and back; without any a file has none of these arrays."""

from __future__ import annotations

import numpy as np

from dvo.map.io.map_file import MapReader
from dvo.map.keyframe_graph import KeyframeGraph


def has_measured(graph: KeyframeGraph) -> bool:
    """True if any keyframe has measured depths.

    Args:
        graph: its archive is looked at.
    """
    return any(frame.measured is not None for frame in graph.archive)


def measured_arrays(graph: KeyframeGraph) -> dict[str, np.ndarray]:
    """Measured depths as arrays.

    Args:
        graph: any.

    Returns:
        Arrays by name; none if the graph has no measured depths.
    """
    if not has_measured(graph):
        return {}
    values = [frame.measured for frame in graph.archive.keyframes]
    there = [value for value in values if value is not None]
    return {
        "archive/has_measured": np.array([value is not None for value in values], np.uint8),
        "archive/measured": np.stack(there).astype(np.float32),
    }


def read_measured(source: MapReader, graph: KeyframeGraph, measured: bool, metric: tuple[tuple[int, str], ...]) -> None:
    """Give the archived keyframes of a graph their measured depths, and its worlds their scales.

    Args:
        source: map file, with :func:`measured_arrays` if there are measured depths.
        graph: read from it otherwise.
        measured: whether there are.
        metric: worlds in metres, and what their scale came from.

    Raises:
        DvoError: a missing or invalid array, or a world that is not there.
    """
    graph.metric = dict(metric)
    source.require(all(0 <= k <= graph.segment for k in graph.metric), "holds no such world", "graph: metric")
    if not measured:
        return
    frames = graph.archive.keyframes
    there = source.array("archive/has_measured", np.uint8, (len(frames),), 0, 1) > 0
    values = source.array("archive/measured", np.float32, (int(there.sum()), graph.window.per_frame, 2), 0, 1e12)
    for row, value in zip(np.flatnonzero(there).tolist(), values, strict=True):
        source.require(len(frames[row].inverse_depth), "of a keyframe without patches", "archive/measured")
        graph.archive.set_measured(frames[row].identifier, value)
