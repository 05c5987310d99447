"""Map of a tracker: archived keyframes, a log of all frames, and the segments and worlds that they belong to."""

from __future__ import annotations

from bisect import bisect_right
from copy import copy
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from dvo.ba.patch_problem import PatchProblem
from dvo.geometry import se3
from dvo.map.archive import Archive, ArchiveConfig, ArchivedKeyframe
from dvo.map.keyframe_log import KeyframeLog
from dvo.map.measurements import ArchivedEdges, depth_factors

MIN_NEARNESS = 0.05
"""Points whose inverse depth is below this fraction of their keyframe's median are left out of the map, because their
depth is uncertain."""


@dataclass(frozen=True)
class Recording:
    """Beginning of a recording.

    Attributes:
        frame: position of its first frame in the log.
        keyframe: identifier of its first keyframe; those from it on belong to it, or to later recordings.
        segment: number of its first segment.
    """

    frame: int = 0
    keyframe: int = 0
    segment: int = 0


class Map:
    """Archived keyframes, patches and measurements.

    Args:
        per_frame: patches of a keyframe.
        archive: memory bound and content of the archive.

    Attributes:
        archive: keyframes and edges.
        log: every frame that was read, relative to a keyframe.
        segment: number of the current segment, from 0; keyframes of two segments share no edge, world or scale, unless
            the segments have been joined.
        starts: first keyframe and number of each segment, by increasing keyframe; -1 for a rejected segment.
        worlds: number of the earliest segment with the same world, of segments that have been joined.
        loops: number of loops whose measurements are archived.
        metric: by world in metres, what its scale came from; other worlds are up to scale.
        recordings: beginnings of the sequences that were tracked in this map, of which there is mostly one.
    """

    def __init__(self, per_frame: int, archive: ArchiveConfig | None = None) -> None:
        self.per_frame = per_frame
        self.archive = Archive(archive)
        self.log = KeyframeLog()
        self.segment = 0
        self.starts: list[tuple[int, int]] = [(0, 0)]
        self.worlds: dict[int, int] = {}
        self.loops = 0
        self.metric: dict[int, str] = {}
        self.recordings = [Recording()]

    def copy(self) -> Self:
        """Map with the same content, by references, which changes on its own."""
        new = copy(self)
        new.archive, new.log = self.archive.copy(), self.log.copy()
        new.starts, new.worlds, new.metric = list(self.starts), dict(self.worlds), dict(self.metric)
        new.recordings = list(self.recordings)
        return new

    def archived(self) -> Map:
        """Map with the same archive, by references, and no log: for work beside tracking.

        Keyframes and measurements are never changed in place, only replaced: the copy takes next to no time, and may be
        corrected.
        """
        new = Map(self.per_frame)
        new.archive = self.archive.copy()
        new.segment, new.starts, new.worlds = self.segment, list(self.starts), dict(self.worlds)
        new.loops, new.metric, new.recordings = self.loops, dict(self.metric), list(self.recordings)
        return new

    @property
    def recording(self) -> Recording:
        """The last recording; keyframes before it are its map."""
        return self.recordings[-1]

    def segment_of(self, identifier: int) -> int:
        """Segment of a keyframe.

        Args:
            identifier: of the keyframe.

        Returns:
            Its number; -1 for a keyframe of a rejected segment.
        """
        return self.starts[bisect_right(self.starts, identifier, key=lambda entry: entry[0]) - 1][1]

    def world_of(self, segment: int) -> int:
        """World of a segment.

        Args:
            segment: its number.

        Returns:
            Number of the earliest segment whose world and scale it shares.
        """
        return self.worlds.get(segment, segment)

    def join(self, segment: int, other: int) -> None:
        """Record that the worlds of two segments have become one; their poses are in it already.

        Args:
            segment, other: numbers of the segments.
        """
        worlds = {self.world_of(segment), self.world_of(other)}
        for number in range(self.segment + 1):
            if self.world_of(number) in worlds:
                self.worlds[number] = min(worlds)

    def add_loop(self, edges: ArchivedEdges) -> None:
        """Archive the measurements of a loop.

        Args:
            edges: between archived keyframes.
        """
        self.loops += 1
        self.archive.add_edges(edges)

    def correct(self, identifier: int, pose_cw: np.ndarray, inverse_depth: np.ndarray | None = None) -> None:
        """Set the pose of an archived keyframe; its frames and points move along.

        Args:
            identifier: of a keyframe. A dropped one stays relative to the keyframe before it: correct that one first.
            pose_cw: ``(7,)`` float64 world to camera ``T_cw``.
            inverse_depth: ``(M,)`` of its patches; None leaves them unchanged.
        """
        pose_cw, anchor = np.asarray(pose_cw, np.float64), self.archive[identifier].anchor
        if anchor is None:
            self.archive.set_pose(identifier, pose_cw, inverse_depth)
            self.log.set_pose(identifier, pose_cw)
            return
        relative = se3.relative(self.poses_cw(np.array([anchor]))[0], torch.from_numpy(pose_cw)).numpy()
        self.archive.set_pose(identifier, relative, inverse_depth, anchor)
        self.log.reanchor(identifier, anchor, relative)

    def points(self, segment: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Map points of the archived keyframes of a segment, from the current poses of these.

        Args:
            segment: its number.

        Returns:
            ``(P, 3)`` float32 in the world, in the unit of the poses; ``(P, 3)`` uint8 RGB.
        """
        points, colors = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)]
        for keyframe in self.archive:
            if keyframe.anchor is not None or not len(keyframe.inverse_depth):
                continue
            if not self._shares_world(keyframe.identifier, segment):
                continue
            depth = torch.from_numpy(keyframe.inverse_depth)
            x, y = torch.from_numpy(keyframe.centres).unbind(-1)
            fx, fy, cx, cy = torch.from_numpy(keyframe.intrinsics)
            rays = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], dim=-1)
            pose = torch.from_numpy(keyframe.pose_cw).to(depth.dtype)
            world = se3.act(se3.inverse(pose), rays / depth[:, None])
            near = (depth > MIN_NEARNESS * depth.median()).numpy()
            points.append(world.numpy()[near])
            colors.append(keyframe.colors[near])
        return np.concatenate(points), np.concatenate(colors)

    def members(self, segment: int) -> list[ArchivedKeyframe]:
        """Archived keyframes of a segment that have patches, and a pose.

        Args:
            segment: its number.

        Returns:
            By increasing identifier, dropped ones included; those whose patches have been released are left out, and
            dropped ones that are relative to a keyframe of the window, also by way of others.
        """
        found: list[ArchivedKeyframe] = []
        placed: set[int] = set()
        for frame in self.archive:  # an anchor comes before those that are relative to it
            if frame.anchor is None or frame.anchor in placed:
                placed.add(frame.identifier)
                if self._shares_world(frame.identifier, segment) and len(frame.inverse_depth):
                    found.append(frame)
        return found

    def _shares_world(self, identifier: int, segment: int) -> bool:
        own = self.segment_of(identifier)
        return own >= 0 and self.world_of(own) == self.world_of(segment)

    def poses_cw(self, identifiers: np.ndarray) -> Tensor:
        """Poses of archived keyframes, dropped or not.

        Args:
            identifiers: ``(N,)``; the keyframes that dropped ones are relative to are archived as well.

        Returns:
            ``(N, 7)`` float64 world to camera.
        """
        frames = [self.archive[int(identifier)] for identifier in identifiers]
        if not frames:
            return torch.zeros(0, 7, dtype=torch.float64)
        poses = torch.from_numpy(np.stack([frame.pose_cw for frame in frames]))
        while any(frame.anchor is not None for frame in frames):
            moving = torch.tensor([frame.anchor is not None for frame in frames])
            frames = [frame if frame.anchor is None else self.archive[frame.anchor] for frame in frames]
            anchors = torch.from_numpy(np.stack([frame.pose_cw for frame in frames]))
            poses = torch.where(moving[:, None], se3.compose(poses, anchors), poses)
        return poses

    def problem(self, dropped: bool = True, segment: int = 0, first: int = 0, last: int | None = None) -> PatchProblem:
        """Bundle adjustment problem of the archived keyframes and edges of a segment.

        Args:
            dropped: include dropped keyframes.
            segment: its number.
            first, last: part of the segment from one identifier to another, with the earlier keyframes that share an
                edge with it. None: to the end.

        Returns:
            The problem of the :meth:`members`, on the CPU.
        """
        edges = self.archive.edges(first, last)
        linked = set(np.unique(np.concatenate([edges.source, edges.target])).tolist()) if first > 0 else set()
        frames = [
            frame
            for frame in self.members(segment)
            if (frame.identifier >= first or frame.identifier in linked)
            and (last is None or frame.identifier <= last)
            and (dropped or frame.anchor is None)
        ]
        identifiers = np.array([frame.identifier for frame in frames], dtype=np.int64)
        edges = edges.select(np.isin(edges.source, identifiers) & np.isin(edges.target, identifiers))
        ii, jj = np.searchsorted(identifiers, edges.source), np.searchsorted(identifiers, edges.target)
        m, patches = self.per_frame, [np.column_stack([frame.centres, frame.inverse_depth]) for frame in frames]
        return PatchProblem(
            poses_cw=self.poses_cw(identifiers),
            patches=torch.from_numpy(np.array(patches, dtype=np.float64)).reshape(len(frames) * m, 3, 1, 1),
            intrinsics=torch.from_numpy(np.array([f.intrinsics for f in frames], dtype=np.float64).reshape(-1, 4)),
            targets=torch.from_numpy(edges.position.astype(np.float64)),
            weights=torch.from_numpy(edges.weight.astype(np.float64)),
            ii=torch.from_numpy(ii),
            jj=torch.from_numpy(jj),
            kk=torch.from_numpy(ii * m + edges.patch),
            factors=depth_factors(_measured(frames, m)),
            identifiers=torch.from_numpy(identifiers),
        )


def _measured(frames: list[ArchivedKeyframe], per_frame: int) -> Tensor | None:
    """Measured inverse depths of all patches with their weights; None if there are none."""
    if all(frame.measured is None for frame in frames):
        return None
    none = np.zeros((per_frame, 2))
    return torch.from_numpy(np.concatenate([none if f.measured is None else f.measured for f in frames])).double()
