"""Symmetric block-sparse matrices ``(n D, n D)`` and solvers for positive definite systems with them.

Only the blocks of the lower triangle that can be non-zero are stored; which these are (the pattern) is found once and
their values change with each linearisation. A system is solved either directly, by the sparse Cholesky factorisation
of :mod:`dvo.ba.sparse.cholesky`, its compiled twin :mod:`dvo.ba.sparse.column_cholesky`, or the one of
:mod:`dvo.ba.sparse.multifrontal` that needs SciPy, or by conjugate gradients with a block-Jacobi preconditioner.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import torch
from torch import Tensor

from dvo.ba.sparse.cholesky import TilePlan, best_plan, solve_cholesky
from dvo.ba.sparse.column_cholesky import DIM, ColumnPlan, plan_columns, solve_columns
from dvo.ba.sparse.multifrontal import (
    Columns,
    FrontPlan,
    order_columns,
    plan_fronts,
    scipy_is_installed,
    solve_fronts,
)
from dvo.core.errors import DvoError
from dvo.core.kernels import use_kernels

LinearSolver = Literal["auto", "tiles", "fronts", "direct", "cg"]
"""Cholesky by tiles or by fronts, each with conjugate gradients where the factor would be too large; "direct" is by
tiles or an error; "cg" is without a factor. "auto" leaves the choice to the problem."""


@dataclass(frozen=True)
class CGOptions:
    """Conjugate gradients.

    Attributes:
        tolerance: of the residual, relative to the right-hand side, in the norm of the preconditioner.
        max_iterations: after which the present iterate is taken.
        cluster: this many consecutive unknown blocks are inverted together by the preconditioner; 1 is block-Jacobi.
    """

    tolerance: float = 1e-6
    max_iterations: int = 1000
    cluster: int = 16


@dataclass(frozen=True)
class BlockPattern:
    """Positions of the stored blocks.

    Attributes:
        size: ``n`` block rows.
        keys: ``(N,)`` sorted ``row * n + column`` of the lower triangle; every diagonal block is among them.
    """

    size: int
    keys: Tensor

    @property
    def count(self) -> int:
        """Stored blocks ``N``."""
        return self.keys.shape[0]

    @cached_property
    def rows(self) -> Tensor:
        """``(N,)`` block row of each block."""
        return torch.div(self.keys, max(self.size, 1), rounding_mode="floor")

    @cached_property
    def columns(self) -> Tensor:
        """``(N,)`` block column of each block, at most the row."""
        return self.keys % max(self.size, 1)

    @cached_property
    def diagonal(self) -> Tensor:
        """``(n,)`` position of each diagonal block."""
        return self.find(*[torch.arange(self.size, device=self.keys.device)] * 2)

    @cached_property
    def off_diagonal(self) -> Tensor:
        """Positions of the blocks below the diagonal."""
        return torch.nonzero(self.rows != self.columns)[:, 0]

    @cached_property
    def first(self) -> Tensor:
        """``(n + 1,)`` first block of each block row."""
        counts = torch.bincount(self.rows, minlength=self.size)
        return torch.cat((counts.new_zeros(1), counts.cumsum(0)))

    @cached_property
    def column_plan(self) -> ColumnPlan | None:
        """The same for the compiled factorisation, whose blocks are those of poses."""
        return plan_columns(self.size, self.rows, self.columns)

    @cached_property
    def _plans(self) -> dict[int, TilePlan | None]:
        return {}

    def cholesky_plan(self, dim: int) -> TilePlan | None:
        """Plan of the Cholesky factorisation with blocks of ``dim``, made once; None if it would be too large."""
        if dim not in self._plans:
            self._plans[dim] = best_plan(self.size, self.rows, self.columns, dim)
        return self._plans[dim]

    @cached_property
    def _fronts(self) -> dict[int, FrontPlan | None]:
        return {}

    @cached_property
    def _columns(self) -> Columns | None:
        return order_columns(self.size, self.rows.cpu().numpy(), self.columns.cpu().numpy())

    def front_plan(self, dim: int) -> FrontPlan | None:
        """The same for the factorisation by fronts, which needs SciPy."""
        if dim not in self._fronts:
            rows, columns = self.rows.cpu().numpy(), self.columns.cpu().numpy()
            self._fronts[dim] = plan_fronts(self._columns, rows, columns, dim) if self._columns else None
        return self._fronts[dim]

    def find(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Positions of blocks that are stored, ``rows >= columns``."""
        return torch.searchsorted(self.keys, rows * self.size + columns)


def make_pattern(size: int, rows: Tensor, columns: Tensor) -> BlockPattern:
    """Pattern that holds the blocks ``(rows, columns)``, either triangle, repeated or not, and the diagonal.

    Args:
        size: ``n`` block rows; blocks with an index outside ``0..n-1`` are dropped.
        rows, columns: ``(M,)``.
    """
    inside = (rows >= 0) & (rows < size) & (columns >= 0) & (columns < size)
    rows, columns = rows[inside], columns[inside]
    lower = torch.maximum(rows, columns) * size + torch.minimum(rows, columns)
    diagonal = torch.arange(size, device=rows.device) * (size + 1)
    return BlockPattern(size, torch.cat((lower, diagonal)).unique())


@dataclass(frozen=True)
class BlockMatrix:
    """Symmetric matrix: a pattern and its lower-triangle blocks ``(N, D, D)``."""

    pattern: BlockPattern
    blocks: Tensor

    @property
    def diagonal(self) -> Tensor:
        """``(n, D)`` scalar diagonal."""
        return self.blocks[self.pattern.diagonal].diagonal(dim1=-2, dim2=-1)

    def damped(self, extra: Tensor) -> BlockMatrix:
        """The matrix plus a diagonal ``extra (n, D)``."""
        return BlockMatrix(self.pattern, self.blocks.index_add(0, self.pattern.diagonal, torch.diag_embed(extra)))

    def times(self, x: Tensor) -> Tensor:
        """``A x`` for ``x (n, D)``."""
        rows, columns = self.pattern.rows, self.pattern.columns
        y = torch.zeros_like(x).index_add_(0, rows, (self.blocks @ x[columns, :, None])[..., 0])
        below = self.pattern.off_diagonal
        mirrored = (x[rows[below], None] @ self.blocks[below])[:, 0]
        return y.index_add_(0, columns[below], mirrored)

    def operator(self) -> Callable[[Tensor], Tensor]:
        """``x -> A x`` prepared for many products: the two triangles written out in rows of compressed storage."""
        pattern, dim, below = self.pattern, self.blocks.shape[-1], self.pattern.off_diagonal
        rows = torch.cat((pattern.rows, pattern.columns[below]))
        order = (rows * pattern.size + torch.cat((pattern.columns, pattern.rows[below]))).argsort()
        columns = torch.cat((pattern.columns, pattern.rows[below]))[order]
        blocks = torch.cat((self.blocks, self.blocks[below].mT))[order]
        rows = rows[order]

        def product(x: Tensor) -> Tensor:
            # A multiply and a sum: much faster than a batch of very small matrix products.
            y = (blocks * x.index_select(0, columns)[:, None, :]).sum(-1)
            return torch.zeros_like(x).index_add_(0, rows, y)

        assert dim == blocks.shape[-2]
        return product

    def dense(self) -> Tensor:
        """``(n D, n D)``; for tests and small problems."""
        n, dim = self.pattern.size, self.blocks.shape[-1]
        out = self.blocks.new_zeros(n, n, dim, dim)
        out[self.pattern.columns, self.pattern.rows] = self.blocks.mT
        out[self.pattern.rows, self.pattern.columns] = self.blocks
        return out.transpose(1, 2).reshape(n * dim, n * dim)


def block_jacobi(matrix: BlockMatrix, cluster: int) -> Callable[[Tensor], Tensor]:
    """Preconditioner that inverts the diagonal blocks of ``cluster`` consecutive block rows each.

    Args:
        matrix: positive definite.
        cluster: block rows inverted together; 1 is block-Jacobi proper.

    Returns:
        Map of ``(n, D)`` to ``(n, D)``. A cluster that cannot be factorised is left as it is.
    """
    n, dim = matrix.pattern.size, matrix.blocks.shape[-1]
    cluster = max(1, min(cluster, n))
    count = -(-n // cluster)
    rows, columns = matrix.pattern.rows, matrix.pattern.columns
    of = torch.div(rows, cluster, rounding_mode="floor")
    inside = of == torch.div(columns, cluster, rounding_mode="floor")
    rows, columns, of, blocks = rows[inside], columns[inside], of[inside], matrix.blocks[inside]
    grid = matrix.blocks.new_zeros(count, cluster, cluster, dim, dim)
    grid[of, columns % cluster, rows % cluster] = blocks.mT
    grid[of, rows % cluster, columns % cluster] = blocks
    dense = grid.transpose(2, 3).reshape(count, cluster * dim, cluster * dim)
    if count * cluster > n:  # the last cluster is filled up
        dense[-1].diagonal()[(n - (count - 1) * cluster) * dim :] = 1
    factor, info = torch.linalg.cholesky_ex(dense)
    eye = torch.eye(cluster * dim, dtype=dense.dtype, device=dense.device)
    inverse = torch.cholesky_inverse(torch.where((info == 0)[:, None, None], factor, eye))

    def apply(x: Tensor) -> Tensor:
        padded = torch.nn.functional.pad(x, (0, 0, 0, count * cluster - n)).view(count, cluster * dim, 1)
        return (inverse @ padded).view(count * cluster, dim)[:n]

    return apply


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    rhs: Tensor,
    precondition: Callable[[Tensor], Tensor],
    options: CGOptions = CGOptions(),  # noqa: B008 (frozen)
) -> tuple[Tensor, int]:
    """Preconditioned conjugate gradients from zero (Hestenes and Stiefel 1952; Saad, algorithm 9.1).

    Args:
        product: symmetric positive definite map of ``(n, D)`` to ``(n, D)``.
        rhs: ``(n, D)``.
        precondition: approximation of its inverse, symmetric positive definite.
        options: when to stop.

    Returns:
        ``x (n, D)`` and the number of iterations. Iteration ends early where the curvature is not positive.
    """
    x, r = torch.zeros_like(rhs), rhs
    z = precondition(r)
    p, rz = z, float((r * z).sum())
    limit = options.tolerance**2 * rz
    for iteration in range(options.max_iterations):
        if not rz > limit or rz <= 0:
            return x, iteration
        ap = product(p)
        curvature = float((p * ap).sum())
        if not curvature > 0:
            return x, iteration
        alpha = rz / curvature
        x = x + alpha * p
        r = r - alpha * ap
        z = precondition(r)
        rz, previous = float((r * z).sum()), rz
        p = z + (rz / previous) * p
    return x, options.max_iterations


def solve_blocks(
    matrix: BlockMatrix,
    rhs: Tensor,
    solver: LinearSolver = "auto",
    options: CGOptions = CGOptions(),  # noqa: B008 (frozen)
) -> Tensor:
    """``A^-1 rhs`` for ``rhs (n, D)``.

    Args:
        matrix: symmetric positive definite.
        rhs: ``(n, D)``, or ``(n, D, R)`` for several.
        solver: see :data:`LinearSolver`; "auto" is the factorisation of :mod:`dvo.ba.sparse.column_cholesky` where it
            can be used, and "tiles" elsewhere.
        options: of conjugate gradients.

    Returns:
        Of the shape of ``rhs``; NaN where a direct solution finds that the matrix is not positive definite.

    Raises:
        DvoError: an unknown solver, "direct" where the factor would be too large, or "fronts" without SciPy.
    """
    if solver not in get_args(LinearSolver):
        raise DvoError(
            f"unknown linear solver {solver!r}", field="solver", remedy=f"use {', '.join(get_args(LinearSolver))}"
        )
    if matrix.pattern.size == 0:
        return rhs
    if solver == "fronts":
        return _solve_by_fronts(matrix, rhs, options)
    if rhs.dim() == 3:
        return torch.stack([solve_blocks(matrix, each, solver, options) for each in rhs.unbind(-1)], -1)
    if solver == "auto" and rhs.shape[-1] == DIM and use_kernels(matrix.blocks, rhs, double=True):
        columns = matrix.pattern.column_plan
        if columns is not None:
            return solve_columns(columns, matrix.blocks, rhs)
    plan = None if solver == "cg" else matrix.pattern.cholesky_plan(matrix.blocks.shape[-1])
    if plan is not None:
        return solve_cholesky(plan, matrix.blocks, rhs)
    if solver == "direct":
        raise DvoError("the matrix is too dense to factorise", field="solver", remedy="use solver='cg'")
    return conjugate_gradients(matrix.operator(), rhs, block_jacobi(matrix, options.cluster), options)[0]


def _solve_by_fronts(matrix: BlockMatrix, rhs: Tensor, options: CGOptions) -> Tensor:
    if not scipy_is_installed():
        raise DvoError("SciPy is not installed", field="solver", remedy="pip install dvo[sparse], or use tiles")
    plan = matrix.pattern.front_plan(matrix.blocks.shape[-1])
    if plan is None:
        return solve_blocks(matrix, rhs, "cg", options)
    found = solve_fronts(plan, matrix.blocks.double().cpu().numpy(), rhs.double().cpu().numpy())
    return torch.full_like(rhs, torch.nan) if found is None else torch.from_numpy(found).to(rhs)
