"""The sliding window of the tracker: keyframes, their patches, and the edges between them.

All indices are positions in the window; frames leave by :meth:`Window.remove`, which renumbers the rest, so nothing
here grows with the length of the video.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from dvo.graph.edges import PatchGraph, build_graph


@dataclass
class Keyframe:
    """One frame of the window.

    Attributes:
        identifier: running number of the keyframe, never reused.
        timestamp: seconds.
        slot: where the feature maps of the frame lie.
        matching: ``(M, C, p, p)`` features of its patches.
        context: ``(M, D)``.
        colors: ``(M, 3)`` uint8.
        intrinsics: ``(4,)`` of the feature map.
    """

    identifier: int
    timestamp: float
    slot: int
    matching: Tensor
    context: Tensor
    colors: Tensor
    intrinsics: Tensor


@dataclass
class Window:
    """Keyframes and edges.

    Attributes:
        per_frame: patches a frame ``M``; patch ``k`` belongs to frame ``k // M``.
        frames: the keyframes, oldest first.
        poses_cw: ``(n, 7)``.
        patches: ``(n * M, 3, p, p)``.
        ii, jj, kk: ``(E,)`` edges.
        hidden: ``(E, D)``.
        weights: ``(E, 2)`` confidence of the last update.
        slots: ``(E,)`` where caches keep what belongs to an edge; the number stays with the edge for its life.
        graph: index structure of the edges, built when first asked for after a change.
    """

    per_frame: int
    poses_cw: Tensor
    patches: Tensor
    hidden: Tensor
    weights: Tensor
    jj: Tensor
    kk: Tensor
    slots: Tensor
    frames: list[Keyframe] = field(default_factory=list)
    _graph: PatchGraph | None = None

    @classmethod
    def empty(cls, per_frame: int, patch_size: int, hidden: int, device: torch.device) -> Window:
        def zeros(*shape: int) -> Tensor:
            return torch.zeros(*shape, device=device)

        index = torch.zeros(0, dtype=torch.long, device=device)
        size = (0, 3, patch_size, patch_size)
        return cls(per_frame, zeros(0, 7), zeros(*size), zeros(0, hidden), zeros(0, 2), index, index, index)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def ii(self) -> Tensor:
        return self.kk // self.per_frame

    @property
    def intrinsics(self) -> Tensor:
        """``(n, 4)``."""
        return torch.stack([frame.intrinsics for frame in self.frames])

    @property
    def graph(self) -> PatchGraph:
        if self._graph is None:
            self._graph = build_graph(self.ii, self.jj, self.kk)
        return self._graph

    def free_slot(self) -> int:
        """The lowest number that no frame of the window has."""
        used = {frame.slot for frame in self.frames}
        return next(slot for slot in range(len(used) + 1) if slot not in used)

    def append(self, frame: Keyframe, pose_cw: Tensor, patches: Tensor) -> None:
        self.frames.append(frame)
        self.poses_cw = torch.cat([self.poses_cw, pose_cw[None]])
        self.patches = torch.cat([self.patches, patches])

    def connect(self, kk: Tensor, jj: Tensor) -> Tensor:
        """Add edges with an empty state; returns their slots, the lowest free ones."""
        self._graph = None
        count = len(kk)
        free = torch.ones(len(self.slots) + count, dtype=torch.bool, device=kk.device)
        used = self.slots[self.slots < len(free)]
        free[used] = False
        slots = free.nonzero()[:count, 0]
        self.slots = torch.cat([self.slots, slots])
        self.kk, self.jj = torch.cat([self.kk, kk]), torch.cat([self.jj, jj])
        self.hidden = torch.cat([self.hidden, self.hidden.new_zeros(count, self.hidden.shape[1])])
        self.weights = torch.cat([self.weights, self.weights.new_zeros(count, 2)])
        return slots

    def keep(self, mask: Tensor) -> None:
        """Drop the edges where ``mask`` is False."""
        self._graph = None
        self.kk, self.jj = self.kk[mask], self.jj[mask]
        self.hidden, self.weights, self.slots = self.hidden[mask], self.weights[mask], self.slots[mask]

    def remove(self, index: int) -> Keyframe:
        """Take a frame out, with its patches and every edge that touches it."""
        m = self.per_frame
        self.keep((self.ii != index) & (self.jj != index))
        self.kk = self.kk - m * (self.ii > index)
        self.jj = self.jj - (self.jj > index).long()
        self.poses_cw = torch.cat([self.poses_cw[:index], self.poses_cw[index + 1 :]])
        self.patches = torch.cat([self.patches[: index * m], self.patches[(index + 1) * m :]])
        return self.frames.pop(index)
