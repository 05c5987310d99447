"""Block-sparse normal equations of poses and inverse depths, and their solution by Schur complement.

    [ H_pp   H_pl ] [ dp ]   [ g_p ]
    [ H_pl^T H_ll ] [ dl ] = [ g_l ]

``H_pl`` has one block of ``D x 1`` for each observation, a patch seen from a frame; nothing of the size frames x
patches is ever made. The reduced system ``S = H_pp - H_pl H_ll^-1 H_pl^T`` couples the frames that share a patch. It is
formed explicitly, as block-sparse matrix, where frames share patches with few others, as along a video with some loops;
patches of one source frame are seen from much the same frames, so its contribution is a small dense product. Where it
would be too dense, conjugate gradients work on the product ``S x`` without ``S`` (Agarwal et al., "Bundle adjustment
in the large", 2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dvo.ba.block_matrix import BlockMatrix, BlockPattern, block_jacobi, conjugate_gradients, make_pattern, solve_blocks
from dvo.ba.levenberg import MAX_DIAGONAL, MIN_DIAGONAL, LMOptions
from dvo.errors import DvoError

EXPLICIT_WORK = 400
"""``S`` is formed if that takes at most this many block products for each observation."""
SCRATCH = 1 << 20
"""Numbers of temporary storage in a product of source frames."""


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
        at = torch.searchsorted(self.keys, patch * self.free + frame)
        return torch.where(frame < self.free, at, len(self.keys))

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
    def reduced(self) -> BlockPattern:
        """Pattern of ``S``."""
        keys = self.h_pp.keys
        for begin, end, _, _, m, _ in self.groups.chunks if len(self.keys) else ():
            rows, columns, _ = _lower_pairs(self.groups.members[begin:end, :m])
            keys = torch.cat((keys, rows * self.free + columns)).unique()
        return BlockPattern(self.free, keys)


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


@dataclass(frozen=True)
class SparseSystem:
    """Normal equations at one linearisation point.

    Attributes:
        pattern: where the blocks are.
        h_pp: ``(N, D, D)`` blocks of its pattern ``h_pp``.
        h_pl: ``(O, D)`` one for each observation.
        h_ll: ``(K,)`` curvature by each inverse depth.
        g_p: ``(n, D)``, g_l: ``(K,)`` negative gradients.
        move_depths: False holds the inverse depths.
    """

    pattern: SchurPattern
    h_pp: Tensor
    h_pl: Tensor
    h_ll: Tensor
    g_p: Tensor
    g_l: Tensor
    move_depths: bool = True

    def add(
        self,
        residual: Tensor,
        weight: Tensor,
        poses: Sequence[tuple[Tensor, Tensor]],
        depths: Sequence[tuple[Tensor, Tensor]] = (),
    ) -> None:
        """Add measurements of any kind, in place.

        Args:
            residual: ``(F, R)``, which a step ``delta`` changes to ``r - J delta``.
            weight: ``(F, R)``.
            poses: for each pose that a row touches its unknown ``(F,)``, ``n`` for none, and ``J (F, R, D)``.
            depths: at most one element ``(F,)``, -1 for none, and ``J (F, R)``.

        Raises:
            DvoError: two inverse depths in a row.
        """
        n, pattern = self.pattern.free, self.pattern.h_pp
        weighted = [(slot, jacobian.mT * weight[:, None]) for slot, jacobian in poses]
        for slot_a, left in weighted:
            free = slot_a < n
            self.g_p.index_add_(0, slot_a[free], (left @ residual[..., None])[free][..., 0])
            for slot_b, jacobian in poses:
                # Off-diagonal products come twice, transposed; keep the one of the lower triangle.
                keep = free & (slot_b < n) & (slot_a >= slot_b)
                self.h_pp.index_add_(0, pattern.find(slot_a[keep], slot_b[keep]), (left[keep] @ jacobian[keep]))
        if len(depths) > 1:
            raise DvoError("a factor couples two inverse depths", remedy="give it one slot of that block")
        for index, by_depth in depths:
            used = index >= 0
            wd = weight * by_depth
            self.h_ll.index_add_(0, index[used], (wd * by_depth).sum(-1)[used])
            self.g_l.index_add_(0, index[used], (wd * residual).sum(-1)[used])
            for slot, jacobian in poses:
                both = used & (slot < n)
                rows = (jacobian.mT @ wd[..., None])[both][..., 0]
                self.h_pl.index_add_(0, self.pattern.find(slot[both], index[both]), rows)

    def step(self, damping: float, options: LMOptions) -> tuple[tuple[Tensor, Tensor], float]:
        """Damped Gauss-Newton step.

        Args:
            damping: this fraction of the diagonal is added to it.
            options: the linear solver.

        Returns:
            ``(dp (n, D), dl (K,))`` and the decrease of the cost that the linear model predicts.
        """
        poses = BlockMatrix(self.pattern.h_pp, self.h_pp)
        d_p = damping * poses.diagonal.clamp(MIN_DIAGONAL, MAX_DIAGONAL)
        d_l = damping * self.h_ll.clamp(MIN_DIAGONAL, MAX_DIAGONAL)
        seen = (self.h_ll > 0) & self.move_depths
        q = torch.where(seen, 1 / torch.where(seen, self.h_ll + d_l, 1.0), 0.0)
        dp, dl = self._solve(poses.damped(d_p), q, options)
        predicted = 0.5 * float((dp * (d_p * dp + self.g_p)).sum() + (dl * (d_l * dl + self.g_l)).sum())
        return (dp, dl), predicted

    def _solve(self, poses: BlockMatrix, q: Tensor, options: LMOptions) -> tuple[Tensor, Tensor]:
        if self.pattern.free == 0:
            return self.g_p, q * self.g_l
        if not self.move_depths:
            return solve_blocks(poses, self.g_p, options.solver, options.cg), torch.zeros_like(self.g_l)
        rhs = self.g_p - self._to_poses(q * self.g_l)
        if self.pattern.explicit or options.solver == "direct":
            dp = solve_blocks(self.reduce(poses, q), rhs, options.solver, options.cg)
        else:
            dp = self._solve_implicitly(poses, q, rhs, options)
        return dp, q * (self.g_l - self._to_depths(dp))

    def _solve_implicitly(self, poses: BlockMatrix, q: Tensor, rhs: Tensor, options: LMOptions) -> Tensor:
        """Conjugate gradients on ``S`` without forming it; the preconditioner is its block diagonal."""
        times_poses = poses.operator()

        def product(x: Tensor) -> Tensor:
            return times_poses(x) - self._to_poses(q * self._to_depths(x))

        none = torch.zeros(0, dtype=torch.long, device=rhs.device)
        diagonal = BlockMatrix(make_pattern(self.pattern.free, none, none), self._diagonal(poses, q))
        return conjugate_gradients(product, rhs, block_jacobi(diagonal, 1), options.cg)[0]

    def _to_depths(self, x: Tensor) -> Tensor:
        """``H_pl^T x`` for ``x (n, D)``."""
        each = (self.h_pl * x.index_select(0, self.pattern.frame)).sum(-1)
        return torch.zeros_like(self.h_ll).index_add_(0, self.pattern.patch, each)

    def _to_poses(self, y: Tensor) -> Tensor:
        """``H_pl y`` for ``y (K,)``."""
        each = self.h_pl * y.index_select(0, self.pattern.patch)[:, None]
        return torch.zeros_like(self.g_p).index_add_(0, self.pattern.frame, each)

    def _diagonal(self, poses: BlockMatrix, q: Tensor) -> Tensor:
        """Diagonal blocks ``(n, D, D)`` of ``S``."""
        out = poses.blocks[poses.pattern.diagonal]
        step = SCRATCH // 36
        for begin in range(0, len(self.h_pl), step):
            part = slice(begin, begin + step)
            rows = self.h_pl[part]
            outer = rows[:, :, None] * (rows * q[self.pattern.patch[part]][:, None])[:, None]
            out = out.index_add(0, self.pattern.frame[part], outer, alpha=-1)
        return out

    def reduce(self, poses: BlockMatrix, q: Tensor) -> BlockMatrix:
        """``S = poses - H_pl diag(q) H_pl^T`` as block-sparse matrix.

        Args:
            poses: ``H_pp``, damped.
            q: ``(K,)`` inverse of the damped ``H_ll``.
        """
        pattern, dim = self.pattern, self.h_pl.shape[-1]
        blocks = self.h_pl.new_zeros(pattern.reduced.count, dim, dim)
        blocks[torch.searchsorted(pattern.reduced.keys, poses.pattern.keys)] = poses.blocks
        groups = pattern.groups if len(pattern.keys) else None
        for begin, end, first, last, m, patches in groups.chunks if groups else ():
            assert groups is not None
            which = groups.order[first:last]
            local = (groups.group[which] - begin) * patches + groups.patch[which]
            rows = self.h_pl[which]
            w = self.h_pl.new_zeros((end - begin) * patches * m, dim)
            w[local * m + groups.place[which]] = rows * q[pattern.patch[which]].sqrt()[:, None]
            w = w.view(end - begin, patches, m * dim)
            product = (w.mT @ w).view(end - begin, m, dim, m, dim).transpose(2, 3)
            row, column, used = _lower_pairs(groups.members[begin:end, :m])
            blocks.index_add_(0, pattern.reduced.find(row, column), product[used], alpha=-1)
        return BlockMatrix(pattern.reduced, blocks)
