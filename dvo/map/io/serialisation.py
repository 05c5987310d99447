"""A keyframe graph as arrays and plain values, and back; files of a graph alone or with a tracker.

The archive is written as it is held (float16 features, JPEG images). A graph with keyframes in its window is written as
it would be had they just been archived; a file has no window.

Log and archive each have a function that writes arrays, by names such as ``archive/poses_cw``, and one that reads and
checks them. What they refuse would fail later: indices out of range, anchors that lead nowhere or in a circle, sizes
that do not belong together, times that do not increase.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from dvo.data.images.image_header import MAX_PIXELS, image_size
from dvo.map.archive import ArchiveConfig, ArchivedKeyframe
from dvo.map.io.map_file import MapReader, open_map_file, write_map_file
from dvo.map.io.measured_arrays import has_measured, measured_arrays, read_measured
from dvo.map.io.old_window import archive_old_window
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.keyframe_log import FrameRecord, KeyframeLog
from dvo.map.map import Recording
from dvo.map.measurements import ArchivedEdges
from dvo.map.recordings import increase

Arrays = dict[str, np.ndarray]
_LAST = 2**31 - 1  # largest number of a keyframe


@dataclass(frozen=True)
class GraphTable:
    """Plain values of a graph in a map file.

    Attributes:
        per_frame: patches of a frame.
        patch_size: side of a patch.
        hidden: channels of the state of the update operator.
        segment: number of the current segment.
        archive: bound and content of the archive.
        reasons: causes of losses and breaks that the log refers to.
        loops: number of loops whose measurements are archived.
        worlds: by segment, the earliest segment with the same world; none where no segments have been joined.
        recordings: first frame, keyframe and segment of the second recording and of those after it.
        measured: keyframes have depths by a depth camera.
        metric: worlds in metres, and what their scale came from.
    """

    per_frame: int
    patch_size: int
    hidden: int
    segment: int
    archive: ArchiveConfig
    reasons: tuple[str, ...]
    loops: int = 0
    worlds: tuple[int, ...] = ()
    recordings: tuple[tuple[int, int, int], ...] = ()
    measured: bool = False
    metric: tuple[tuple[int, str], ...] = ()

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "per_frame": (1, 2**14),
        "patch_size": (1, 9),
        "hidden": (1, 4096),
        "segment": (0, _LAST),
        "loops": (0, _LAST),
    }


def save_graph(file: str | Path, graph: KeyframeGraph) -> None:
    """Write a graph to a file; a tracker does so with :meth:`dvo.odometry.patch.tracker.PatchOdometry.save`.

    Args:
        file: to write, by convention ``*.dvo``; replaced as a whole.
        graph: the graph.

    Raises:
        DvoError: the file cannot be written.
    """
    table, arrays = graph_arrays(graph)
    write_map_file(file, {"graph": table}, arrays)


def load_graph(file: str | Path, device: torch.device | str = "cpu") -> KeyframeGraph:
    """Read the graph of a map file, whether or not the file holds a tracker too. No network is needed.

    Args:
        file: written by :func:`save_graph`, by ``odometry.save`` or by ``dvo run --save-map``.
        device: of the window's tensors.

    Returns:
        The graph.

    Raises:
        DvoError: no such file, not a map, one of a newer version, or an invalid content, with the name of the array.

    Example:
        >>> graph = load_graph("office.dvo")
        >>> points, colors = graph.points(segment=0)
        >>> trajectory = graph.log.trajectory()
    """
    with open_map_file(file) as source:
        table = source.table(GraphTable, "graph")
        device = torch.device(device)
        graph = KeyframeGraph(table.per_frame, table.patch_size, table.hidden, device, table.archive)
        read_graph(source, graph, table)
        return graph


def graph_arrays(graph: KeyframeGraph) -> tuple[dict[str, Any], Arrays]:
    """Graph as plain values and arrays.

    Args:
        graph: its poses are vectors ``(7,)``. It is not changed.

    Returns:
        JSON-able values of a :class:`GraphTable`, and arrays by name.
    """
    if len(graph.window):
        graph = graph.copy()
        graph.archive_window()
    window = graph.window
    reasons = sorted({record.reason for record in graph.log.frames})
    table = GraphTable(
        window.per_frame, window.patches.shape[-1], window.hidden.shape[1], graph.segment, graph.archive.config,
        tuple(reasons), graph.loops, tuple(map(graph.world_of, range(graph.segment + 1))) if graph.worlds else (),
        tuple((begun.frame, begun.keyframe, begun.segment) for begun in graph.recordings[1:]),
        has_measured(graph), tuple(sorted(graph.metric.items())),
    )  # fmt: skip
    arrays = {"segments": np.array(graph.starts, np.int64)} | _log_arrays(graph.log, reasons) | _archive_arrays(graph)
    return asdict(table), arrays | measured_arrays(graph)


def read_graph(source: MapReader, graph: KeyframeGraph, table: GraphTable) -> None:
    """Fill an empty graph from a map file.

    Args:
        source: the file.
        graph: newly built, of the sizes in ``table``.
        table: plain values of the graph.

    Raises:
        DvoError: a missing or invalid array.
    """
    graph.segment, graph.loops = table.segment, table.loops
    worlds = np.array(table.worlds, np.int64)
    fits = len(worlds) in (0, table.segment + 1) and (worlds >= 0).all() and (worlds <= np.arange(len(worlds))).all()
    source.require(fits and (worlds[worlds] == worlds).all(), "not a world for each segment", "graph: worlds")
    graph.worlds = dict(enumerate(worlds.tolist()))
    starts = source.array("segments", np.int64, (None, 2), low=-1, high=_LAST)
    first = starts[:, 0]
    ordered = len(first) > 0 and first[0] == 0 and (np.diff(first) >= 0).all()
    source.require(ordered, "does not list segments by their first keyframe, from 0", "segments")
    source.require((starts[:, 1] <= table.segment).all(), "numbers segments beyond the last one", "segments")
    graph.starts[:] = [(int(keyframe), int(number)) for keyframe, number in starts]
    begun = [(0, 0, 0), *table.recordings]
    listed = all(a <= b <= _LAST for one, two in pairwise(begun) for a, b in zip(one, two, strict=True))
    source.require(listed and begun[-1][2] <= table.segment, "does not list recordings in order", "graph: recordings")
    graph.recordings[:] = [Recording(*row) for row in begun]
    _read_log(source, graph.log, table)
    source.require(begun[-1][0] <= len(graph.log.frames), "begins after the last frame", "graph: recordings")
    _read_archive(source, graph)
    read_measured(source, graph, table.measured, table.metric)
    if source.has("window/keyframes"):
        archive_old_window(source, graph)
    _check_keyframes(source, graph)


def _log_arrays(log: KeyframeLog, reasons: list[str]) -> Arrays:
    frames, number = log.frames, {reason: index for index, reason in enumerate(reasons)}
    moved = [index for index, record in enumerate(frames) if record.relative is not None]
    points, colors = log.points()
    return {
        "log/times": np.array([record.timestamp for record in frames], np.float64),
        "log/anchors": np.array([-1 if record.anchor is None else record.anchor for record in frames], np.int64),
        "log/lost": np.array([record.lost for record in frames], np.uint8),
        "log/segments": np.array([record.segment for record in frames], np.int64),
        "log/reasons": np.array([number[record.reason] for record in frames], np.int64),
        "log/moved": np.array(moved, np.int64),
        "log/relative": _poses([frames[index].relative for index in moved]),
        "log/keyframes": np.array(list(log.poses), np.int64),
        "log/poses_cw": _poses(log.poses.values()),
        "log/removed": np.array([(gone, kept) for gone, (kept, _) in log.removed.items()], np.int64).reshape(-1, 2),
        "log/removed_relative": _poses([relative for _, relative in log.removed.values()]),
        "log/points": points,
        "log/colors": colors,
    }


def _read_log(source: MapReader, log: KeyframeLog, table: GraphTable) -> None:
    times = source.array("log/times", np.float64, (None,))
    n = len(times)
    begun = [first for first, _, _ in table.recordings]
    source.require(increase(times, begun), "holds times that do not increase", "log/times")
    anchors = source.array("log/anchors", np.int64, (n,), -1, _LAST)
    lost = source.array("log/lost", np.uint8, (n,), 0, 1)
    segments = source.array("log/segments", np.int64, (n,), 0, table.segment)
    reasons = source.array("log/reasons", np.int64, (n,), 0, len(table.reasons) - 1)
    for time, anchor, gone, segment, reason in zip(times, anchors, lost, segments, reasons, strict=True):
        place = None if anchor < 0 else int(anchor)
        record = FrameRecord(float(time), place, None, bool(gone), int(segment), table.reasons[reason])
        log.frames.append(record)
    moved = source.array("log/moved", np.int64, (None,), 0, n - 1)
    for index, relative in zip(moved, source.poses("log/relative", np.float64, len(moved)), strict=True):
        log.frames[index].relative = relative
    removed = source.array("log/removed", np.int64, (None, 2), 0, _LAST)
    source.require((removed[:, 1] < removed[:, 0]).all(), "holds an anchor after its keyframe", "log/removed")
    relative = source.poses("log/removed_relative", np.float64, len(removed))
    for (gone, kept), pose in zip(removed.tolist(), relative, strict=True):
        log.reanchor(gone, kept, pose)
    keyframes = source.array("log/keyframes", np.int64, (None,), 0, _LAST)
    for keyframe, pose in zip(
        keyframes.tolist(), source.poses("log/poses_cw", np.float64, len(keyframes)), strict=True
    ):
        log.set_pose(keyframe, pose)
    points = source.array("log/points", np.float32, (None, 3))
    if len(points):
        log.add_points(points, source.array("log/colors", np.uint8, (len(points), 3)))


def _archive_arrays(graph: KeyframeGraph) -> Arrays:
    frames, parts = graph.archive.keyframes, graph.archive.parts
    m, p = graph.window.per_frame, graph.window.patches.shape[-1]
    patched = [frame for frame in frames if len(frame.inverse_depth)]
    described = [frame for frame in frames if frame.matching is not None and frame.context is not None]
    edges = ArchivedEdges.concatenate([part.unpack() for part in parts])
    masks = [frame.mask for frame in frames]
    return {
        "archive/keyframes": np.array([frame.identifier for frame in frames], np.int64),
        "archive/times": np.array([frame.timestamp for frame in frames], np.float64),
        "archive/intrinsics": _stack([frame.intrinsics for frame in frames], np.float32, (4,)),
        "archive/poses_cw": _poses([frame.pose_cw for frame in frames]),
        "archive/anchors": np.array([-1 if f.anchor is None else f.anchor for f in frames], np.int64),
        "archive/has_patches": np.array([len(frame.inverse_depth) > 0 for frame in frames], np.uint8),
        "archive/centres": _stack([frame.centres for frame in patched], np.float32, (m, 2)),
        "archive/inverse_depth": _stack([frame.inverse_depth for frame in patched], np.float32, (m,)),
        "archive/colors": _stack([frame.colors for frame in patched], np.uint8, (m, 3)),
        "archive/has_features": np.array([f.matching is not None and f.context is not None for f in frames], np.uint8),
        "archive/matching": _stack([f.matching for f in described], np.float16, (m, 0, p, p)),
        "archive/context": _stack([f.context for f in described], np.float16, (m, 0)),
        **_file_arrays("archive/jpeg", [frame.jpeg for frame in frames]),
        **(_file_arrays("archive/mask", masks) if any(mask is not None for mask in masks) else {}),
        "edges/parts": np.array([len(part) for part in parts], np.int64),
        "edges/source": edges.source,
        "edges/patch": edges.patch,
        "edges/target": edges.target,
        "edges/position": edges.position,
        "edges/weight": edges.weight,
    }


def _read_archive(source: MapReader, graph: KeyframeGraph) -> None:
    m, p = graph.window.per_frame, graph.window.patches.shape[-1]
    identifiers = source.array("archive/keyframes", np.int64, (None,), 0, _LAST)
    n = len(identifiers)
    source.require(len(np.unique(identifiers)) == n, "holds a keyframe twice", "archive/keyframes")
    times = source.array("archive/times", np.float64, (n,))
    intrinsics = source.array("archive/intrinsics", np.float32, (n, 4))
    source.require((intrinsics[:, :2] > 0).all(), "holds a focal length that is not positive", "archive/intrinsics")
    poses = source.poses("archive/poses_cw", np.float64, n)
    anchors = source.array("archive/anchors", np.int64, (n,), -1)
    source.require((anchors < identifiers).all(), "holds an anchor after its keyframe", "archive/anchors")
    patched, patch_row = _rows(source.array("archive/has_patches", np.uint8, (n,), 0, 1))
    centres = source.array("archive/centres", np.float32, (patched, m, 2))
    depth = source.array("archive/inverse_depth", np.float32, (patched, m))
    colors = source.array("archive/colors", np.uint8, (patched, m, 3))
    described, feature_row = _rows(source.array("archive/has_features", np.uint8, (n,), 0, 1))
    matching = source.array("archive/matching", np.float16, (described, m, None, p, p))
    context = source.array("archive/context", np.float16, (described, m, None))
    images = _split_files(source, "archive/jpeg", n)
    masks = _split_files(source, "archive/mask", n) if source.has("archive/mask") else [None] * n
    pairs = [(mask, image) for mask, image in zip(masks, images, strict=True) if mask is not None]
    fits = all(image is not None and _size(mask) == _size(image) for mask, image in pairs)
    source.require(fits, "holds masks without an image of their size", "archive/mask")
    for i, identifier in enumerate(identifiers.tolist()):
        a, b = int(patch_row[i]), int(feature_row[i])
        graph.archive.add(
            ArchivedKeyframe(
                identifier=identifier,
                timestamp=float(times[i]),
                intrinsics=intrinsics[i].copy(),
                pose_cw=poses[i].copy(),
                anchor=None if anchors[i] < 0 else int(anchors[i]),
                centres=np.zeros((0, 2), np.float32) if a < 0 else centres[a].copy(),
                inverse_depth=np.zeros(0, np.float32) if a < 0 else depth[a].copy(),
                colors=np.zeros((0, 3), np.uint8) if a < 0 else colors[a].copy(),
                matching=None if b < 0 else matching[b].copy(),
                context=None if b < 0 else context[b].copy(),
                jpeg=images[i],
                mask=masks[i],
            )
        )
    _read_edges(source, graph, m)


def _read_edges(source: MapReader, graph: KeyframeGraph, per_frame: int) -> None:
    parts = source.array("edges/parts", np.int64, (None,), 1, 2**40)
    count = int(parts.sum())
    edges = ArchivedEdges(
        source.array("edges/source", np.int32, (count,), 0),
        source.array("edges/patch", np.int16, (count,), 0, per_frame - 1),
        source.array("edges/target", np.int32, (count,), 0),
        source.array("edges/position", np.float32, (count, 2)),
        source.array("edges/weight", np.float16, (count, 2), 0),
    )
    for end, length in zip(np.cumsum(parts).tolist(), parts.tolist(), strict=True):
        graph.archive.add_edges(edges.select(np.arange(end - length, end)))


def _file_arrays(name: str, files: list[np.ndarray | None]) -> Arrays:
    """Contents of files, one after the other, and their lengths, -1 for none."""
    return {
        f"{name}_bytes": np.array([-1 if file is None else len(file) for file in files], np.int64),
        name: np.concatenate([np.zeros(0, np.uint8), *(file for file in files if file is not None)]),
    }


def _size(file: np.ndarray) -> tuple[int, int] | None:
    return image_size(file.tobytes())


def _split_files(source: MapReader, name: str, count: int) -> list[np.ndarray | None]:
    """Image file of each archived keyframe, all of one size."""
    lengths = source.array(f"{name}_bytes", np.int64, (count,), -1, 2**31)
    total = int(lengths.clip(min=0).sum())
    content = source.array(name, np.uint8, (total,))
    found: list[np.ndarray | None] = []
    sizes, start = set(), 0
    for length in lengths.tolist():
        found.append(None if length < 0 else content[start : start + length])
        start += max(length, 0)
        file = found[-1]
        if file is not None:
            sizes.add(_size(file))
    source.require(len(sizes) <= 1, "holds images of different sizes", name)
    for size in sizes:
        fits = size is not None and 0 < size[0] * size[1] <= MAX_PIXELS
        source.require(fits, "holds images without a size, or too large ones", name)
    return found


def _check_keyframes(source: MapReader, graph: KeyframeGraph) -> None:
    """Refuse keyframes that are there twice, whose times do not increase, or whose anchors lead nowhere."""
    times = {frame.identifier: frame.timestamp for frame in graph.archive}
    ordered = np.array([times[identifier] for identifier in sorted(times)])
    begun = np.searchsorted(sorted(times), [recording.keyframe for recording in graph.recordings]).tolist()
    source.require(increase(ordered, begun), "holds keyframes whose times do not increase", "archive/times")
    # A dropped keyframe whose anchor was discarded is left out of everything; an anchor that is there leads on.
    dropped = [frame.anchor for frame in graph.archive if frame.anchor is not None and frame.anchor in graph.archive]
    further = {graph.archive[anchor].anchor for anchor in dropped} - {None}
    source.require(further <= set(times), "holds anchors that lead to no keyframe", "archive/anchors")


def _rows(mask: np.ndarray) -> tuple[int, np.ndarray]:
    """Number of the marked elements, and the row of each among them, -1 for others."""
    return int(mask.sum()), np.where(mask > 0, np.cumsum(mask, dtype=np.int64) - 1, -1)


def _poses(poses: Any) -> np.ndarray:
    return _stack(list(poses), np.float64, (7,))


def _stack(parts: list[Any], dtype: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Arrays along a new first axis; ``shape`` of one if there is none."""
    return np.stack(parts).astype(dtype) if parts else np.zeros((0, *shape), dtype)
