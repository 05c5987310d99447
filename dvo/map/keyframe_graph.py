"""Keyframe graph of a tracker: its map, and the active window in which the map grows.

A frame leaves the window in one of three ways: :meth:`KeyframeGraph.archive_oldest` for a keyframe that is kept,
:meth:`KeyframeGraph.drop` for a redundant one (its frames are then relative to the keyframe before it, and its
measurements are archived), and :meth:`KeyframeGraph.discard` for a frame of which nothing is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from dvo.core.allocator import release_free_memory
from dvo.geometry import se3
from dvo.map.archive import ArchiveConfig, ArchivedKeyframe, encode_jpeg, encode_mask
from dvo.map.map import Map
from dvo.map.measurements import ArchivedEdges
from dvo.map.window import Keyframe, Window

RELEASE_INTERVAL = 64
"""Frames that have left the window, after which free memory of the heap is released."""


class KeyframeGraph(Map):
    """Map with the window in which it grows: keyframes, patches and measurements of one sequence.

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
        located: archived keyframe that the segment was located by, whose world and scale it has; None for one that
            began a world of its own.

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
        super().__init__(per_frame, archive)
        self.window = Window.empty(per_frame, patch_size, hidden, device)
        self.finalise = finalise
        self.located: int | None = None

    def copy(self) -> Self:
        """Graph with the same content, by references, which changes on its own and archives edges as they are."""
        new = super().copy()
        new.window = replace(self.window, frames=[replace(frame) for frame in self.window.frames])
        new.finalise = None
        return new

    def archive_window(self) -> None:
        """Move all keyframes of the window to the archive."""
        while len(self.window):
            self.archive_oldest()

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

    def attach(
        self, identifier: int, timestamp: float, pose_cw: np.ndarray, kk: np.ndarray, targets: np.ndarray,
        weights: np.ndarray,
    ) -> None:  # fmt: skip
        """Archive a frame that was never in the window as one that was dropped after the newest keyframe.

        Its patches are those of that keyframe, without measurements.

        Args:
            identifier: of the frame, larger than that of any keyframe.
            timestamp: seconds.
            pose_cw: ``(7,)`` float64 world to camera.
            kk: ``(e,)`` patches of the window that were measured in it.
            targets, weights: ``(e, 2)`` positions in the frame, feature-map pixels, and their weights.
        """
        window, m, newest = self.window, self.window.per_frame, len(self.window) - 1
        anchor = window.frames[newest].identifier
        relative = se3.relative(window.poses_cw[newest].double().cpu(), torch.from_numpy(pose_cw)).numpy()
        self._archive_keyframe(newest, relative, anchor, identifier, timestamp)
        self.log.reanchor(identifier, anchor, relative)
        identifiers = np.array([frame.identifier for frame in window.frames], dtype=np.int32)
        target = np.full(len(kk), identifier, np.int32)
        self.archive.add_edges(
            ArchivedEdges(identifiers[kk // m], (kk % m).astype(np.int16), target, targets, weights.astype(np.float16))
        )

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

    def _archive_edges(self, mask: Tensor) -> None:
        """Archive the edges where ``mask (E,)`` is True, without those that have not been updated yet."""
        window, m = self.window, self.window.per_frame
        chosen = (mask & (window.weights > 0).any(-1)).nonzero()[:, 0]
        if not len(chosen):
            return
        if self.finalise is not None:
            self.finalise(chosen)
        identifiers = np.array([frame.identifier for frame in window.frames], dtype=np.int32)
        # Few copies: each waits for an accelerator.
        kk, jj = torch.stack((window.kk, window.jj))[:, chosen].cpu().numpy()
        targets, weights = torch.stack((window.targets, window.weights))[:, chosen].float().cpu()
        self.archive.add_edges(
            ArchivedEdges(
                source=identifiers[kk // m],
                patch=(kk % m).astype(np.int16),
                target=identifiers[jj],
                position=targets.numpy().copy(),  # without the weights beside it
                weight=weights.half().numpy(),
            )
        )

    def _archive_keyframe(
        self, position: int, pose_cw: np.ndarray, anchor: int | None, identifier: int | None = None,
        timestamp: float | None = None,
    ) -> None:  # fmt: skip
        """Archive a keyframe, perhaps as another one; a dropped one, with an ``anchor``, without features and image."""
        window, config = self.window, self.archive.config
        frame, m = window.frames[position], window.per_frame
        centre = window.patches.shape[-1] // 2
        patches = window.patches[position * m : (position + 1) * m, :, centre, centre].float().cpu().numpy()
        features = config.features and anchor is None
        image = frame.image if config.images and anchor is None else None
        self.archive.add(
            ArchivedKeyframe(
                identifier=frame.identifier if identifier is None else identifier,
                timestamp=frame.timestamp if timestamp is None else timestamp,
                intrinsics=frame.intrinsics.float().cpu().numpy(),
                pose_cw=pose_cw,
                anchor=anchor,
                centres=patches[:, :2].copy(),
                inverse_depth=patches[:, 2].copy(),
                colors=frame.colors.cpu().numpy(),
                matching=frame.matching.half().cpu().numpy() if features else None,
                context=frame.context.half().cpu().numpy() if features else None,
                jpeg=None if image is None else encode_jpeg(image, config.jpeg_quality),
                measured=None
                if frame.measured is None or identifier is not None
                else frame.measured.float().cpu().numpy(),
                mask=None if image is None or frame.mask is None else encode_mask(frame.mask),
            )
        )
        if len(self.archive) % RELEASE_INTERVAL == 0:
            release_free_memory()
