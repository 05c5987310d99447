"""Search for loops: keyframes that show a place again that an earlier keyframe has seen.

Candidates come from the present poses (proximity) and from the likeness of the images (retrieval). A candidate is
verified by the network (:mod:`dvo.odometry.loop_window`): in a joint window of both keyframes and their neighbours, a
share of the patches must be found where bundle adjustment reprojects them. A loop counts when a second one, close to it
in time, gives the same correction.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3, sim3, so3
from dvo.graph.archive import ArchivedEdges
from dvo.graph.keyframe_graph import KeyframeGraph
from dvo.graph.places import PlaceIndex
from dvo.odometry.loop_window import GroupMatcher, Match
from dvo.odometry.place_descriptors import PlaceDescriptor
from dvo.settings import Range, check_settings

_RECENT = 256  # descriptors beside the index above which those without a keyframe are dropped


@dataclass(frozen=True)
class LoopOptions:
    """Settings of :class:`LoopFinder`.

    Attributes:
        seconds: smallest time between the two visits of a place in a segment.
        every: kept keyframes between two searches.
        neighbours: keyframes before and after each of the two that are matched along.
        likeness: smallest similarity of the descriptors of a candidate by retrieval, in [-1, 1].
        retrieved: candidates by retrieval that are verified, at most.
        apart: identifiers of two such candidates differ by more than this.
        overlap: smallest share of the patches in view of a candidate by proximity.
        updates: updates of the network before a candidate is refused, and further ones of one that is not.
        inliers: smallest share of inliers of a loop.
        patience: searches after a loop within which a second one has to confirm it.
        translation, rotation, scale: largest differences of the corrections of two loops that confirm each other, in
            median depths, degrees, and as a ratio less one.

    Raises:
        DvoError: a value of another type or out of range.
    """

    RANGES: ClassVar[dict[str, Range]] = {
        "seconds": (0, 1e6), "every": (1, 10**4), "neighbours": (0, 8), "likeness": (-1, 1), "overlap": (0, 1),
        "retrieved": (0, 100), "apart": (0, 10**4),
        "inliers": (0, 1), "patience": (1, 100), "translation": (0, 1e3), "rotation": (0, 180), "scale": (0, 10),
    }  # fmt: skip

    seconds: float = 10.0
    every: int = 6
    neighbours: int = 1
    likeness: float = 0.3
    retrieved: int = 2
    apart: int = 20
    overlap: float = 0.5
    updates: tuple[int, int] = (4, 8)
    inliers: float = 0.4
    patience: int = 4
    translation: float = 0.2
    rotation: float = 3.0
    scale: float = 0.1

    def __post_init__(self) -> None:
        check_settings(self, self.RANGES)


@dataclass(frozen=True)
class Loop:
    """Two visits of a place.

    Attributes:
        old, new: identifiers of the earlier and the later keyframe.
        old_time, new_time: their timestamps, seconds.
        kind: source of the candidate, ``"proximity"`` or ``"retrieval"``.
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


@dataclass(frozen=True)
class _Candidate:
    """Pair of keyframes to verify, with the pose ``T_cw`` of the later one to start from."""

    old: int
    kind: str
    pose_cw: Tensor


@dataclass
class LoopFinder:
    """Search for loops among the archived keyframes of a graph.

    Args:
        graph: of the tracker.
        matcher: of two groups of keyframes.
        places: descriptors of the kept keyframes.
        descriptor: of images; None for a network without one, whose candidates come from the poses alone.
        options: thresholds.

    Attributes:
        kept: identifiers of the keyframes that were archived and not dropped, increasing.
    """

    graph: KeyframeGraph
    matcher: GroupMatcher
    places: PlaceIndex
    descriptor: PlaceDescriptor | None = None
    options: LoopOptions = LoopOptions()
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

    def keep(self, identifier: int) -> None:
        """Take a keyframe that was archived and not dropped into the list and the index.

        Args:
            identifier: of the keyframe, larger than those before.
        """
        self.kept.append(identifier)
        if identifier in self._recent:
            self.places.add(identifier, self._recent[identifier])
        self._recent = {other: row for other, row in self._recent.items() if other > identifier}

    def find(self, new: int) -> Loop | None:
        """Look for an earlier visit of the place of a keyframe.

        Args:
            new: identifier of a kept keyframe, whose neighbours are archived as well.

        Returns:
            The first candidate that is verified; None if there is none.
        """
        group = self._group(new)
        if group is None:
            return None
        for candidate in self._candidates(new):
            found = self._verify(candidate, new, group)
            if found is not None:
                return found
        return None

    def agree(self, first: Loop, second: Loop) -> bool:
        """Find out if two loops ask for the same correction.

        Args:
            first, second: loops, with the poses of the graph as they were when these were found.

        Returns:
            True if they do, within the options.
        """
        o, middle = self.options, self.graph.poses_cw(np.array([second.new]))[0]
        a, b = (self._moved(loop, middle) for loop in (first, second))
        difference = sim3.compose(a, sim3.inverse(b))
        scale = float(difference[7])
        angle = float(so3.log(difference[3:7]).norm().rad2deg())
        depth = 1.0 / float(np.median(self.graph.archive[second.new].inverse_depth))
        far = float(difference[:3].norm()) / depth
        return max(scale, 1 / scale) - 1 <= o.scale and angle <= o.rotation and far <= o.translation

    def _moved(self, loop: Loop, pose_cw: Tensor) -> Tensor:
        """Similarity ``(8,)`` from the world of the older visit to a camera of the newer one, as a loop has it."""
        old, new = self.graph.poses_cw(np.array([loop.old, loop.new]))
        there = sim3.compose(loop.measurement, sim3.from_se3(old))  # world of the older visit to the newer camera
        return sim3.compose(sim3.from_se3(se3.relative(new, pose_cw)), there)

    def _group(self, identifier: int) -> list[int] | None:
        """Keyframe with its neighbours in its segment; None if one of them cannot be matched."""
        at, count = bisect_left(self.kept, identifier), self.options.neighbours
        group = self.kept[max(0, at - count) : at + count + 1]
        segment = self.graph.segment_of(identifier)
        whole = len(group) == 2 * count + 1 and all(self.graph.segment_of(member) == segment for member in group)
        return group if whole and all(self.matcher.can_match(member) for member in group) else None

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

    def _candidates(self, new: int) -> Iterator[_Candidate]:
        """Candidates, the most likely first."""
        earlier, world = self._earlier(new), self.graph.world_of(self.graph.segment_of(new))
        if not len(earlier):
            return
        row, o = self.places.descriptor(new), self.options
        if row is not None and self.descriptor is not None:
            views = self.descriptor.views(row)
            found = self.places.query(views, o.retrieved, before=int(earlier[-1]) + 1, apart=o.apart)
            for old, score in zip(found.identifiers.tolist(), found.scores.tolist(), strict=True):
                if score >= o.likeness and self.graph.segment_of(old) >= 0:
                    yield _Candidate(old, "retrieval", self.graph.poses_cw(np.array([old]))[0])
        shared = np.array([self.graph.world_of(self.graph.segment_of(int(k))) == world for k in earlier])
        if shared.any():
            overlap = self._overlap(new, earlier[shared])
            if overlap.max() >= o.overlap:
                old = int(earlier[shared][overlap.argmax()])
                yield _Candidate(old, "proximity", self.graph.poses_cw(np.array([new]))[0])

    def _overlap(self, new: int, earlier: np.ndarray) -> np.ndarray:
        """Share ``(N,)`` of the patches of a keyframe that lie in the view of others at a similar depth."""
        frame = self.graph.archive[new]
        poses_cw = self.graph.poses_cw(np.append(earlier, new))
        fx, fy, cx, cy = torch.from_numpy(frame.intrinsics).double()
        cameras = np.stack([self.graph.archive[int(k)].intrinsics for k in earlier])  # a map may be of another camera
        fu, fv, cu, cv = torch.from_numpy(cameras).double().T[:, :, None]
        x, y = torch.from_numpy(frame.centres).double().unbind(-1)
        rays = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], -1)
        depth = 1.0 / torch.from_numpy(frame.inverse_depth).double().clamp(min=1e-6)
        world = se3.act(se3.inverse(poses_cw[-1]), rays * depth[:, None])
        seen = se3.act(poses_cw[:-1, None], world[None])
        z = seen[..., 2].clamp(min=1e-9)
        u, v = fu * seen[..., 0] / z + cu, fv * seen[..., 1] / z + cv
        inside = (u >= 0) & (u <= 2 * cu) & (v >= 0) & (v <= 2 * cv) & (seen[..., 2] > 0)
        alike = (z / depth > 0.5) & (z / depth < 2.0)
        return (inside & alike).double().mean(-1).numpy()

    def _verify(self, candidate: _Candidate, new: int, group: list[int]) -> Loop | None:
        old_group, options = self._group(candidate.old), self.options
        if old_group is None:
            return None
        poses_cw = self.graph.poses_cw(np.array([*old_group, *group]))
        at, count = group.index(new), len(old_group)
        moved = se3.relative(poses_cw[count + at].expand(len(group), 7), poses_cw[count:])
        start = torch.cat([poses_cw[:count], se3.compose(moved, candidate.pose_cw.expand(len(group), 7))])
        match = self.matcher.match(old_group, group, start, options.updates, options.inliers)
        return None if match is None else self._loop(candidate, new, match, old_group.index(candidate.old), count + at)

    def _loop(self, candidate: _Candidate, new: int, match: Match, old_at: int, new_at: int) -> Loop:
        relative = se3.relative(match.poses_cw[old_at], match.poses_cw[new_at])
        unit = 1.0 / match.scale  # of the newer segment, per unit of the older
        measurement = sim3.from_se3(torch.cat([relative[:3] * unit, relative[3:]]), unit)
        graph, old = self.graph, candidate.old
        worlds = {graph.world_of(graph.segment_of(k)) for k in (old, new)}
        times = graph.archive[old].timestamp, graph.archive[new].timestamp
        edges, joins = match.edges, len(worlds) > 1
        return Loop(old, new, *times, candidate.kind, match.inliers, measurement, len(edges), edges, joins)
