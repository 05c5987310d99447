"""Direct solution of symmetric block-sparse systems through scipy's SuperLU. Imported only where it is used."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

_OPTIONS = {"SymmetricMode": True, "Equil": False}


class DirectLayout:
    """Fill-reducing order and compressed columns of a block pattern, reused for every new set of values.

    The order is found on the graph of blocks (minimum degree), which is ``D^2`` times smaller than that of scalars.

    Args:
        size: ``n`` block rows.
        rows, columns: ``(N,)`` of the stored blocks, lower triangle.
    """

    def __init__(self, size: int, rows: np.ndarray, columns: np.ndarray) -> None:
        self.size = size
        order = self._minimum_degree(rows, columns)
        self.order = order
        place = np.empty(size, dtype=np.int64)
        place[order] = np.arange(size)
        r, c = place[rows], place[columns]
        self.below = np.flatnonzero(rows != columns)
        r, c = np.concatenate((r, c[self.below])), np.concatenate((c, r[self.below]))
        self.sequence = np.lexsort((r, c))
        self.rows = r[self.sequence]
        self.counts = np.bincount(c, minlength=size)

    def _minimum_degree(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Blocks in the order of elimination."""
        off = rows != columns
        r, c = np.concatenate((rows[off], columns[off])), np.concatenate((columns[off], rows[off]))
        degree = np.bincount(r, minlength=self.size).astype(np.float64)
        every = np.arange(self.size)
        values = np.concatenate((np.full(len(r), -1.0), degree + 1))
        laplacian = scipy.sparse.csc_array(
            (values, (np.concatenate((r, every)), np.concatenate((c, every)))), shape=(self.size, self.size)
        )
        factor = scipy.sparse.linalg.splu(
            laplacian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=_OPTIONS
        )
        # perm_c[column of A] = its column in the product that is factorised
        return np.argsort(factor.perm_c)

    def solve(self, blocks: np.ndarray, rhs: np.ndarray) -> np.ndarray:
        """``A^-1 rhs``.

        Args:
            blocks: ``(N, D, D)`` in the order of the pattern.
            rhs: ``(n, D)``.

        Returns:
            ``(n, D)``; NaN where the matrix is singular to working precision or not finite.
        """
        n, dim = rhs.shape
        full = np.concatenate((blocks, blocks[self.below].transpose(0, 2, 1)))[self.sequence]
        if not (np.isfinite(full).all() and np.isfinite(rhs).all()):
            return np.full_like(rhs, np.nan)
        # Column by column: for the d-th column of a block column, the d-th column of each of its blocks.
        starts = np.concatenate(([0], np.cumsum(self.counts)))
        lengths = np.repeat(self.counts * dim, dim)
        indptr = np.concatenate(([0], np.cumsum(lengths)))
        column = np.repeat(np.arange(n), self.counts)
        rank = np.arange(len(full)) - starts[column]
        base = starts[column] * dim * dim + rank * dim
        offset = self.counts[column] * dim
        d, e = np.meshgrid(np.arange(dim), np.arange(dim), indexing="ij")  # column within, row within
        where = base[:, None, None] + d * offset[:, None, None] + e
        data, indices = np.empty(full.size), np.empty(full.size, dtype=np.int32)
        data[where] = full.transpose(0, 2, 1)
        indices[where] = (self.rows * dim)[:, None, None] + e
        matrix = scipy.sparse.csc_array((data, indices, indptr.astype(np.int32)), shape=(n * dim, n * dim))
        try:
            factor = scipy.sparse.linalg.splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=_OPTIONS)
        except RuntimeError:  # exactly singular
            return np.full_like(rhs, np.nan)
        x = np.empty_like(rhs)
        x[self.order] = factor.solve(rhs[self.order].reshape(-1)).reshape(n, dim)
        return x
