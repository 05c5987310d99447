"""Positions of the blocks of block-sparse normal equations, made once; see :mod:`dvo.ba.sparse.equations`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dvo.ba.sparse.block_matrix import BlockPattern, make_pattern
from dvo.core.kernels import available

EXPLICIT_WORK = 400
"""``S`` is formed if that takes at most this many block products for each observation."""
SCRATCH = 1 << 20
"""Numbers of temporary storage in a product of source frames."""
MARKS = 1 << 24
"""Pairs of frames, or of source frames and frames, up to which a kernel marks those that are coupled in a table."""


@dataclass(frozen=True)
class LocalGroups:
    """Source frames, sorted by the number of frames that see their patches.

    Attributes:
        chunks: ``(first group, end, first observation, end, M, L)``: at most ``M`` frames, ``L`` patches in a group.
        group, place, patch: ``(O,)`` group of each observation, and its frame and patch counted within the group.
        order: ``(O,)`` observations sorted by group.
        members: ``(G, M_max)`` free frames of each group in rising order, filled up with -1.
    """

    chunks: tuple[tuple[int, int, int, int, int, int], ...]
    group: Tensor
    place: Tensor
    patch: Tensor
    order: Tensor
    members: Tensor


@dataclass(frozen=True)
class GroupProducts:
    """Products of the observations of some source frames.

    Attributes:
        shape: number of source frames, and of patches and frames of each.
        rows: ``(O',)`` observations.
        cells: ``(O',)`` place of each in a tensor of that shape.
        patch: ``(O',)`` patch of each.
        used: indices of the products ``(G, M, M)`` that are blocks of the lower triangle of ``S``.
        blocks: the block of each.
    """

    shape: tuple[int, int, int]
    rows: Tensor
    cells: Tensor
    patch: Tensor
    used: tuple[Tensor, ...]
    blocks: Tensor


@dataclass(frozen=True)
class SchurPattern:
    """Positions of what is stored; depends on the edges only and is made once.

    Attributes:
        free: number ``n`` of pose blocks.
        patches: number ``K`` of inverse depths.
        source: ``(K,)`` source frame of each patch.
        keys: ``(O,)`` sorted ``patch * n + frame`` of the observations by free frames.
        h_pp: pattern of ``H_pp``.
    """

    free: int
    patches: int
    source: Tensor
    keys: Tensor
    h_pp: BlockPattern

    @cached_property
    def patch(self) -> Tensor:
        """``(O,)`` patch of each observation."""
        return torch.div(self.keys, max(self.free, 1), rounding_mode="floor")

    @cached_property
    def frame(self) -> Tensor:
        """``(O,)`` free frame of each observation."""
        return self.keys % max(self.free, 1)

    @property
    def stored_blocks(self) -> int:
        """Blocks of the full system: observations and blocks of ``H_pp``. At most linear in edges."""
        return len(self.keys) + self.h_pp.count

    def find(self, frame: Tensor, patch: Tensor) -> Tensor:
        """Position of observations; one past the last for frames that are not free (``frame == n``)."""
        if self.compiled:
            from dvo.ba.sparse import schur_kernels

            end = frame.contiguous().numpy(), patch.contiguous().numpy()
            return torch.from_numpy(schur_kernels.find(self.keys.numpy(), self.first.numpy(), *end, self.free))
        at = torch.searchsorted(self.keys, patch * self.free + frame)
        return torch.where(frame < self.free, at, len(self.keys))

    @property
    def compiled(self) -> bool:
        """Positions are for kernels."""
        return self.keys.device.type == "cpu" and available()

    @cached_property
    def first(self) -> Tensor:
        """``(K + 1,)`` first observation of each patch."""
        counts = torch.bincount(self.patch, minlength=self.patches)
        return torch.cat((counts.new_zeros(1), counts.cumsum(0)))

    @cached_property
    def by_source(self) -> tuple[Tensor, Tensor]:
        """``(K,)`` patches by source frames, and the first of each source frame, ``K`` after the last."""
        counts = torch.bincount(self.source)
        return self.source.argsort(stable=True), torch.cat((counts.new_zeros(1), counts.cumsum(0)))

    @cached_property
    def sizes(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Sorted keys ``(source, frame)``, sources, number of frames and number of patches of each source."""
        pairs = (self.source[self.patch] * max(self.free, 1) + self.frame).unique()
        sources, frames = torch.div(pairs, max(self.free, 1), rounding_mode="floor").unique_consecutive(
            return_counts=True
        )
        patches = torch.bincount(self.source[self.patch.unique_consecutive()], minlength=int(self.source.max()) + 1)
        return pairs, sources, frames, patches[sources]

    @cached_property
    def explicit(self) -> bool:
        """True if forming ``S`` is cheaper than many products with it."""
        if len(self.keys) == 0:
            return True
        sources = int(self.source.max()) + 1
        if sources * self.free <= MARKS:  # a table is faster than sorting
            source = self.source[self.patch]
            marked = torch.zeros(sources, self.free, dtype=torch.bool, device=self.keys.device)
            marked[source, self.frame] = True
            frames = marked.sum(1)
            patches = torch.bincount(self.source[self.patch.unique_consecutive()], minlength=sources)
        else:
            _, _, frames, patches = self.sizes
        return int((frames * frames * patches).sum()) <= EXPLICIT_WORK * len(self.keys)

    @cached_property
    def groups(self) -> LocalGroups:
        """Layout of the products that form ``S``."""
        pairs, sources, frames, patches = self.sizes
        device = self.keys.device
        by_size = frames.argsort(stable=True)
        rank = torch.empty_like(by_size)
        rank[by_size] = torch.arange(len(by_size), device=device)
        first = frames.cumsum(0) - frames
        pair_group = torch.arange(len(sources), device=device).repeat_interleave(frames)
        place_of_pair = torch.arange(len(pairs), device=device) - first[pair_group]
        members = torch.full((len(sources), int(frames.max())), -1, dtype=torch.long, device=device)
        members[rank[pair_group], place_of_pair] = pairs % self.free
        source = self.source[self.patch]
        place = place_of_pair[torch.searchsorted(pairs, source * self.free + self.frame)]
        group = rank[torch.searchsorted(sources, source)]
        seen = self.patch.unique_consecutive()  # patches with an observation, counted within their source
        by_source = self.source[seen].argsort(stable=True)
        start = patches.cumsum(0) - patches
        within = torch.empty_like(seen)
        within[by_source] = torch.arange(len(seen), device=device) - start.repeat_interleave(patches)
        patch = within[torch.searchsorted(seen, self.patch)]
        order = group.argsort(stable=True)
        ends = torch.bincount(group, minlength=len(sources)).cumsum(0).tolist()
        m, count = frames[by_size].tolist(), patches[by_size].tolist()
        chunks, begin = [], 0
        while begin < len(m):
            end, most = begin + 1, count[begin]
            while end < len(m):
                most_next, m_next = max(most, count[end]), m[end]
                if (end + 1 - begin) * (6 * m_next * most_next + 36 * m_next * m_next) > SCRATCH:
                    break
                end, most = end + 1, most_next
            chunks.append((begin, end, ends[begin - 1] if begin else 0, ends[end - 1], m[end - 1], most))
            begin = end
        return LocalGroups(tuple(chunks), group, place, patch, order, members)

    @cached_property
    def in_reduced(self) -> Tensor:
        """Position in :attr:`reduced` of each block of ``H_pp``."""
        return torch.searchsorted(self.reduced.keys, self.h_pp.keys)

    @cached_property
    def reduced(self) -> BlockPattern:
        """Pattern of ``S``."""
        keys = self.h_pp.keys
        sources = int(self.source.max()) + 1 if len(self.source) else 0
        if self.compiled and self.free * max(self.free, sources) <= MARKS:
            from dvo.ba.sparse import schur_kernels

            arrays = self.keys.numpy(), self.source.numpy(), self.free, sources, keys.numpy()
            return BlockPattern(self.free, torch.from_numpy(schur_kernels.coupled(*arrays)))
        for begin, end, _, _, m, _ in self.groups.chunks if len(self.keys) else ():
            rows, columns, _ = _lower_pairs(self.groups.members[begin:end, :m])
            keys = torch.cat((keys, rows * self.free + columns)).unique()
        return BlockPattern(self.free, keys)

    @cached_property
    def products(self) -> tuple[GroupProducts, ...]:
        """Places of the products that form ``S``, one for each chunk of :attr:`groups`."""
        found = []
        groups = self.groups if len(self.keys) else None
        for begin, end, first, last, m, patches in groups.chunks if groups else ():
            assert groups is not None
            rows = groups.order[first:last]
            local = (groups.group[rows] - begin) * patches + groups.patch[rows]
            row, column, used = _lower_pairs(groups.members[begin:end, :m])
            shape = (end - begin, patches, m)
            cells, blocks = local * m + groups.place[rows], self.reduced.find(row, column)
            found.append(GroupProducts(shape, rows, cells, self.patch[rows], used.nonzero(as_tuple=True), blocks))
        return tuple(found)


def make_schur_pattern(
    free: int, source: Tensor, frame: Tensor, patch: Tensor, pair_a: Tensor, pair_b: Tensor
) -> SchurPattern:
    """Pattern of a problem.

    Args:
        free: number of free poses ``n``.
        source: ``(K,)`` source frame of each patch; used only to group patches that are seen from similar frames.
        frame, patch: ``(M,)`` observations, in any order, repeated or not; ``frame == n`` for a fixed one.
        pair_a, pair_b: ``(M,)`` pairs of poses that share a measurement, ``n`` for a fixed one.
    """
    if patch.device.type == "cpu" and available():
        from dvo.ba.sparse import schur_kernels

        keys = torch.from_numpy(schur_kernels.observations(patch.numpy(), frame.numpy(), len(source), free))
    else:
        seen = frame < free
        keys = (patch[seen] * free + frame[seen]).unique()
    return SchurPattern(free, len(source), source, keys, make_pattern(free, pair_a, pair_b))


def _lower_pairs(members: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and columns of the lower-triangle blocks of groups ``(G, M)``, and which of ``(G, M, M)`` they are."""
    used = members >= 0
    lower = torch.ones(members.shape[1], members.shape[1], dtype=torch.bool, device=members.device).tril()
    which = used[:, :, None] & used[:, None, :] & lower
    shape = which.shape
    return members[:, :, None].expand(shape)[which], members[:, None, :].expand(shape)[which], which
