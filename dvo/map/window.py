"""Sliding window of a tracker: keyframes, their patches, and the edges between them.

Frames are numbered in three ways:

- the *position* of a keyframe in the window, used by ``ii``, ``jj`` and ``kk``, which changes when a frame leaves
  (:meth:`Window.remove` renumbers);
- its *identifier*, a running number that is never reused, used by the archive and the log;
- its *map slot*, the index of its feature maps in the correlation caches, reused after it has left.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from dvo.ba.patch_problem import PatchProblem
from dvo.map.edges import PatchGraph, build_graph


@dataclass
class Keyframe:
    """Keyframe of the window.

    Attributes:
        identifier: running number, never reused.
        timestamp: seconds.
        map_slot: index of its feature maps in the correlation caches.
        matching: ``(M, C, p, p)`` matching features of its patches.
        context: ``(M, D)`` context features of its patches.
        colors: ``(M, 3)`` uint8 RGB at the patch centres.
        intrinsics: ``(4,)`` fx fy cx cy of the feature map.
        image: ``(H, W, 3)`` uint8 RGB working image, None if it is not kept.
        visible: ``(h, w)`` bool, pixels of its feature map that measurements may lie in, None for all.
        measured: ``(M, 2)`` inverse depths (1/m) of its patches by a depth camera, and their weights in bundle
            adjustment, both 0 for a patch without one; None if no depth camera is used.
        slopes: ``(M, 2)`` derivatives of the inverse depth by x and y, over the inverse depth, of the surfaces of its
            patches, 1 / feature-map pixel; 0 where the surface is not known; None: that of no patch is.
        prior: ``(M, 2)`` inverse depths of its patches in the unit of the window, known from elsewhere, and their
            weights in bundle adjustment, 0 for none; None: of no patch.
        mask: ``(H, W)`` bool, pixels of the image that are used; None for all.
        states: ``(D,)`` values of further unknowns of the frame, by name, such as a velocity.
        guest: it is archived already, and takes part because the window was located by it: its pose is held, and of
            what leaves the window only its measurements are archived. Guests are the first keyframes of a window.
    """

    identifier: int
    timestamp: float
    map_slot: int
    matching: Tensor
    context: Tensor
    colors: Tensor
    intrinsics: Tensor
    image: np.ndarray | None = None
    visible: Tensor | None = None
    measured: Tensor | None = None
    slopes: Tensor | None = None
    prior: Tensor | None = None
    mask: np.ndarray | None = None
    guest: bool = False
    states: dict[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class WindowSnapshot:
    """What a step changes in a window, for :meth:`Window.restore`; shapes as in :class:`Window`."""

    poses_cw: Tensor
    patches: Tensor
    hidden: Tensor
    targets: Tensor
    weights: Tensor
    confidence: Tensor
    states: tuple[dict[str, Tensor], ...]


@dataclass
class Window:
    """Keyframes and edges of a sliding window.

    Attributes:
        per_frame: patches of a frame ``M``; patch ``k`` belongs to the frame at position ``k // M``.
        poses_cw: ``(n, 7)`` world to camera ``T_cw``.
        patches: ``(n * M, 3, p, p)`` x, y (feature-map pixels) and inverse depth.
        hidden: ``(E, D)`` state of the update operator.
        targets: ``(E, 2)`` positions of the patch centres measured by the last update, feature-map pixels.
        weights: ``(E, 2)`` of the targets in bundle adjustment; 0 for an edge before its first update.
        confidence: ``(E, 2)`` of the network in its measurements, in (0, 1); 0 before the first update.
        jj, kk: ``(E,)`` target frame and patch of each edge.
        frames: the keyframes, oldest first.
        unfixed: ``(h, w)`` bool, pixels of the feature maps that are not fixed to the images; None: all. It counts for
            all frames but guests, beside their own masks.
    """

    per_frame: int
    poses_cw: Tensor
    patches: Tensor
    hidden: Tensor
    targets: Tensor
    weights: Tensor
    confidence: Tensor
    jj: Tensor
    kk: Tensor
    frames: list[Keyframe] = field(default_factory=list)
    unfixed: Tensor | None = None
    _edges: PatchGraph | None = None

    @classmethod
    def empty(cls, per_frame: int, patch_size: int, hidden: int, device: torch.device) -> Window:
        """Window without frames.

        Args:
            per_frame: patches of a frame.
            patch_size: side of a patch.
            hidden: channels of the state of the update operator.
            device: of all tensors.

        Returns:
            The window.
        """

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(*shape, device=device)

        index = torch.zeros(0, dtype=torch.long, device=device)
        patches, edges = zeros(0, 3, patch_size, patch_size), zeros(0, 2)
        return cls(per_frame, zeros(0, 7), patches, zeros(0, hidden), edges, edges, edges, index, index)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def guests(self) -> int:
        """Number of archived keyframes that the window was located by, its first ones."""
        return sum(frame.guest for frame in self.frames)

    def fixed(self, optimised: int) -> int:
        """Number of leading poses that bundle adjustment holds: guests, all but the newest, and one at least.

        Args:
            optimised: number of newest frames whose poses move, at most.
        """
        return max(1, self.guests, len(self) - optimised)

    @property
    def ii(self) -> Tensor:
        """``(E,)`` source frame of each edge."""
        return self.kk // self.per_frame

    @property
    def intrinsics(self) -> Tensor:
        """``(n, 4)`` fx fy cx cy of the feature maps."""
        return torch.stack([frame.intrinsics for frame in self.frames])

    @property
    def visible(self) -> Tensor | None:
        """``(n, h, w)`` bool, pixels of the feature maps that measurements may lie in; None: all of all frames."""
        masks = [frame.visible for frame in self.frames]
        if self.unfixed is not None:
            masks = [
                mask if frame.guest else self.unfixed if mask is None else mask & self.unfixed
                for mask, frame in zip(masks, self.frames, strict=True)
            ]
        known = next((mask for mask in masks if mask is not None), None)
        if known is None:
            return None
        every = torch.ones_like(known)
        return torch.stack([every if mask is None else mask for mask in masks])

    @property
    def context(self) -> Tensor:
        """``(n * M, D)`` context features of the patches."""
        return torch.cat([frame.context for frame in self.frames])

    @property
    def measured(self) -> Tensor | None:
        """``(n * M, 2)`` measured inverse depths and weights, see :class:`Keyframe`; None if no frame has any."""
        return self._of_patches([frame.measured for frame in self.frames])

    def problem(self) -> PatchProblem:
        """Bundle adjustment problem of the window, its measurements with their weights.

        Returns:
            The problem, which shares tensors with the window; measured depths are not part of it.
        """
        given = self.poses_cw, self.patches, self.intrinsics, self.targets, self.weights
        return PatchProblem(*given, self.ii, self.jj, self.kk)

    @property
    def slopes(self) -> Tensor | None:
        """``(n * M, 2)`` slopes of the surfaces of the patches, see :class:`Keyframe`; None if no frame has any."""
        return self._of_patches([frame.slopes for frame in self.frames])

    @property
    def prior(self) -> Tensor | None:
        """``(n * M, 2)`` inverse depths known from elsewhere and weights, see :class:`Keyframe`; None without any."""
        return self._of_patches([frame.prior for frame in self.frames])

    def _of_patches(self, values: list[Tensor | None]) -> Tensor | None:
        """Values ``(M, 2)`` of each frame one after the other, with 0 for a frame without; None if no frame has any."""
        if all(value is None for value in values):
            return None
        none = self.poses_cw.new_zeros(self.per_frame, 2)
        return torch.cat([none if value is None else value for value in values])

    @property
    def map_slots(self) -> Tensor:
        """``(n,)`` map slot of each frame."""
        return torch.tensor([frame.map_slot for frame in self.frames], device=self.jj.device)

    @property
    def edges(self) -> PatchGraph:
        """Edges with their neighbourhoods; built on first access after a change."""
        if self._edges is None:
            self._edges = build_graph(self.ii, self.jj, self.kk, len(self))
        return self._edges

    def free_map_slot(self) -> int:
        """Find a map slot for a new frame.

        Returns:
            The lowest map slot that no frame of the window has.
        """
        used = {frame.map_slot for frame in self.frames}
        return next(slot for slot in range(len(used) + 1) if slot not in used)

    def append(self, frame: Keyframe, pose_cw: Tensor, patches: Tensor) -> None:
        """Add the newest keyframe.

        Args:
            frame: the keyframe with its features.
            pose_cw: ``(7,)`` world to camera.
            patches: ``(M, 3, p, p)`` x, y (feature-map pixels) and inverse depth.
        """
        self.frames.append(frame)
        self.poses_cw = torch.cat([self.poses_cw, pose_cw[None]])
        self.patches = torch.cat([self.patches, patches])

    def insert(self, position: int, frame: Keyframe, pose_cw: Tensor, patches: Tensor) -> None:
        """Add a keyframe before others; the positions of those increase by one, and :meth:`remove` undoes it.

        Args:
            position: of the new keyframe in the window.
            frame, pose_cw, patches: see :meth:`append`.
        """
        self._edges, first = None, position * self.per_frame
        self.kk = self.kk + self.per_frame * (self.kk >= first)
        self.jj = self.jj + (self.jj >= position).long()
        self.poses_cw = torch.cat([self.poses_cw[:position], pose_cw[None], self.poses_cw[position:]])
        self.patches = torch.cat([self.patches[:first], patches, self.patches[first:]])
        self.frames.insert(position, frame)

    def connect(self, kk: Tensor, jj: Tensor) -> None:
        """Add edges, with zero state and confidence.

        Args:
            kk, jj: ``(e,)`` patch and target frame of each new edge.
        """
        self._edges = None
        count = len(kk)
        self.kk, self.jj = torch.cat([self.kk, kk]), torch.cat([self.jj, jj])
        self.hidden = torch.cat([self.hidden, self.hidden.new_zeros(count, self.hidden.shape[1])])
        self.targets = torch.cat([self.targets, self.targets.new_zeros(count, 2)])
        self.weights = torch.cat([self.weights, self.weights.new_zeros(count, 2)])
        self.confidence = torch.cat([self.confidence, self.confidence.new_zeros(count, 2)])

    def connect_frame(self, position: int, distances: Collection[int], own: bool) -> None:
        """Add edges from the patches of frames around a frame to it, and from its patches to them.

        Args:
            position: of the frame in the window; it has no edges yet.
            distances: of the frames on either side of it that take part, in frames; guests do in any case.
            own: also from its patches to itself.
        """
        m, device, count = self.per_frame, self.jj.device, self.guests
        near = [k for k in range(len(self)) if k < count or k == position or abs(k - position) in distances]
        others = torch.tensor([k for k in near if k != position], dtype=torch.long, device=device)
        old = (others[:, None] * m + torch.arange(m, device=device)).flatten()
        self.connect(old, torch.full_like(old, position))
        new = torch.arange(position * m, (position + 1) * m, device=device)
        targets = torch.tensor(near, dtype=torch.long, device=device) if own else others
        self.connect(new.repeat_interleave(len(targets)), targets.repeat(m))

    def keep(self, mask: Tensor) -> None:
        """Remove edges.

        Args:
            mask: ``(E,)`` bool, False for an edge to remove.
        """
        self._edges = None
        kept = mask.nonzero()[:, 0]  # once: an accelerator is waited for until their number is known
        for name in ("kk", "jj", "hidden", "targets", "weights", "confidence"):
            setattr(self, name, getattr(self, name).index_select(0, kept))

    def touching(self, position: int) -> Tensor:
        """Select the edges of a frame.

        Args:
            position: of the frame in the window.

        Returns:
            ``(E,)`` bool, True for edges from or into the frame.
        """
        return (self.ii == position) | (self.jj == position)

    def remove(self, position: int) -> Keyframe:
        """Remove a frame with its patches and all its edges; the positions of later frames decrease by one.

        Args:
            position: of the frame in the window.

        Returns:
            The removed keyframe.
        """
        m = self.per_frame
        self.keep(~self.touching(position))
        self.kk = self.kk - m * (self.ii > position)
        self.jj = self.jj - (self.jj > position).long()
        self.poses_cw = torch.cat([self.poses_cw[:position], self.poses_cw[position + 1 :]])
        self.patches = torch.cat([self.patches[: position * m], self.patches[(position + 1) * m :]])
        return self.frames.pop(position)

    def reset(self) -> None:
        """Give all frames the pose of the first, patches the measured inverse depth or 1, and edges the state of new
        ones."""
        self.poses_cw = self.poses_cw[:1].expand_as(self.poses_cw).clone()
        depths, measured = torch.ones_like(self.patches[:, 2:]), self.measured
        if measured is not None:
            value, weight = measured[:, :, None, None, None].unbind(1)
            depths = torch.where(weight > 0, value, depths)
        self.patches = torch.cat([self.patches[:, :2], depths], dim=1)
        edges = self.hidden, self.targets, self.weights, self.confidence
        self.hidden, self.targets, self.weights, self.confidence = (torch.zeros_like(x) for x in edges)

    def snapshot(self) -> WindowSnapshot:
        """Record poses, patches, edge states and further unknowns.

        Returns:
            The snapshot; it shares memory with the window, which replaces its tensors rather than changing them.
        """
        edges = self.hidden, self.targets, self.weights, self.confidence
        return WindowSnapshot(self.poses_cw, self.patches, *edges, tuple(dict(frame.states) for frame in self.frames))

    def restore(self, before: WindowSnapshot) -> None:
        """Restore poses, patches, edge states and further unknowns.

        Args:
            before: a snapshot of the same frames and edges.
        """
        self.poses_cw, self.patches = before.poses_cw, before.patches
        self.hidden, self.targets, self.weights = before.hidden, before.targets, before.weights
        self.confidence = before.confidence
        for frame, states in zip(self.frames, before.states, strict=True):
            frame.states = dict(states)
