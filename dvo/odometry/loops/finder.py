"""Search for loops: keyframes that show a place again that an earlier keyframe has seen.

Candidates come from the present poses (proximity) and from the likeness of the images (retrieval). They are ordered by
the number of patches that agree on a pose (:mod:`dvo.odometry.loops.guess`), and the first few are verified by the
network (:mod:`dvo.odometry.loops.joint_window`), starting from that pose: in a joint window of both keyframes and their
neighbours, a share of the patches must be found where bundle adjustment reprojects them
(:mod:`dvo.odometry.loops.check`). A loop counts when a second one, close to it in time, gives the same correction.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3, sim3, so3
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.measurements import ArchivedEdges
from dvo.map.places import PlaceIndex
from dvo.odometry.loops.candidates import Candidate, by_likeness, by_proximity
from dvo.odometry.loops.check import Limits, is_loop, median_inverse_depth
from dvo.odometry.loops.guess import Pair, order_pairs
from dvo.odometry.loops.joint_window import Group, GroupMatcher, Match
from dvo.odometry.loops.options import LoopOptions
from dvo.odometry.loops.place_descriptors import PlaceDescriptor
from dvo.odometry.loops.wide_baseline import find_pose
from dvo.odometry.maintenance.background import all_steps

UPDATES = (2, 2, 8)
"""Updates of the network before a candidate with fewer than :data:`HOPEFUL` inliers is refused, further ones before one
with too few for a loop is, and further ones of a loop."""
HOPEFUL = 0.03
"""Share of inliers among all patches of both visits."""
BREAK = "break"
"""Kind of the candidate from before a break, see :class:`dvo.odometry.loops.candidates.Candidate`."""
AFTER_BREAK = 16
"""Kept keyframes after a break that are compared with the last one before it."""
_RECENT = 256  # descriptors beside the index above which those without a keyframe are dropped


@dataclass(frozen=True)
class Loop:
    """Two visits of a place.

    Attributes:
        old, new: identifiers of the earlier and the later keyframe.
        old_time, new_time: their timestamps, seconds.
        kind: source of the candidate, ``"proximity"``, ``"retrieval"`` or ``"break"``.
        inliers: share of the edges between the visits that are inliers.
        measurement: ``(8,)`` similarity from the camera of the earlier to that of the later keyframe, each in the unit
            that its segment had when the loop was found.
        count: number of measurements between the visits.
        edges: these measurements; none once they are archived.
        joins: the visits lay in segments with worlds of their own.
    """

    old: int
    new: int
    old_time: float
    new_time: float
    kind: str
    inliers: float
    measurement: Tensor
    count: int
    edges: ArchivedEdges | None
    joins: bool = False

    def in_units(self, unit: Mapping[int, float]) -> Loop:
        """Loop in new units of its keyframes.

        Args:
            unit: new ones in old ones, by keyframe; those that are not named keep theirs.
        """
        old, new = unit.get(self.old, 1.0), unit.get(self.new, 1.0)
        t, q, scale = self.measurement[:3] / new, self.measurement[3:7], self.measurement[7:] * old / new
        return replace(self, measurement=torch.cat([t, q, scale]))


@dataclass(frozen=True)
class Search:
    """Candidates of a keyframe, with all that their verification reads.

    Attributes:
        new: identifier of the keyframe.
        pairs: candidates.
        predicted: number of the first of them, whose poses follow from a loop that waits for its confirmation.
    """

    new: int
    pairs: tuple[Pair, ...]
    predicted: int = 0


@dataclass
class LoopFinder:
    """Search for loops among the archived keyframes of a graph.

    Args:
        graph: of the tracker.
        matcher: of two groups of keyframes.
        places: descriptors of the kept keyframes.
        descriptor: of images; None for a network without one, whose candidates come from the poses alone.
        options: when to search.
        limits: thresholds of the decision.
        pace: seconds between two kept keyframes above which the later one counts as several towards the next search.

    Attributes:
        kept: identifiers of the keyframes that were archived and not dropped, increasing.
    """

    graph: KeyframeGraph
    matcher: GroupMatcher
    places: PlaceIndex
    descriptor: PlaceDescriptor | None = None
    options: LoopOptions = LoopOptions()
    limits: Limits = Limits()
    pace: float = 0.5
    kept: list[int] = field(default_factory=list)
    _recent: dict[int, np.ndarray] = field(default_factory=dict)  # descriptors of keyframes that are not archived yet

    def see(self, identifier: int, image: np.ndarray, maps: Tensor) -> None:
        """Describe a new keyframe of the window.

        Args:
            identifier: of the keyframe.
            image: ``(H, W, 3)`` uint8 RGB working image.
            maps: ``(1, 1, C, h, w)`` matching features.
        """
        if self.descriptor is not None:
            self._recent[identifier] = self.descriptor(image, maps)
            if len(self._recent) > _RECENT:  # most belong to keyframes that were dropped
                archive, window = self.graph.archive, {frame.identifier for frame in self.graph.window.frames}
                waiting = {frame.identifier for frame in archive.kept_after(self.kept[-1] if self.kept else -1)}
                wanted = {identifier, *window, *waiting}
                self._recent = {k: row for k, row in self._recent.items() if k in wanted}

    def describe(self, identifier: int, descriptor: np.ndarray) -> None:
        """Take the descriptor of a keyframe of another map, until the keyframe is taken into the list.

        Args:
            identifier: of the keyframe.
            descriptor: unit vector.
        """
        self._recent[identifier] = descriptor

    def keep(self, identifier: int) -> int:
        """Take a keyframe that was archived and not dropped into the list and the index.

        Args:
            identifier: of the keyframe, larger than those before.

        Returns:
            Number of keyframes that it counts for towards the next search: more than one long after the one before it.
        """
        self.kept.append(identifier)
        if identifier in self._recent:
            self.places.add(identifier, self._recent[identifier])
        self._recent = {other: row for other, row in self._recent.items() if other > identifier}
        return int(np.diff(self.counted(self.kept[-2:]))[-1]) if len(self.kept) > 1 else 1

    def counted(self, kept: Sequence[int] | None = None) -> np.ndarray:
        """Place of keyframes in the count that decides when to search: a long time between two counts for several.

        Args:
            kept: identifiers; None for all that are kept.

        Returns:
            ``(N,)`` increasing numbers, the first 0.
        """
        archive = self.graph.archive
        times = np.array([archive[identifier].timestamp for identifier in (self.kept if kept is None else kept)])
        return np.concatenate([[0], np.maximum(1, (np.diff(times) / self.pace).astype(int)).cumsum()])

    def find(self, new: int, pending: Loop | None = None) -> Loop | None:
        """Look for an earlier visit of the place of a keyframe.

        Args:
            new: identifier of a kept keyframe, whose neighbours are archived as well.
            pending: loop that waits for its confirmation.

        Returns:
            The first candidate that is verified; None if there is none.
        """
        return all_steps(self.verify(self.prepare(new, pending)))

    def prepare(self, new: int, pending: Loop | None = None) -> Search:
        """Choose candidates, and gather what their verification needs.

        Args:
            new, pending: see :meth:`find`.

        Returns:
            The candidates, the most likely first, possibly none.
        """
        group, graph = self._group(new), self.graph
        if group is None:
            return Search(new, ())
        poses_cw, pairs, predicted = graph.poses_cw(np.array(group)), [], 0
        moved = se3.relative(poses_cw[group.index(new)].expand(len(group), 7), poses_cw)
        for candidate, known in self._candidates(new, pending):
            old = self._group(candidate.old)
            if old is None:
                continue
            joins = graph.world_of(graph.segment_of(candidate.old)) != graph.world_of(graph.segment_of(new))
            old_cw, present_cw = graph.poses_cw(np.array(old)), None if joins else poses_cw[group.index(new)]
            pairs.append(Pair(candidate, self._frames(old), self._frames(group), old_cw, moved, present_cw, joins))
            predicted += known
        return Search(new, tuple(pairs), predicted)

    def verify(self, search: Search) -> Generator[None, None, Loop | None]:
        """Match the candidates of a search until one is verified, in steps. Nothing of the graph is read or changed.

        Args:
            search: of :meth:`prepare`.

        Returns:
            The loop; None if no candidate is one.
        """
        least = min(self.limits.weak_inliers, self.limits.inliers)
        decisions = tuple(zip(UPDATES, (HOPEFUL, least, least), strict=True))
        ahead, others = search.pairs[: search.predicted], search.pairs[search.predicted :]
        try:
            across = [pair for pair in others if pair.candidate.kind == BREAK]
            for chosen in (_given(ahead), self._promising(others), self._from_corners(across)):
                for pair in (yield from chosen):
                    match = yield from self.matcher.match(pair.old, pair.new, pair.start, decisions)
                    if match is not None and is_loop(match, pair, self.limits):
                        match = replace(match, scale=match.scale * pair.scale)
                        return _loop(pair.candidate, pair.old, pair.new, match, pair.joins)
            return None
        finally:
            self.matcher.maps.clear()  # the next search is about other keyframes

    def _promising(self, pairs: Sequence[Pair]) -> Generator[None, None, Sequence[Pair]]:
        """Pairs to match, the most promising first, with the poses to start from."""
        if not pairs:
            return ()
        if not self.matcher.maps.has(pairs[0].later):
            yield
        maps = self.matcher.maps.maps(pairs[0].later)
        return () if maps is None else (yield from order_pairs(maps, pairs))

    def _from_corners(self, pairs: Sequence[Pair]) -> Generator[None, None, Sequence[Pair]]:
        """Pairs whose pose is found from corners, and is what the network has to agree with."""
        stride, found = int(self.matcher.model.config.STRIDE), []
        for pair in pairs:
            later = [one.identifier for one in pair.new].index(pair.candidate.new)
            wide = yield from find_pose(pair.old, pair.old_cw, pair.new, pair.moved, later, stride)
            if wide is not None:
                found.append(pair.placed(wide.pose_cw, wide.scale))
        return found

    def agree(self, first: Loop, second: Loop) -> bool:
        """Find out if two loops ask for the same correction.

        Args:
            first, second: loops, with the poses of the graph as they were when these were found.

        Returns:
            True if they do, within the limits; False if the patches of the keyframe were released meanwhile.
        """
        o, middle = self.limits, self.graph.poses_cw(np.array([second.new]))[0]
        a, b = (self._moved(loop, middle) for loop in (first, second))
        difference = sim3.compose(a, sim3.inverse(b))
        scale = float(difference[7])
        angle = float(so3.log(difference[3:7]).norm().rad2deg())
        depth = 1.0 / median_inverse_depth(self.graph.archive[second.new])
        far = float(difference[:3].norm()) / depth
        return max(scale, 1 / scale) - 1 <= o.scale and angle <= o.rotation and far <= o.translation

    def _moved(self, loop: Loop, pose_cw: Tensor) -> Tensor:
        """Similarity ``(8,)`` from the world of the older visit to a camera of the newer one, as a loop has it."""
        old, new = self.graph.poses_cw(np.array([loop.old, loop.new]))
        there = sim3.compose(loop.measurement, sim3.from_se3(old))  # world of the older visit to the newer camera
        return sim3.compose(sim3.from_se3(se3.relative(new, pose_cw)), there)

    def _group(self, identifier: int) -> list[int] | None:
        """Keyframe with its neighbours in its segment; None if there are too few, or one of them cannot be matched."""
        at, size = bisect_left(self.kept, identifier), 2 * self.options.neighbours + 1
        segment = self.graph.segment_of(identifier)
        near = range(max(0, at - size + 1), min(at + size, len(self.kept)))
        known = [row for row in near if self.graph.segment_of(self.kept[row]) == segment]
        if len(known) < size:
            return None
        first = min(max(at - self.options.neighbours, known[0]), known[-1] - size + 1)
        group = self.kept[first : first + size]
        return group if all(self.matcher.can_match(self.graph.archive[member]) for member in group) else None

    def _frames(self, group: list[int]) -> Group:
        return tuple(self.graph.archive[identifier] for identifier in group)

    def _earlier(self, new: int) -> np.ndarray:
        """Identifiers ``(N,)`` of the kept keyframes that may be an earlier visit of the place of a keyframe."""
        time, segment = self.graph.archive[new].timestamp, self.graph.segment_of(new)
        earlier = []
        for identifier in self.kept[: bisect_left(self.kept, new)]:
            other = self.graph.segment_of(identifier)
            if other == segment and time - self.graph.archive[identifier].timestamp < self.options.seconds:
                break
            if other >= 0:
                earlier.append(identifier)
        return np.array(earlier, dtype=np.int64)

    def _candidates(self, new: int, pending: Loop | None) -> Iterator[tuple[Candidate, bool]]:
        """Candidates, and whether the loop that waits for its confirmation predicts them; these come first."""
        earlier, graph, seconds = self._earlier(new), self.graph, self.options.seconds
        if not len(earlier):
            return
        worlds = np.array([graph.world_of(graph.segment_of(int(k))) for k in earlier])
        pose_cw = graph.poses_cw(np.array([new]))[0]
        if pending is not None:
            there = earlier[worlds == graph.world_of(graph.segment_of(pending.old))]
            for candidate in by_proximity(graph, new, self._moved(pending, pose_cw), there, seconds, 1):
                yield candidate, True
        here, seen = earlier[worlds == graph.world_of(graph.segment_of(new))], set()
        for candidate in by_proximity(graph, new, sim3.from_se3(pose_cw), here, seconds):
            seen.add(candidate.old)
            yield candidate, False
        for candidate in by_likeness(graph, self.places, self.descriptor, new, earlier):
            if candidate.old not in seen:
                yield candidate, False
        last = self._before_break(new)
        if last is not None:
            yield Candidate(last, new, BREAK, graph.poses_cw(np.array([last]))[0]), False

    def _before_break(self, new: int) -> int | None:
        """Last kept keyframe before the segment of a keyframe, if this is one of its first and has its own world."""
        graph, at, segment = self.graph, bisect_left(self.kept, new), self.graph.segment_of(new)
        near = range(max(0, at - AFTER_BREAK + 1), at + 1)
        first = next((k for k in near if graph.segment_of(self.kept[k]) == segment), 0)
        last = self.kept[first - 1] if first else -1
        if last < graph.recording.keyframe or graph.segment_of(last) < 0:
            return None
        return None if graph.world_of(graph.segment_of(last)) == graph.world_of(segment) else last


def _given(pairs: Sequence[Pair]) -> Generator[None, None, Sequence[Pair]]:
    """Pairs as they are, without a step."""
    yield from ()
    return pairs


def _loop(candidate: Candidate, old: Group, new: Group, match: Match, joins: bool) -> Loop:
    pair = [next(k for k, frame in enumerate(group) if frame.identifier == identifier)
            for group, identifier in ((old, candidate.old), (new, candidate.new))]  # fmt: skip
    relative = se3.relative(match.poses_cw[pair[0]], match.poses_cw[len(old) + pair[1]])
    unit = 1.0 / match.scale  # of the newer segment, per unit of the older
    measurement = sim3.from_se3(torch.cat([relative[:3] * unit, relative[3:]]), unit)
    times = old[pair[0]].timestamp, new[pair[1]].timestamp
    edges = match.edges
    return Loop(
        candidate.old, candidate.new, *times, candidate.kind, match.inliers, measurement, len(edges), edges, joins
    )
