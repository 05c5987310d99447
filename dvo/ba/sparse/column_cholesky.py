"""Sparse Cholesky factorisation by block columns, compiled; its twin is :mod:`dvo.ba.sparse.cholesky`.

Block columns are eliminated one after the other, in an order of minimum degree; each is subtracted at once from those
that it has rows in, in runs of rows that are neighbours in both. Blocks are those of poses, 6 x 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

DIM = 6
"""Rows of a block."""
MAX_SIZE, MAX_BLOCKS = 4096, 3_000_000
"""Block rows, whose neighbours are marked in a table of this side; blocks of the factor."""


@dataclass(frozen=True)
class ColumnPlan:
    """Symbolic factorisation.

    Attributes:
        rank: ``(n,)`` place of each block row in the order of elimination.
        start: ``(n + 1,)`` first of the blocks of each column.
        under: place of the row of each block, rising in a column, the diagonal first.
        rows, columns: ``(N,)`` blocks of the matrix.
        place: ``(N,)`` block of the factor where each of them goes.
    """

    rank: np.ndarray
    start: np.ndarray
    under: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    place: np.ndarray


def plan_columns(size: int, rows: Tensor, columns: Tensor) -> ColumnPlan | None:
    """Symbolic factorisation.

    Args:
        size: block rows ``n``.
        rows, columns: ``(N,)`` blocks of the lower triangle, the diagonal among them; on the CPU.

    Returns:
        The plan, or None for more block rows than :data:`MAX_SIZE` or more blocks than :data:`MAX_BLOCKS`.
    """
    from dvo.ba.sparse import column_kernels

    if not 0 < size <= MAX_SIZE:
        return None
    a, b = rows.contiguous().numpy(), columns.contiguous().numpy()  # kernels are compiled for each layout
    rank, start, under = column_kernels.eliminate(size, a, b, MAX_BLOCKS)
    if not len(rank):
        return None
    return ColumnPlan(rank, start, under, a, b, column_kernels.places(rank, start, under, a, b))


def solve_columns(plan: ColumnPlan, blocks: Tensor, rhs: Tensor) -> Tensor:
    """``A^-1 rhs`` by factorisation and substitution.

    Args:
        plan: of the pattern of ``A``.
        blocks: ``(N, 6, 6)`` of the lower triangle.
        rhs: ``(n, 6)``.

    Returns:
        ``(n, 6)``; NaN where ``A`` is not positive definite.
    """
    from dvo.ba.sparse import column_kernels

    x = torch.empty_like(rhs, memory_format=torch.contiguous_format)
    arrays = plan.rank, plan.start, plan.under, plan.rows, plan.columns, plan.place
    given = blocks.contiguous().numpy(), rhs.contiguous().numpy()
    scratch = np.empty_like(given[1]), np.zeros(36 * len(plan.under), given[0].dtype)
    done = column_kernels.solve(*arrays, *given, x.numpy(), *scratch)
    return x if done else torch.full_like(rhs, torch.nan)
