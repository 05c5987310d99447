"""Measured depths of a graph, and slopes of surfaces, as arrays, and back; without any a file has none of these arrays.

Slopes are those of the window alone: measurements of archived patches are not aligned again. Files that were written
before there were slopes have none.
"""

from __future__ import annotations

import numpy as np
import torch

from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.graph.map_file import MapReader

STEEPEST = 1e3
"""Slope of a surface above which a file is refused, 1 / feature pixel."""
_SLOPES = "window/slopes"


def has_measured(graph: KeyframeGraph) -> bool:
    """True if any keyframe has measured depths.

    Args:
        graph: archive and window are looked at.
    """
    return graph.window.measured is not None or any(frame.measured is not None for frame in graph.archive)


def measured_arrays(graph: KeyframeGraph) -> dict[str, np.ndarray]:
    """Measured depths and slopes as arrays.

    Args:
        graph: any.

    Returns:
        Arrays by name; none of what the graph does not have.
    """
    m, arrays = graph.window.per_frame, {}
    if graph.window.slopes is not None:
        arrays[_SLOPES] = graph.window.slopes.reshape(-1, m, 2).float().cpu().numpy()
    if not has_measured(graph):
        return arrays
    parts = {"archive": [f.measured for f in graph.archive.keyframes]}
    parts["window"] = [None if f.measured is None else f.measured.cpu().numpy() for f in graph.window.frames]
    for name, values in parts.items():
        there = [value for value in values if value is not None]
        arrays[f"{name}/has_measured"] = np.array([value is not None for value in values], np.uint8)
        arrays[f"{name}/measured"] = np.stack(there).astype(np.float32) if there else np.zeros((0, m, 2), np.float32)
    return arrays


def read_measured(source: MapReader, graph: KeyframeGraph, measured: bool, metric: tuple[tuple[int, str], ...]) -> None:
    """Give the keyframes of a graph their measured depths and slopes, and its worlds their scales.

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
    m, device = graph.window.per_frame, graph.window.poses_cw.device
    if source.has(_SLOPES):
        slopes = source.array(_SLOPES, np.float32, (len(graph.window), m, 2), -STEEPEST, STEEPEST)
        for kept, values in zip(graph.window.frames, slopes, strict=True):
            kept.slopes = torch.from_numpy(values.copy()).to(device)
    if not measured:
        return
    frames = graph.archive.keyframes
    for frame, values in zip(frames, _read(source, "archive", len(frames), m), strict=True):
        source.require(values is None or len(frame.inverse_depth), "of a keyframe without patches", "archive/measured")
        if values is not None:
            graph.archive.set_measured(frame.identifier, values)
    for kept, values in zip(graph.window.frames, _read(source, "window", len(graph.window), m), strict=True):
        kept.measured = None if values is None else torch.from_numpy(values).to(device)


def _read(source: MapReader, name: str, count: int, per_frame: int) -> list[np.ndarray | None]:
    """Measured depths of each keyframe, None for one without."""
    there = source.array(f"{name}/has_measured", np.uint8, (count,), 0, 1) > 0
    values = iter(source.array(f"{name}/measured", np.float32, (int(there.sum()), per_frame, 2), 0, 1e12))
    return [next(values).copy() if known else None for known in there]
