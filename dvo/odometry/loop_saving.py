"""Loop closure in map files: loops, the search for them, and descriptors of places."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from dvo.errors import DvoError
from dvo.graph.archive import ArchivedEdges
from dvo.graph.map_file import MapReader
from dvo.graph.places import PlaceIndex
from dvo.odometry.loop_closure import LoopCloser
from dvo.odometry.loops import Loop

_LAST = 2**31 - 1
_MOST = 1e9  # largest translation of a loop


@dataclass(frozen=True)
class LoopTable:
    """Loop without its measurement; see :class:`dvo.odometry.loops.Loop`."""

    old: int
    new: int
    kind: str
    inliers: float
    count: int
    joins: bool

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "old": (0, _LAST), "new": (0, _LAST), "inliers": (0, 1), "count": (0, _LAST),
    }  # fmt: skip


@dataclass(frozen=True)
class LoopsTable:
    """Plain values of the loop closure in a map file.

    Attributes:
        loops: confirmed ones.
        pending: loop that has not been confirmed yet.
        corrections, wait, searches: see :class:`dvo.odometry.loop_closure.LoopCloser`.
    """

    loops: tuple[LoopTable, ...]
    pending: LoopTable | None
    corrections: int
    wait: int
    searches: int

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "corrections": (0, _LAST), "wait": (-_LAST, _LAST), "searches": (0, _LAST),
    }  # fmt: skip


def _table(loop: Loop) -> LoopTable:
    return LoopTable(loop.old, loop.new, loop.kind, loop.inliers, loop.count, loop.joins)


def loops_table(closer: LoopCloser) -> dict[str, Any]:
    """JSON-able values of a :class:`LoopsTable`."""
    pending = None if closer.pending is None else _table(closer.pending)
    loops = tuple(_table(loop) for loop in closer.loops)
    return asdict(LoopsTable(loops, pending, closer.corrections, closer.wait, closer.searches))


def loops_arrays(closer: LoopCloser) -> dict[str, np.ndarray]:
    """Arrays of the loop closure by name."""
    every = [*closer.loops, *([] if closer.pending is None else [closer.pending])]
    measured = [loop.measurement.numpy() for loop in every]
    arrays = {"loops/measurements": np.array(measured, np.float64).reshape(-1, 8)}
    arrays |= {f"places/{name}": values for name, values in closer.finder.places.to_arrays().items()}
    if closer.pending is not None and closer.pending.edges is not None:
        edges = closer.pending.edges
        arrays |= {
            f"loops/{name}": getattr(edges, name) for name in ("source", "patch", "target", "position", "weight")
        }
    return arrays


def restore_loops(source: MapReader, closer: LoopCloser, segments: Collection[int]) -> None:
    """Restore the loop closure of a tracker whose graph has been read.

    Args:
        source: the file.
        closer: newly built.
        segments: those that are initialised.

    Raises:
        DvoError: a missing or invalid value or array.
    """
    table, archive = source.table(LoopsTable, "loops"), closer.graph.archive
    tables = [*table.loops, *([] if table.pending is None else [table.pending])]
    measured = source.array("loops/measurements", np.float64, (len(tables), 8), -_MOST, _MOST)
    positive = (measured[:, 7] > 1e-9).all() and (np.abs(np.linalg.norm(measured[:, 3:7], axis=1) - 1) < 1e-6).all()
    source.require(positive, "holds no similarities", "loops/measurements")
    loops = []
    for row, loop in zip(measured, tables, strict=True):
        known = all(k in archive and archive[k].anchor is None for k in (loop.old, loop.new))
        source.require(known and loop.old < loop.new, "between keyframes that are not there", "loops: loops")
        times = archive[loop.old].timestamp, archive[loop.new].timestamp
        measurement = torch.from_numpy(row.copy())
        loops.append(
            Loop(loop.old, loop.new, *times, loop.kind, loop.inliers, measurement, loop.count, None, loop.joins)
        )
    closer.corrections, closer.wait, closer.searches = table.corrections, table.wait, table.searches
    if table.pending is not None:
        closer.pending = _pending(source, loops.pop(), closer)
    closer.loops[:] = loops
    if not closer.enabled:
        return
    kept = (frame.identifier for frame in archive if frame.anchor is None)
    closer.finder.kept[:] = [k for k in kept if closer.graph.segment_of(k) in segments]
    _restore_places(source, closer)


def _pending(source: MapReader, loop: Loop, closer: LoopCloser) -> Loop:
    """Pending loop with its measurements, which are not archived yet."""
    n, most, archive = loop.count, closer.graph.window.per_frame - 1, closer.graph.archive
    ends = [source.array(f"loops/{name}", np.int32, (n,), 0) for name in ("source", "target")]
    source.require(all(int(k) in archive for k in np.unique(ends)), "keyframes that are not there", "loops/source")
    edges = ArchivedEdges(
        ends[0],
        source.array("loops/patch", np.int16, (n,), 0, most),
        ends[1],
        source.array("loops/position", np.float32, (n, 2)),
        source.array("loops/weight", np.float16, (n, 2), 0),
    )
    return Loop(
        loop.old,
        loop.new,
        loop.old_time,
        loop.new_time,
        loop.kind,
        loop.inliers,
        loop.measurement,
        n,
        edges,
        loop.joins,
    )


def _restore_places(source: MapReader, closer: LoopCloser) -> None:
    dimensions, capacity = closer.finder.places.dimensions, closer.finder.places.capacity
    arrays = {
        "identifiers": source.array("places/identifiers", np.int64, (None,), 0, _LAST),
        "descriptors": source.array("places/descriptors", np.float16, (None, dimensions), -1.01, 1.01),
        "capacity": np.array(capacity, np.int64),
    }
    kept = np.isin(arrays["identifiers"], closer.finder.kept).all()
    source.require(kept, "keyframes that are not there", "places/identifiers")
    try:
        closer.finder.places = PlaceIndex.from_arrays(arrays)
    except DvoError as error:
        raise source.refused(error.message, "places/descriptors") from error
