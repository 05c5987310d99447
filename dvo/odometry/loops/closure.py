"""Loop closure of a tracker: times of searches, confirmation of loops, corrections, and their entries in run.json.

A confirmed loop adds its measurements to the archive, where the final adjustment finds them, and corrects the poses of
all keyframes of its world by a pose graph in Sim(3) (Strasdat, Montiel and Davison, "Scale drift-aware large scale
monocular SLAM", 2010; :mod:`dvo.odometry.loops.correction`). A loop between two segments joins their worlds.

A search is done in steps, ``LoopOptions.steps`` with each frame, so that more frames take a little longer instead of
some much longer; if torch leaves a core free, the thread takes them ahead of the frames, and no frame takes longer.
Pose graphs are solved beside tracking, in a thread of their own; the result is taken at a fixed frame,
``LoopOptions.delay`` frames later, and waited for if it is not there: the same frames give the same result, bit for
bit on the CPU. In real time both are done in the thread and taken when they are there, and ``track`` never waits.

In a map (a graph with keyframes of earlier recordings) only keyframes of the last recording search. Those of the map
stay where they are; what joins their world is moved.

After a correction, if it is asked for, and on request, a global bundle adjustment follows in the same thread and in the
same way (:mod:`dvo.odometry.global_ba.graph_adjustment`).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from torch import Tensor

from dvo.geometry import sim3, so3
from dvo.map.archive import ArchivedKeyframe
from dvo.map.correction import Carried, Moved
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.odometry.frames.front_end import View
from dvo.odometry.global_ba.graph_adjustment import AdjustmentRecord
from dvo.odometry.loops import correction as loop_correction
from dvo.odometry.loops.check import median_inverse_depth
from dvo.odometry.loops.finder import Loop, LoopFinder
from dvo.odometry.loops.relocalisation import Located, locate
from dvo.odometry.maintenance.adjuster import Adjuster
from dvo.odometry.maintenance.maintenance import Job, MapMaintenance

CONFIRM_WITHIN = 4
"""Searches after a loop within which a second one has to confirm it."""
# A loop whose correction is smaller (in the same units) leaves the poses to the final adjustment.
_SMALL_CORRECTION = (0.01, 0.003, 0.01)


@dataclass
class LoopCloser:
    """Loop closure of a tracker.

    Args:
        graph: of the tracker; corrected in place.
        finder: of loops.
        enabled: search for loops; otherwise nothing is kept or found.
        maintenance: of the map: the job in progress, and when its result is taken.
        adjuster: of global adjustments; None for no adjustments.
        follow: is told how the newest poses of each world have moved.

    Attributes:
        loops: confirmed loops, in the order of their discovery.
        corrections: number of corrections of the poses.
        wait: kept keyframes until the next search.
        pending: loop that has not been confirmed yet.
        searches: since then.
    """

    graph: KeyframeGraph
    finder: LoopFinder
    enabled: bool = True
    maintenance: MapMaintenance = field(default_factory=MapMaintenance)
    adjuster: Adjuster | None = None
    follow: Callable[[Carried], None] | None = None
    loops: list[Loop] = field(default_factory=list)
    corrections: int = 0
    wait: int = 0
    pending: Loop | None = None
    searches: int = 0

    def see(self, identifier: int, image: np.ndarray, maps: Tensor) -> None:
        """Describe a new keyframe of the window; see :meth:`dvo.odometry.loops.finder.LoopFinder.see`."""
        if self.enabled:
            self.finder.see(identifier, image, maps)

    def locate(self, view: View, identifier: int) -> Located | None:
        """Find a frame among the archived keyframes; see :func:`dvo.odometry.loops.relocalisation.locate`.

        Args:
            view: the frame.
            identifier: of the keyframe that it becomes.
        """
        if not self.enabled or not self.finder.kept:
            return None
        if self.maintenance.waits:
            return None
        self.drain()
        return locate(self.finder, view, identifier)

    def relocalised(self, loop: Loop) -> None:
        """Take the measurements of a frame that was located, and begins a segment in the world of the earlier visit.

        Args:
            loop: of the frame.
        """
        self._accept(loop)
        self.pending = None

    def advance(self, segments: Collection[int], at_once: bool = False) -> bool:
        """Look at the keyframes that have been archived since the last call, once a frame at most.

        Args:
            segments: those that are initialised. Keyframes of others wait until theirs is.
            at_once: wait for the result of each search and correction.

        Returns:
            True if poses were corrected.
        """
        if not self.enabled:
            return self.drain() if at_once else self.maintenance.advance(self)
        corrected, at_once = False, at_once or not self.finder.options.delay
        seen = self.finder.kept[-1] if self.finder.kept else -1
        for frame in self.graph.archive.kept_after(seen):
            if self.graph.segment_of(frame.identifier) in segments:
                self._visit(frame)
                corrected |= at_once and self.drain()
        return self.drain() | corrected if at_once else self.maintenance.advance(self)

    def adjust(self, segments: Collection[int], wait: bool) -> list[AdjustmentRecord]:
        """Adjust the worlds of the recording: now, with the bounds of the final adjustment, or beside tracking.

        Args:
            segments: those that are initialised.
            wait: for the work in progress and the adjustments; otherwise these are begun one after the other.

        Returns:
            What was done; nothing yet if it is not waited for.
        """
        if self.adjuster is None:
            return []
        if wait:
            self.drain()
        own = (segment for segment in segments if segment >= self.graph.recording.segment)
        worlds, before = sorted({self.graph.world_of(segment) for segment in own}), len(self.adjuster.records)
        if not wait:
            self.adjuster.want(worlds)
            if self.maintenance.job is None:
                self.maintenance.job = self.adjuster.next_job(self.maintenance, -1)
            return []
        for world in worlds:
            self.maintenance.job = self.adjuster.job(self.maintenance, world, "request", 0, None)
            self.drain()
        return self.adjuster.records[before:]

    def drain(self) -> bool:
        """Wait for the work in progress, and what follows from it.

        Returns:
            True if poses were corrected.
        """
        return self.maintenance.drain(self)

    def complete(self, segments: Collection[int], searches: int = 100) -> bool:
        """Search once more, where no loop has been found so far; for the end of a sequence.

        First for places that segments with worlds of their own have in common, then with the corrected poses.

        Args:
            segments: those that were initialised.
            searches: number of keyframes that are looked at, at most.

        Returns:
            True if poses were corrected.
        """
        if self.adjuster is not None:
            self.adjuster.end()
        self.maintenance.awaited = False  # nothing else comes
        corrected = self.advance(segments, at_once=True)
        if not self.enabled:
            return corrected
        corrected |= self._join_worlds(searches)
        loops = self._own_loops()
        if not loops:
            return corrected
        options, kept, limits = self.finder.options, self.finder.kept, self.finder.limits
        # The poses, which confirmed loops have corrected, confirm another one as a second loop would.
        agreement = limits.translation, math.radians(limits.rotation), limits.scale
        first = bisect_left(kept, self.graph.recording.keyframe)
        known = np.array([kept.index(loop.new) for loop in loops])
        rows = np.arange(first + options.neighbours, len(kept) - options.neighbours)
        apart, counted = max(1, options.every // 2), self.finder.counted()
        rows = rows[np.abs(counted[rows][:, None] - counted[known]).min(1) >= apart]
        rows = rows[np.unique(counted[rows] // apart, return_index=True)[1]]  # one of each stretch of that length
        chosen = np.linspace(0, len(rows) - 1, min(searches, len(rows))).round().astype(int)
        for row in rows[chosen].tolist():
            loop = self.finder.find(kept[row])
            if loop is not None and not loop.joins and self.is_within(loop, agreement):
                self._accept(loop)
        return corrected

    def _join_worlds(self, searches: int) -> bool:
        """Look in each world of the recording for the places of earlier ones; True if some were joined."""
        graph, kept, margin = self.graph, self.finder.kept, self.finder.options.neighbours
        rows = range(bisect_left(kept, graph.recording.keyframe) + margin, len(kept) - margin)
        corrected = False
        for row in (rows[k] for k in range(0, len(rows), max(1, -(-len(rows) // searches)))):
            worlds = {graph.world_of(graph.segment_of(k)) for k in kept[: row + 1] if graph.segment_of(k) >= 0}
            loop = self.finder.find(kept[row], self.pending) if len(worlds) > 1 else None
            if loop is not None and loop.joins:
                self._found(loop)
                corrected |= self.drain()
        return corrected

    def information(self) -> dict[str, Any]:
        """Confirmed loops of the recording for run.json, in the order of time; nothing if they are not searched for.

        In a map also ``localised``: the loop by which the recording was recognised in it, None if it was not.
        """
        adjusted = {} if self.adjuster is None else self.adjuster.information()
        if not self.enabled:
            return adjusted
        loops, begun = self._own_loops(), self.graph.recording.keyframe
        entries: list[dict[str, Any]] = [
            {
                "from": loop.new_time, "to": loop.old_time, "kind": loop.kind, "inliers": round(loop.inliers, 3),
                "edges": loop.count, "joins_segments": loop.joins, **({"in_map": loop.old < begun} if begun else {}),
            }
            for loop in loops
        ]  # fmt: skip
        found = {"loops": sorted(entries, key=lambda loop: loop["from"]), "loop_corrections": self.corrections}
        return found | adjusted | ({"localised": next((e for e in entries if e["in_map"]), None)} if begun else {})

    def _own_loops(self) -> list[Loop]:
        """Confirmed loops of the last recording."""
        return [loop for loop in self.loops if loop.new >= self.graph.recording.keyframe]

    def _visit(self, frame: ArchivedKeyframe) -> None:
        """Take a kept keyframe into the list, and begin to search for a loop if it is time to."""
        self.wait -= self.finder.keep(frame.identifier)
        if self.maintenance.job is None:
            self.maintenance.job = self._search()

    def _search(self) -> Job[Loop | None] | None:
        """Search for a loop if it is time to."""
        if self.maintenance.awaited:
            return None
        kept, options = self.finder.kept, self.finder.options
        own = len(kept) > 2 * options.neighbours and kept[-1 - 2 * options.neighbours] >= self.graph.recording.keyframe
        if self.wait > 0 or not own:
            return None
        search = self.finder.prepare(kept[-1 - options.neighbours], self.pending)
        self.wait = options.every
        # In a segment that was located, tracking reads feature maps of the finder meanwhile.
        ahead = self.graph.located is None
        return self.maintenance.in_steps("search", self.finder.verify(search), self._searched, ahead)

    def next_job(self, ended: Job[Any], at_once: bool) -> Job[Any] | None:
        """Next job: a global adjustment, of a world that was corrected or is wanted, or a search after another one.

        Args:
            ended: the job before it.
            at_once: jobs are waited for.
        """
        graph = self.graph
        corrected = graph.world_of(graph.segment_of(self.loops[-1].new)) if ended.kind == "correction" else -1
        job = None if self.adjuster is None else self.adjuster.next_job(self.maintenance, corrected)
        if job is None and ended.kind == "search" and not at_once:
            return self._search()  # keyframes may have been kept while the search took its time
        return job

    def _searched(self, loop: Loop | None) -> Moved:
        """Take the outcome of a search, which moves nothing by itself."""
        self._found(loop)
        return Moved({})

    def _found(self, loop: Loop | None) -> None:
        """Take the outcome of a search."""
        options, pending, self.searches = self.finder.options, self.pending, self.searches + 1
        soon = 2 - (options.every - self.wait)  # keyframes from the beginning of the search on
        if loop is None:
            if pending is not None:
                self.wait, self.pending = (soon, pending) if self.searches < CONFIRM_WITHIN else (options.every, None)
            return
        if self._needs_confirmation(loop):
            if pending is None or not self.finder.agree(pending, loop):
                self.pending, self.searches, self.wait = loop, 0, soon
                return
            self._accept(pending)
        self._accept(loop)
        self.pending = None
        self.correct(loop)

    def _needs_confirmation(self, loop: Loop) -> bool:
        """Return True unless the loop changes next to nothing, so that the present poses confirm it."""
        return loop.joins or not self.is_within(loop, _SMALL_CORRECTION)

    def is_within(self, loop: Loop, limits: tuple[float, float, float]) -> bool:
        """Find out if a loop agrees with the poses.

        Args:
            loop: in the present units of its keyframes.
            limits: largest difference: translation in median depths, rotation in rad, log scale.

        Returns:
            True if it does; False if the patches of its newer keyframe were released meanwhile: nan is within no limit.
        """
        old, new = sim3.from_se3(self.graph.poses_cw(np.array([loop.old, loop.new])))
        error = sim3.compose(loop.measurement, sim3.inverse(sim3.compose(new, sim3.inverse(old))))
        far = float(error[:3].norm()) * median_inverse_depth(self.graph.archive[loop.new])
        parts = far, float(so3.log(error[3:7]).norm()), abs(float(error[7].log()))
        return all(part <= limit for part, limit in zip(parts, limits, strict=True))

    def _accept(self, loop: Loop) -> None:
        assert loop.edges is not None
        self.graph.add_loop(loop.edges)
        self.loops.append(replace(loop, edges=None))

    def correct(self, loop: Loop) -> None:
        """Begin to correct all keyframes of the worlds of a loop, unless it changes next to nothing.

        Args:
            loop: the last of :attr:`loops`.
        """
        if not loop.joins and self.is_within(loop, _SMALL_CORRECTION):
            return
        work = partial(loop_correction.solve, self.graph.archived(), list(self.finder.kept), list(self.loops), loop)
        delay = self.finder.options.delay
        self.maintenance.job = self.maintenance.beside("correction", work, self._apply, delay)

    def _apply(self, solved: tuple[np.ndarray, Tensor]) -> Moved:
        """Correct the poses."""
        identifiers, found = solved
        # At the end of a sequence keyframes of these worlds are archived that have not been looked at yet.
        later = self.graph.archive.kept_after(self.finder.kept[-1])
        kept = [*self.finder.kept, *(frame.identifier for frame in later)]
        self.corrections += 1
        return loop_correction.apply(self.graph, kept, self.loops[-1], identifiers, found)

    def moved(self, moved: Moved) -> None:
        """Express the loops in new units of keyframes, and tell who follows the newest poses.

        Args:
            moved: what has moved; keyframes that are not named keep their unit.
        """
        self.loops[:] = [loop.in_units(moved.units) for loop in self.loops]
        self.pending = None if self.pending is None else self.pending.in_units(moved.units)
        if self.follow is not None:
            for carried in moved.worlds:
                self.follow(carried)
