"""Global adjustments of a tracker: when they are done, and what is told about them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

from dvo.map.correction import Moved
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions
from dvo.odometry.global_ba.graph_adjustment import Adjusted, AdjustmentLimits, AdjustmentRecord, Cause, apply, prepare
from dvo.odometry.global_ba.rolling_shutter import Shutter
from dvo.odometry.maintenance.maintenance import Job, MapMaintenance


@dataclass
class Adjuster:
    """Global adjustments of a tracker.

    Args:
        graph: of the tracker; corrected in place.
        shutter: gives the timing of the rows of the last frame.
        options: of the final adjustment.
        after_loop: adjust a world after each correction by a loop.
        limits: of the work beside tracking.

    Attributes:
        records: adjustments of the recording, in the order of their application.
        wanted: worlds whose adjustment was requested, and waits for other work.
        ended: nothing is begun any more, as the final adjustment follows.
    """

    graph: KeyframeGraph
    shutter: Callable[[], Shutter]
    options: AdjustmentOptions
    after_loop: bool = False
    limits: AdjustmentLimits = AdjustmentLimits()
    records: list[AdjustmentRecord] = field(default_factory=list)
    wanted: list[int] = field(default_factory=list)
    ended: bool = False

    def job(
        self, maintenance: MapMaintenance, world: int, cause: Cause, delay: int, limits: AdjustmentLimits | None
    ) -> Job[Adjusted]:
        """Begin the adjustment of a world, from a snapshot.

        Args:
            maintenance: of the map.
            world: number of the world.
            cause: of the adjustment.
            delay: frames until the solution is taken.
            limits: bounds of the work; None for those of the final adjustment.
        """
        work = prepare(self.graph, world, self.shutter(), self.options, limits)
        apply = partial(self.take, world=world, cause=cause, begun=self._time())
        return maintenance.beside("adjustment", work.solve, apply, delay)

    def next_job(self, maintenance: MapMaintenance, corrected: int) -> Job[Adjusted] | None:
        """Begin the next adjustment beside tracking, if there is one.

        Args:
            maintenance: of the map.
            corrected: world that a loop has just corrected; -1 if none has.
        """
        if self.ended:
            return None
        if corrected >= 0 and self.after_loop:
            return self.job(maintenance, corrected, "loop", self.limits.delay, self.limits)
        if self.wanted:
            return self.job(maintenance, self.wanted.pop(0), "request", self.limits.delay, self.limits)
        return None

    def take(self, found: Adjusted, world: int, cause: Cause, begun: float) -> Moved:
        """Apply a solution, if it lowers the cost.

        Args:
            found: the solution.
            world: number of the world.
            cause: of the adjustment.
            begun: time of the frame that it was begun with, seconds.

        Returns:
            What has moved (:func:`dvo.odometry.global_ba.graph_adjustment.apply`).
        """
        if len(found.identifiers):
            self.records.append(found.record(begun, self._time(), cause))
        return apply(self.graph, world, found) if found.better else Moved({})

    def want(self, worlds: Iterable[int]) -> None:
        """Take up worlds that wait for their adjustment.

        Args:
            worlds: their numbers.
        """
        self.wanted += [world for world in worlds if world not in self.wanted]

    def end(self) -> None:
        """Begin nothing any more."""
        self.ended = True
        self.wanted.clear()

    def information(self) -> dict[str, Any]:
        """Adjustments for run.json; nothing if there are none and none are made after loops."""
        if not (self.records or self.after_loop):
            return {}
        return {"adjustments": [asdict(record) for record in self.records]}

    def _time(self) -> float:
        return self.graph.log.frames[-1].timestamp
