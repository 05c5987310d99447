"""Keyframe graph of a tracker: active window, archive of the frames that have left it, and log of all frames.

A frame leaves the window in one of three ways: :meth:`KeyframeGraph.archive_oldest` for a keyframe that is kept,
:meth:`KeyframeGraph.drop` for a redundant one (its frames are then relative to the keyframe before it, and its
measurements are archived), and :meth:`KeyframeGraph.discard` for a frame of which nothing is kept.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from copy import copy
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from dvo.ba.patch_problem import PatchProblem
from dvo.geometry import se3
from dvo.map.archive import Archive, ArchiveConfig, ArchivedKeyframe, encode_jpeg
from dvo.map.heap import release_free_memory
from dvo.map.keyframe_log import KeyframeLog
from dvo.map.measurements import ArchivedEdges
from dvo.map.problem import archive_problem
from dvo.map.recording import Recording
from dvo.map.window import Keyframe, Window

NEAR = 0.05
"""Points whose inverse depth is below this fraction of their keyframe's median are left out of the map, because their
depth is uncertain."""
RELEASE_INTERVAL = 64
"""Frames that have left the window, after which free memory of the heap is released."""


class KeyframeGraph:
    """Keyframes, patches and measurements of one sequence.

    Args:
        per_frame: patches of a frame.
        patch_size: side of a patch.
        hidden: channels of the state of the update operator.
        device: of the window's tensors.
        archive: memory bound and content of the archive.
        finalise: called with the positions ``(e,)`` of edges of the window that are about to be archived; it may change
            their targets and weights in the window. None for nothing.

    Attributes:
        window: active keyframes and edges.
        archive: keyframes and edges that have left the window.
        log: every frame that was read, relative to a keyframe.
        segment: number of the current segment, from 0; keyframes of two segments share no edge, world or scale, unless
            the segments have been joined.
        starts: first keyframe and number of each segment, by increasing keyframe; -1 for a rejected segment.
        worlds: number of the earliest segment with the same world, of segments that have been joined.
        loops: number of loops whose measurements are archived.
        metric: by world in metres, what its scale came from; other worlds are up to scale.
        located: archived keyframe that the segment was located by, whose world and scale it has; None for one that
            began a world of its own.
        recordings: beginnings of the sequences that were tracked in this graph, of which there is mostly one.

    Example:
        Global bundle adjustment of everything that a tracker has archived:

        >>> odometry = dvo.load("small")
        >>> done = dvo.run(odometry, dvo.open("video.mp4", calib="calib.txt"))
        >>> p = odometry.graph.problem()
        >>> solved = dvo.ba.solve.solve(p, dvo.ba.sparse.global_adjust.GlobalBAOptions())
        >>> for identifier, pose_cw in zip(p.identifiers.tolist(), solved.poses_cw.numpy()):
        ...     odometry.graph.correct(identifier, pose_cw)
        >>> trajectory = odometry.graph.log.trajectory()
    """

    def __init__(
        self,
        per_frame: int,
        patch_size: int,
        hidden: int,
        device: torch.device,
        archive: ArchiveConfig | None = None,
        finalise: Callable[[Tensor], None] | None = None,
    ) -> None:
        self.window = Window.empty(per_frame, patch_size, hidden, device)
        self.archive, self.finalise = Archive(archive), finalise
        self.log = KeyframeLog()
        self.segment = 0
        self.starts: list[tuple[int, int]] = [(0, 0)]
        self.worlds: dict[int, int] = {}
        self.loops = 0
        self.metric: dict[int, str] = {}
        self.located: int | None = None
        self.recordings = [Recording()]

    def copy(self) -> KeyframeGraph:
        """Graph with the same content, by references, which changes on its own and archives edges as they are."""
        new = copy(self)
        new.window = replace(self.window, frames=[replace(frame) for frame in self.window.frames])
        new.archive, new.log, new.finalise = self.archive.copy(), self.log.copy(), None
        new.starts, new.worlds, new.metric = list(self.starts), dict(self.worlds), dict(self.metric)
        new.recordings = list(self.recordings)
        return new

    def archive_window(self) -> None:
        """Move all keyframes of the window to the archive."""
        while len(self.window):
            self.archive_oldest()

    @property
    def recording(self) -> Recording:
        """The last recording; keyframes before it are its map."""
        return self.recordings[-1]

    def begin_segment(self, first: int, keep: bool = True, reason: str = "") -> None:
        """Begin a segment. What is in the window belongs to the one before: it is archived with it, or discarded.

        Args:
            first: identifier of its first keyframe; those from it on belong to the new segment.
            keep: keep the segment before it; otherwise its frames are lost, and the new one takes its number.
            reason: cause of the loss, if it is not kept.
        """
        if keep:
            self.archive_window()
            self.segment += 1
            self.starts.append((first, self.segment))
        else:
            self.reject(first, reason)
        self.located = None

    def reject(self, first: int, reason: str) -> None:
        """Lose the frames of the segment before one of its keyframes, with which it begins anew.

        Args:
            first: identifier of the keyframe; those before it have no edge with the ones from it on.
            reason: cause of the loss.
        """
        while len(self.window) and self.window.frames[0].identifier < first:
            self.log.lose(self.discard(0).identifier, reason)
        for record in self.log.rows(self.segment, last=first - 1):
            record.lost, record.reason = True, record.reason or reason
        self.starts[-1] = (self.starts[-1][0], -1)
        self.starts.append((first, self.segment))

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

    def keep_edges(self, mask: Tensor) -> None:
        """Move edges from the window to the archive.

        Args:
            mask: ``(E,)`` bool, False for an edge to move.
        """
        self._archive_edges(~mask)
        self.window.keep(mask)

    def drop(self, position: int, still: bool = False) -> None:
        """Remove a redundant keyframe; its frames become relative to the keyframe before it.

        Args:
            position: of the keyframe in the window, at least 1.
            still: it takes the pose of the keyframe before it, in place of its own.
        """
        window = self.window
        pose = window.poses_cw[position - 1 if still else position]
        relative = se3.relative(window.poses_cw[position - 1], pose).double().cpu().numpy()
        anchor = window.frames[position - 1].identifier
        self._archive_edges(window.touching(position))
        self._archive_keyframe(position, relative, anchor)
        identifier = window.remove(position).identifier
        self.log.reanchor(identifier, anchor, self.archive[identifier].pose_cw)

    def archive_oldest(self) -> None:
        """Move the oldest keyframe of the window to the archive; if there are guests alone, the measurements of one."""
        window, oldest = self.window, self.window.guests
        if oldest == len(window):
            self.release(0)
            return
        pose_cw = window.poses_cw[oldest].double().cpu().numpy()
        self._archive_edges(window.touching(oldest))
        self._archive_keyframe(oldest, pose_cw, None)
        identifier = window.remove(oldest).identifier
        self.log.set_pose(identifier, self.archive[identifier].pose_cw)

    def release(self, position: int) -> None:
        """Remove a guest from the window, and archive its measurements.

        Args:
            position: of the guest in the window.
        """
        self._archive_edges(self.window.touching(position))
        self.window.remove(position)

    def discard(self, position: int) -> Keyframe:
        """Remove a frame from the window, and its measurements, without archiving them.

        Args:
            position: of the frame in the window.

        Returns:
            The removed keyframe.
        """
        return self.window.remove(position)

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
            near = (depth > NEAR * depth.median()).numpy()
            points.append(world.numpy()[near])
            colors.append(keyframe.colors[near])
        return np.concatenate(points), np.concatenate(colors)

    def members(self, segment: int) -> list[ArchivedKeyframe]:
        """Archived keyframes of a segment that have patches, and a pose.

        Args:
            segment: its number.

        Returns:
            By increasing identifier, dropped ones included; those whose patches have been released are left out, and
            dropped ones whose anchor is not archived.
        """
        return [
            frame
            for frame in self.archive
            if self._shares_world(frame.identifier, segment)
            and len(frame.inverse_depth)
            and (frame.anchor is None or frame.anchor in self.archive)
        ]

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
        members, m = self.members(segment), self.window.per_frame
        return archive_problem(self.archive, members, self.poses_cw, m, dropped, first, last)

    def _archive_edges(self, mask: Tensor) -> None:
        """Archive the edges where ``mask (E,)`` is True, without those that have not been updated yet."""
        window, m = self.window, self.window.per_frame
        chosen = mask & (window.weights > 0).any(-1)
        if not chosen.any():
            return
        if self.finalise is not None:
            self.finalise(chosen.nonzero()[:, 0])
        identifiers = np.array([frame.identifier for frame in window.frames], dtype=np.int32)
        kk, jj = window.kk[chosen].cpu().numpy(), window.jj[chosen].cpu().numpy()
        self.archive.add_edges(
            ArchivedEdges(
                source=identifiers[kk // m],
                patch=(kk % m).astype(np.int16),
                target=identifiers[jj],
                position=window.targets[chosen].float().cpu().numpy(),
                weight=window.weights[chosen].half().cpu().numpy(),
            )
        )

    def _archive_keyframe(self, position: int, pose_cw: np.ndarray, anchor: int | None) -> None:
        """Archive a keyframe; a dropped one, which has an ``anchor``, without features and image."""
        window, config = self.window, self.archive.config
        frame, m = window.frames[position], window.per_frame
        centre = window.patches.shape[-1] // 2
        patches = window.patches[position * m : (position + 1) * m, :, centre, centre].float().cpu().numpy()
        features = config.features and anchor is None
        image = frame.image if config.images and anchor is None else None
        self.archive.add(
            ArchivedKeyframe(
                identifier=frame.identifier,
                timestamp=frame.timestamp,
                intrinsics=frame.intrinsics.float().cpu().numpy(),
                pose_cw=pose_cw,
                anchor=anchor,
                centres=patches[:, :2].copy(),
                inverse_depth=patches[:, 2].copy(),
                colors=frame.colors.cpu().numpy(),
                matching=frame.matching.half().cpu().numpy() if features else None,
                context=frame.context.half().cpu().numpy() if features else None,
                jpeg=None if image is None else encode_jpeg(image, config.jpeg_quality),
                measured=None if frame.measured is None else frame.measured.float().cpu().numpy(),
            )
        )
        if len(self.archive) % RELEASE_INTERVAL == 0:
            release_free_memory()
