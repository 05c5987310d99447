"""Loop closure of a tracker: when to search, what a loop changes, and what is told about it.

A confirmed loop adds its measurements to the archive, where the final adjustment finds them, and corrects the poses of
all keyframes of its world by a pose graph in Sim(3) (Strasdat, Montiel and Davison, "Scale drift-aware large scale
monocular SLAM", 2010). A loop between two segments joins their worlds. Corrections happen at fixed frames: the same
frames give the same result, bit for bit on the CPU.

In a map (a graph with keyframes of earlier recordings) only keyframes of the last recording search. Those of the map
stay where they are; what joins their world is moved.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.ba.pose_graph import PoseGraphOptions, optimise_pose_graph
from dvo.geometry import sim3, so3
from dvo.graph.archive import ArchivedKeyframe
from dvo.graph.correction import apply_similarities, move_window, similarity_between
from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.graph.places import PlaceIndex
from dvo.models.patch_vo import PatchVO
from dvo.odometry.config import TrackerConfig
from dvo.odometry.loop_window import GroupMatcher
from dvo.odometry.loops import Loop, LoopFinder
from dvo.odometry.place_descriptors import shipped_descriptor

# Standard deviations of the edges of the pose graph: translation in median depths, rotation in rad, log scale.
_STEP = (0.01, 0.002, 0.01)
_LOOP = (0.01, 0.002, 0.01)
# A loop whose correction is smaller (in the same units) leaves the poses to the final adjustment.
_SMALL = (0.01, 0.003, 0.01)


def loop_closer(model: PatchVO, config: TrackerConfig, graph: KeyframeGraph, device: torch.device) -> LoopCloser:
    """Loop closure of a tracker.

    Args:
        model: the network. One with a fine level, whose features are not archived, finds no loops.
        config: of the tracker.
        graph: of the tracker.
        device: of the computation.
    """
    described = shipped_descriptor(model.config.feature_channels)
    places = PlaceIndex(1 if described is None else described.dimensions)
    finder = LoopFinder(graph, GroupMatcher(model, config, graph, device), places, described)
    return LoopCloser(graph, finder, config.loops and not model.config.fine_channels)


@dataclass
class LoopCloser:
    """Loop closure of a tracker.

    Args:
        graph: of the tracker; corrected in place.
        finder: of loops.
        enabled: search for loops; otherwise nothing is kept or found.

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
    loops: list[Loop] = field(default_factory=list)
    corrections: int = 0
    wait: int = 0
    pending: Loop | None = None
    searches: int = 0

    def see(self, identifier: int, image: np.ndarray, maps: Tensor) -> None:
        """Describe a new keyframe of the window; see :meth:`dvo.odometry.loops.LoopFinder.see`."""
        if self.enabled:
            self.finder.see(identifier, image, maps)

    def advance(self, segments: Collection[int]) -> bool:
        """Look at the keyframes that have been archived since the last call.

        Args:
            segments: those that are initialised. Keyframes of others wait until theirs is.

        Returns:
            True if poses were corrected.
        """
        corrected = False
        seen = self.finder.kept[-1] if self.enabled and self.finder.kept else -1
        for frame in self.graph.archive.kept_after(seen) if self.enabled else []:
            if self.graph.segment_of(frame.identifier) in segments:
                corrected |= self._visit(frame)
        return corrected

    def complete(self, segments: Collection[int], searches: int = 60) -> bool:
        """Search once more with the corrected poses, where no loop has been found so far; for the end of a sequence.

        Args:
            segments: those that were initialised.
            searches: number of keyframes that are looked at, at most.

        Returns:
            True if poses were corrected.
        """
        corrected = self.advance(segments)
        loops = self._own_loops()
        if not loops:
            return corrected
        options, kept = self.finder.options, self.finder.kept
        first = bisect_left(kept, self.graph.recording.keyframe)
        known = np.array([kept.index(loop.new) for loop in loops])
        rows = np.arange(first + options.neighbours, len(kept) - options.neighbours)
        rows = rows[np.abs(rows[:, None] - known).min(1) >= options.every][:: options.every]
        if len(rows) > searches:
            rows = rows[np.linspace(0, len(rows) - 1, searches).round().astype(int)]
        for row in rows.tolist():
            loop = self.finder.find(kept[row])
            if loop is not None and not self._needs_confirmation(loop):
                self._accept(loop)
        return corrected

    def information(self) -> dict[str, Any]:
        """Confirmed loops of the recording for run.json, in the order of time; nothing if they are not searched for.

        In a map also ``localised``: the loop by which the recording was recognised in it, None if it was not.
        """
        if not self.enabled:
            return {}
        loops, begun = self._own_loops(), self.graph.recording.keyframe
        entries: list[dict[str, Any]] = [
            {
                "from": loop.new_time, "to": loop.old_time, "kind": loop.kind, "inliers": round(loop.inliers, 3),
                "edges": loop.count, "joins_segments": loop.joins, **({"in_map": loop.old < begun} if begun else {}),
            }
            for loop in loops
        ]  # fmt: skip
        found = {"loops": sorted(entries, key=lambda loop: loop["from"]), "loop_corrections": self.corrections}
        return found | ({"localised": next((e for e in entries if e["in_map"]), None)} if begun else {})

    def _own_loops(self) -> list[Loop]:
        """Confirmed loops of the last recording."""
        return [loop for loop in self.loops if loop.new >= self.graph.recording.keyframe]

    def _visit(self, frame: ArchivedKeyframe) -> bool:
        """Take a kept keyframe into the list, and search for a loop if it is time to."""
        kept, options = self.finder.kept, self.finder.options
        self.finder.keep(frame.identifier)
        self.wait -= 1
        own = len(kept) > 2 * options.neighbours and kept[-1 - 2 * options.neighbours] >= self.graph.recording.keyframe
        if self.wait > 0 or not own:
            return False
        loop = self.finder.find(kept[-1 - options.neighbours])
        self.wait = options.every
        pending, self.searches = self.pending, self.searches + 1
        if loop is None:
            if pending is not None:
                self.wait = 2 if self.searches < options.patience else options.every
                self.pending = pending if self.searches < options.patience else None
            return False
        if self._needs_confirmation(loop):
            if pending is None or not self.finder.agree(pending, loop):
                self.pending, self.searches, self.wait = loop, 0, 2
                return False
            self._accept(pending)
        self._accept(loop)
        self.pending = None
        return self._correct(loop)

    def _needs_confirmation(self, loop: Loop) -> bool:
        """Return True unless the loop changes next to nothing, so that the present poses confirm it."""
        return loop.joins or not self._is_small(loop)

    def _is_small(self, loop: Loop) -> bool:
        old, new = sim3.from_se3(self.graph.poses_cw(np.array([loop.old, loop.new])))
        error = sim3.compose(loop.measurement, sim3.inverse(sim3.compose(new, sim3.inverse(old))))
        far = float(error[:3].norm()) * float(np.median(self.graph.archive[loop.new].inverse_depth))
        parts = far, float(so3.log(error[3:7]).norm()), abs(float(error[7].log()))
        return all(part <= limit for part, limit in zip(parts, _SMALL, strict=True))

    def _accept(self, loop: Loop) -> None:
        assert loop.edges is not None
        self.graph.add_loop(loop.edges)
        self.loops.append(replace(loop, edges=None))

    def _correct(self, loop: Loop) -> bool:
        """Correct all keyframes of the world of a loop, and the window with them."""
        graph = self.graph
        worlds = {graph.world_of(graph.segment_of(k)) for k in (loop.old, loop.new)}
        if len(worlds) == 1 and self._is_small(loop):
            return False
        kept = [k for k in self.finder.kept if graph.world_of(graph.segment_of(k)) in worlds]
        identifiers = np.array(kept)
        before = graph.poses_cw(identifiers)
        held = self._held(identifiers)
        found = self._solve(identifiers, self._start(identifiers, before, loop), held)
        here = [row for row, k in enumerate(kept) if graph.segment_of(k) == graph.segment]
        apply_similarities(graph, identifiers[~held], found[torch.from_numpy(~held)])
        if here:
            move_window(graph, before[here[-1]], found[here[-1]])
        self._rescale(identifiers, found)
        if len(worlds) > 1:
            graph.join(graph.segment_of(loop.new), graph.segment_of(loop.old))
        self.corrections += 1
        return True

    def _start(self, identifiers: np.ndarray, poses_cw: Tensor, loop: Loop) -> Tensor:
        """Similarities ``(N, 8)`` world to camera to start from; a joining segment is moved into the older world.

        In a map the later of the two worlds is moved, whichever keyframe is the older one.
        """
        start = sim3.from_se3(poses_cw)
        if not loop.joins:
            return start
        graph, worlds = self.graph, [self.graph.world_of(self.graph.segment_of(k)) for k in (loop.old, loop.new)]
        old, new = graph.poses_cw(np.array([loop.old, loop.new]))
        there = sim3.compose(loop.measurement, sim3.from_se3(old))  # older world to the newer camera, in its unit
        found_cw, scale = torch.cat([there[:3] / there[7], there[3:7]]), float(1 / there[7])
        change = sim3.inverse(similarity_between(new, found_cw, scale))
        newer = worlds[1]
        if graph.recording.keyframe and worlds[0] > worlds[1]:
            newer, change = worlds[0], sim3.inverse(change)
        moving = torch.tensor([graph.world_of(graph.segment_of(int(k))) == newer for k in identifiers])
        return torch.where(moving[:, None], sim3.compose(start, change), start)

    def _held(self, identifiers: np.ndarray) -> np.ndarray:
        """Mask ``(N,)`` of the keyframes of the map, in the world that stays; none without a map."""
        graph = self.graph
        worlds = np.array([graph.world_of(graph.segment_of(int(k))) for k in identifiers])
        return (identifiers < graph.recording.keyframe) & (worlds == worlds.min())

    def _solve(self, identifiers: np.ndarray, start: Tensor, held: np.ndarray) -> Tensor:
        """Solve the pose graph of consecutive keyframes and loops; ``held (N,)`` poses stay, else the first one."""
        graph, archive = self.graph, self.graph.archive
        segments = np.array([graph.segment_of(int(k)) for k in identifiers])
        depth = torch.tensor([1.0 / float(np.median(archive[int(k)].inverse_depth)) for k in identifiers]).double()
        ii = torch.from_numpy(np.flatnonzero(segments[1:] == segments[:-1]))
        jj = ii + 1
        steps = sim3.from_se3(graph.poses_cw(identifiers))
        measured = sim3.compose(steps[jj], sim3.inverse(steps[ii]))
        position = {int(k): row for row, k in enumerate(identifiers)}
        loops = [loop for loop in self.loops if loop.old in position and loop.new in position]
        old = torch.tensor([position[loop.old] for loop in loops])
        new = torch.tensor([position[loop.new] for loop in loops])
        deviation = torch.tensor([_STEP] * len(ii) + [_LOOP] * len(loops)).double()
        ends = torch.cat([jj, new])
        shape = deviation[:, [0, 0, 0, 1, 1, 1, 2]].clone()
        shape[:, :3] *= depth[ends, None]
        options = PoseGraphOptions(fixed=torch.from_numpy(held)) if held.any() else PoseGraphOptions()
        result = optimise_pose_graph(
            start, torch.cat([ii, old]), ends, torch.cat([measured, *(loop.measurement[None] for loop in loops)]),
            shape.square().reciprocal(), options,
        )  # fmt: skip
        return sim3.normalise(result.poses_cw)

    def _rescale(self, identifiers: np.ndarray, similarities: Tensor) -> None:
        """Express the loops in the new units of the keyframes."""
        unit = dict(zip(identifiers.tolist(), similarities[:, 7].tolist(), strict=True))
        for row, loop in enumerate(self.loops):
            old, new = unit.get(loop.old, 1.0), unit.get(loop.new, 1.0)
            t, q, scale = loop.measurement[:3] / new, loop.measurement[3:7], loop.measurement[7:] * old / new
            self.loops[row] = replace(loop, measurement=torch.cat([t, q, scale]))
