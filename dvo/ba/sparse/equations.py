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
from typing import Any

import torch
from torch import Tensor

from dvo.ba.sparse.block_matrix import BlockMatrix, block_jacobi, conjugate_gradients, make_pattern, solve_blocks
from dvo.ba.sparse.block_parts import PART
from dvo.ba.sparse.levenberg import MAX_DIAGONAL, MIN_DIAGONAL, LMOptions
from dvo.ba.sparse.schur_pattern import SCRATCH, SchurPattern
from dvo.core.errors import DvoError
from dvo.core.kernels import use_kernels


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
        if self._compiled(x):
            from dvo.ba.sparse import schur_kernels

            out = torch.empty_like(self.h_ll)
            h_pl, keys, first, free = self._rows()
            schur_kernels.to_depths(h_pl, keys, first, free, x.contiguous().numpy(), out.numpy())
            return out
        each = (self.h_pl * x.index_select(0, self.pattern.frame)).sum(-1)
        return torch.zeros_like(self.h_ll).index_add_(0, self.pattern.patch, each)

    def _to_poses(self, y: Tensor) -> Tensor:
        """``H_pl y`` for ``y (K,)``."""
        if self._compiled(y):
            from dvo.ba.sparse import schur_kernels

            out = torch.zeros(self.g_p.shape, dtype=y.dtype)
            h_pl, keys, first, free = self._rows()
            schur_kernels.to_poses(h_pl, keys, first, free, y.contiguous().numpy(), out.numpy())
            return out
        each = self.h_pl * y.index_select(0, self.pattern.patch)[:, None]
        return torch.zeros_like(self.g_p).index_add_(0, self.pattern.frame, each)

    def _compiled(self, x: Tensor) -> bool:
        return self.h_pl.shape[-1] == PART and use_kernels(self.h_pl, x, double=True)

    def _rows(self) -> tuple[Any, Any, Any, int]:
        """Arguments of kernels: observations, their keys, the first of each patch, number of free frames."""
        pattern = self.pattern
        return self.h_pl.contiguous().numpy(), pattern.keys.numpy(), pattern.first.numpy(), pattern.free

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
        blocks.index_copy_(0, pattern.in_reduced, poses.blocks)
        if self._compiled(q):
            from dvo.ba.sparse import schur_kernels

            h_pl, keys, first, free = self._rows()
            reduced = pattern.reduced
            by_source, first_of_source = (x.numpy() for x in pattern.by_source)
            arrays = by_source, first_of_source, reduced.keys.numpy(), reduced.first.numpy(), blocks.numpy()
            schur_kernels.reduce(h_pl, keys, first, q.contiguous().numpy(), free, *arrays)
            return BlockMatrix(reduced, blocks)
        for part in pattern.products:
            count, patches, m = part.shape
            w = self.h_pl.new_zeros(count * patches * m, dim)
            w[part.cells] = self.h_pl[part.rows] * q[part.patch].sqrt()[:, None]
            w = w.view(count, patches, m * dim)
            product = (w.mT @ w).view(count, m, dim, m, dim).transpose(2, 3)
            blocks.index_add_(0, part.blocks, product[part.used], alpha=-1)
        return BlockMatrix(pattern.reduced, blocks)
