"""Loop closure in map files: loops, the search for them, work in progress, and descriptors of places."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch

from dvo.errors import DvoError
from dvo.graph.map_file import MapReader
from dvo.graph.measurements import ArchivedEdges
from dvo.graph.places import PlaceIndex
from dvo.odometry.adjuster_saving import AdjusterTable, adjuster_arrays, adjuster_table, restore_adjuster
from dvo.odometry.background import Steps, Task
from dvo.odometry.loop_closure import LoopCloser
from dvo.odometry.loop_correction import members
from dvo.odometry.loop_work import Correcting, Searching
from dvo.odometry.loops import Loop

_LAST = 2**31 - 1


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
        searching: steps of the search in progress until its result is taken; 0 if there is none.
        found: that result.
        correcting: frames until the correction in progress is made; 0 if there is none.
        adjuster: global adjustments; None if there are none.
    """

    loops: tuple[LoopTable, ...]
    pending: LoopTable | None
    corrections: int
    wait: int
    searches: int
    searching: int = 0
    found: LoopTable | None = None
    correcting: int = 0
    adjuster: AdjusterTable | None = None

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "corrections": (0, _LAST), "wait": (-_LAST, _LAST), "searches": (0, _LAST), "searching": (0, _LAST),
        "correcting": (0, _LAST),
    }  # fmt: skip


def _table(loop: Loop) -> LoopTable:
    return LoopTable(loop.old, loop.new, loop.kind, loop.inliers, loop.count, loop.joins)


def _found(closer: LoopCloser) -> Loop | None:
    """Result of the search in progress, waited for."""
    return closer.work.task.result() if isinstance(closer.work, Searching) else None


def loops_table(closer: LoopCloser) -> dict[str, Any]:
    """JSON-able values of a :class:`LoopsTable`; waits for the work in progress."""
    pending, found = (None if loop is None else _table(loop) for loop in (closer.pending, _found(closer)))
    work = closer.work
    searching = (work.task.left if isinstance(work.task, Steps) else 1) if isinstance(work, Searching) else 0
    correcting = max(work.left, 1) if isinstance(work, Correcting) else 0
    loops = tuple(map(_table, closer.loops))
    counts = closer.corrections, closer.wait, closer.searches
    table = LoopsTable(loops, pending, *counts, searching, found, correcting, adjuster_table(closer))
    return asdict(table)


def loops_arrays(closer: LoopCloser) -> dict[str, np.ndarray]:
    """Arrays of the loop closure by name; waits for the work in progress."""
    waiting = {"loops": closer.pending, "search": _found(closer)}
    every = [*closer.loops, *(loop for loop in waiting.values() if loop is not None)]
    measured = [loop.measurement.numpy() for loop in every]
    arrays = {"loops/measurements": np.array(measured, np.float64).reshape(-1, 8)}
    arrays |= {f"places/{name}": values for name, values in closer.finder.places.to_arrays().items()}
    for name, loop in waiting.items():
        if loop is not None and loop.edges is not None:
            columns = ("source", "patch", "target", "position", "weight")
            arrays |= {f"{name}/{column}": getattr(loop.edges, column) for column in columns}
    if isinstance(closer.work, Correcting):
        arrays["correction/keyframes"] = closer.work.identifiers
        arrays["correction/similarities"] = closer.work.task.result().numpy()
    return arrays | adjuster_arrays(closer)


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
    tables = [*table.loops, *(loop for loop in (table.pending, table.found) if loop is not None)]
    measured = source.similarities("loops/measurements", len(tables))
    loops = []
    for row, loop in zip(measured, tables, strict=True):
        ends = (loop.old, loop.new)
        known = all(k in archive and archive[k].anchor is None and closer.graph.segment_of(k) >= 0 for k in ends)
        source.require(known and loop.old < loop.new, "between keyframes that are not there", "loops: loops")
        times = archive[loop.old].timestamp, archive[loop.new].timestamp
        measurement = torch.from_numpy(row.copy())
        loops.append(
            Loop(loop.old, loop.new, *times, loop.kind, loop.inliers, measurement, loop.count, None, loop.joins)
        )
    closer.corrections, closer.wait, closer.searches = table.corrections, table.wait, table.searches
    source.require(not (table.searching and table.correcting), "searching and correcting at once", "loops: searching")
    source.require(table.found is None or table.searching > 0, "a result without a search", "loops: found")
    found = _with_edges(source, loops.pop(), closer, "search") if table.found is not None else None
    if table.pending is not None:
        closer.pending = _with_edges(source, loops.pop(), closer, "loops")
    closer.loops[:] = loops
    if table.searching:
        closer.work = Searching(Steps.finished(found, table.searching))
    if table.adjuster is not None:
        busy = table.searching or table.correcting
        source.require(not (busy and table.adjuster.left), "adjusting beside other work", "loops: adjuster")
        restore_adjuster(source, closer, table.adjuster)
    if not closer.enabled:
        return
    kept = (frame.identifier for frame in archive if frame.anchor is None)
    closer.finder.kept[:] = [k for k in kept if closer.graph.segment_of(k) in segments]
    _restore_places(source, closer)
    if table.correcting:
        closer.work = _correction(source, closer, table.correcting)


def _correction(source: MapReader, closer: LoopCloser, left: int) -> Correcting:
    """Correction in progress."""
    source.require(bool(closer.loops), "a correction without a loop", "loops: correcting")
    identifiers = source.array("correction/keyframes", np.int64, (None,), 0, _LAST)
    wanted = members(closer.graph, closer.finder.kept, closer.loops[-1])
    whole = len(identifiers) > 0 and np.array_equal(identifiers, wanted[: len(identifiers)])
    known = whole and {closer.loops[-1].old, closer.loops[-1].new} <= set(identifiers.tolist())
    source.require(known, "not the keyframes of the last loop", "correction/keyframes")
    similarities = source.similarities("correction/similarities", len(identifiers))
    return Correcting(Task.finished(torch.from_numpy(similarities.copy())), left, identifiers)


def _with_edges(source: MapReader, loop: Loop, closer: LoopCloser, group: str) -> Loop:
    """Loop with its measurements, which are not archived yet."""
    n, most, archive = loop.count, closer.graph.window.per_frame - 1, closer.graph.archive
    ends = [source.array(f"{group}/{name}", np.int32, (n,), 0) for name in ("source", "target")]
    source.require(all(int(k) in archive for k in np.unique(ends)), "keyframes that are not there", f"{group}/source")
    edges = ArchivedEdges(
        ends[0],
        source.array(f"{group}/patch", np.int16, (n,), 0, most),
        ends[1],
        source.array(f"{group}/position", np.float32, (n, 2)),
        source.array(f"{group}/weight", np.float16, (n, 2), 0),
    )
    return replace(loop, edges=edges)


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
