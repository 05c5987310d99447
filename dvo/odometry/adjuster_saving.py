"""Global adjustments in map files: those that were made, those that wait, and the one in progress."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from dvo.graph.map_file import MapReader
from dvo.odometry.adjuster import Adjusting
from dvo.odometry.background import Task
from dvo.odometry.graph_adjustment import Adjusted, AdjustmentRecord, Cause
from dvo.odometry.loop_closure import LoopCloser

_LAST, _LARGEST = 2**31 - 1, 1e300


@dataclass(frozen=True)
class AdjusterTable:
    """Plain values of :class:`dvo.odometry.adjuster.Adjuster` and of the adjustment in progress.

    Attributes:
        records: adjustments that were made.
        wanted: worlds that wait.
        left: frames until the result of the adjustment in progress is taken; 0 if there is none.
        world, cause, begun: see :class:`dvo.odometry.adjuster.Adjusting`.
        edges, cost_before, cost, seconds: of its result.
    """

    records: tuple[AdjustmentRecord, ...]
    wanted: tuple[int, ...]
    left: int = 0
    world: int = 0
    cause: Cause = "loop"
    begun: float = 0.0
    edges: int = 0
    cost_before: float = 0.0
    cost: float = 0.0
    seconds: float = 0.0

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        "left": (0, _LAST), "world": (0, _LAST), "edges": (0, _LAST), "cost_before": (0, _LARGEST),
        "cost": (0, _LARGEST), "seconds": (0, _LARGEST),
    }  # fmt: skip


def adjuster_table(closer: LoopCloser) -> AdjusterTable | None:
    """Values of a table; waits for the adjustment in progress. None if there has been no adjustment."""
    if closer.adjuster is None:
        return None
    records, wanted, work = tuple(closer.adjuster.records), tuple(closer.adjuster.wanted), closer.work
    if isinstance(work, Adjusting):
        found = work.task.result()
        result = found.edges, found.cost_before, found.cost, found.seconds
        return AdjusterTable(records, wanted, max(work.left, 1), work.world, work.cause, work.begun, *result)
    return AdjusterTable(records, wanted) if records or wanted else None


def adjuster_arrays(closer: LoopCloser) -> dict[str, np.ndarray]:
    """Arrays of the adjustment in progress by name; waits for it."""
    if not isinstance(closer.work, Adjusting):
        return {}
    found = closer.work.task.result()
    return {
        "adjustment/keyframes": found.identifiers,
        "adjustment/similarities": found.similarities.numpy(),
        "adjustment/inverse_depths": found.inverse_depths,
    }


def restore_adjuster(source: MapReader, closer: LoopCloser, table: AdjusterTable) -> None:
    """Restore the global adjustments of a tracker whose graph has been read.

    Args:
        source: the file.
        closer: newly built.
        table: of the file.

    Raises:
        DvoError: a missing or invalid value or array.
    """
    graph, adjuster = closer.graph, closer.adjuster
    assert adjuster is not None
    worlds = {graph.world_of(number) for _, number in graph.starts if number >= 0}
    source.require(set(table.wanted) <= worlds, "worlds that are not there", "loops: adjuster: wanted")
    adjuster.records[:], adjuster.wanted[:] = table.records, table.wanted
    if not table.left:
        return
    source.require(table.world in worlds, "a world that is not there", "loops: adjuster: world")
    identifiers = source.array("adjustment/keyframes", np.int64, (None,), 0, _LAST)
    members = [f.identifier for f in graph.archive if graph.segment_of(f.identifier) >= 0]
    members = [k for k in members if graph.world_of(graph.segment_of(k)) == table.world]
    known = np.isin(identifiers, members).all() and (np.diff(identifiers) > 0).all()
    own = known and (identifiers >= graph.recording.keyframe).all()
    source.require(own, "keyframes that are not those of the world", "adjustment/keyframes")
    similarities = source.similarities("adjustment/similarities", len(identifiers))
    shape = len(identifiers), graph.window.per_frame if len(identifiers) else None
    depths = source.array("adjustment/inverse_depths", np.float32, shape, 0, 1e6)
    result = table.edges, table.cost_before, table.cost, table.seconds
    found = Adjusted(identifiers, torch.from_numpy(similarities.copy()), depths, *result)
    closer.work = Adjusting(Task.finished(found), table.left, table.world, table.cause, table.begun)
