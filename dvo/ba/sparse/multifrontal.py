"""Sparse Cholesky factorisation by dense fronts, with the ordering and the BLAS of SciPy (``pip install dvo[sparse]``).

The blocks are ordered by multiple minimum degree (that of SuperLU, through SciPy) on the graph of the blocks, which is
smaller than the matrix by the square of the block size. Columns of the factor that have much the same rows form a
supernode; its front is factorised by LAPACK, and what that leaves for the rows below is added to the front of its
parent (Duff and Reid, "The multifrontal solution of indefinite sparse symmetric linear equations", 1983; Liu, "The
multifrontal method for sparse matrix solution", 1992). Supernodes are merged where the calls for one cost more than the
zeros that are stored in return.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import numpy as np

SECONDS_PER_FRONT, SECONDS_PER_NUMBER, SECONDS_PER_PRODUCT = 1e-4, 8e-9, 1.5e-10
"""Rough costs of the calls for a front, of each number in it, and of a multiplication; they decide what is merged."""
MAX_NUMBERS, MAX_BLOCKS, MAX_DEGREE = 1.5e8, 1.5e7, 100
"""Numbers and blocks of a factor, and neighbours of a block row in the mean, that are still worth a factorisation."""
MAX_PIECES = 16
"""Contiguous pieces of a remainder up to which they are added one by one."""


def scipy_is_installed() -> bool:
    """Whether the optional SciPy is there."""
    return importlib.util.find_spec("scipy") is not None


@dataclass(frozen=True)
class Remainder:
    """Places, in the front of its parent, of what a front leaves for the rows below it.

    Attributes:
        front: index of the child.
        at: scalar rows of the parent's front, increasing.
        pieces: runs ``(begin, end, begin of the child's)`` of these rows, none across the parent's last pivot; empty
            where they are too many.
    """

    front: int
    at: np.ndarray
    pieces: list[tuple[int, int, int]]


@dataclass(frozen=True)
class Front:
    """A supernode.

    Attributes:
        begin, end: its scalar pivots in the order of elimination.
        below: scalar rows below them, in that order.
        entries: slice of :attr:`FrontPlan.source`.
        children: what is added to it.
    """

    begin: int
    end: int
    below: np.ndarray
    entries: slice
    children: list[Remainder]


@dataclass(frozen=True)
class FrontPlan:
    """Symbolic factorisation of a pattern with blocks of one size.

    Attributes:
        order: ``(n,)`` block rows in the order of elimination.
        fronts: children before their parents.
        source: places, in the flattened blocks of the lower triangle, of the numbers that the fronts take.
        target: place of each in the panel of its front, flattened by columns.
        numbers: stored numbers of the factor.
    """

    order: np.ndarray
    fronts: list[Front]
    source: np.ndarray
    target: np.ndarray
    numbers: int


@dataclass(frozen=True)
class Columns:
    """Block columns of the factor, whatever the size of the blocks.

    Attributes:
        rank: ``(n,)`` place of each block row in the order of elimination.
        under: block rows below each column, as places in that order.
        parent: the first of these, -1 for none.
    """

    rank: np.ndarray
    under: list[set[int]]
    parent: list[int]


def order_columns(size: int, rows: np.ndarray, columns: np.ndarray) -> Columns | None:
    """Ordering and structure of the factor.

    Args:
        size: block rows ``n``.
        rows, columns: ``(N,)`` blocks of the lower triangle, the diagonal among them.

    Returns:
        The columns, or None where the matrix has more neighbours than :data:`MAX_DEGREE` or its factor more blocks than
        :data:`MAX_BLOCKS`.
    """
    if len(rows) - size > MAX_DEGREE / 2 * size + 1000:
        return None
    rank = _minimum_degree(size, rows, columns)
    under: list[set[int]] = [set() for _ in range(size)]
    for a, b in zip(rank[rows].tolist(), rank[columns].tolist(), strict=True):
        if a != b:
            under[min(a, b)].add(max(a, b))
    parent, stored = [-1] * size, 0
    for column, found in enumerate(under):  # what is below a column of the factor is also below its parent
        stored += len(found) + 1
        if stored > MAX_BLOCKS:
            return None
        if found:
            parent[column] = up = min(found)
            under[up] |= found
            under[up].discard(up)
    return Columns(rank, under, parent)


def plan_fronts(structure: Columns, rows: np.ndarray, columns: np.ndarray, dim: int) -> FrontPlan | None:
    """Supernodes, and the places of all numbers.

    Args:
        structure: of the factor.
        rows, columns: as of :func:`order_columns`.
        dim: rows of a block.

    Returns:
        The plan, or None where the factor would have more numbers than :data:`MAX_NUMBERS`.
    """
    members, parent = _merge(structure, dim)
    if sum(len(x) * (len(x) + len(structure.under[top])) for top, x in members.items()) * dim * dim > MAX_NUMBERS:
        return None
    return _place(structure, members, parent, rows, columns, dim)


def _minimum_degree(size: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Place ``(n,)`` of each block row in the order of elimination."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import splu

    off = rows != columns
    a, b, each = rows[off], columns[off], np.arange(size)
    degree = np.bincount(a, minlength=size) + np.bincount(b, minlength=size)
    values = np.concatenate((np.full(2 * len(a), -1.0), degree + 1.0))
    graph = coo_matrix((values, (np.concatenate((a, b, each)), np.concatenate((b, a, each)))), (size, size))
    factor = splu(graph.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factor.perm_c, dtype=np.int64)


def _seconds(pivots: int, below: int, dim: int) -> float:
    """Rough time for a front of so many blocks."""
    k, b = pivots * dim, below * dim
    products = k * k * k / 3 + k * k * b + k * b * b
    return SECONDS_PER_FRONT + (k + 2 * b) * (k + b) * SECONDS_PER_NUMBER + products * SECONDS_PER_PRODUCT


def _merge(structure: Columns, dim: int) -> tuple[dict[int, list[int]], dict[int, int]]:
    """Columns of each supernode, by its last column, and the supernode above it."""
    under, parent = structure.under, structure.parent
    members = [[column] for column in range(len(under))]
    head = list(range(len(under)))
    cost = [_seconds(1, len(found), dim) for found in under]
    for column, up in enumerate(parent):
        if up >= 0:
            together = _seconds(len(members[column]) + len(members[up]), len(under[up]), dim)
            if together <= cost[column] + cost[up]:
                members[up] += members[column]
                head[column], cost[up] = up, together
    for column in reversed(range(len(under))):  # the column above is further on, and done
        head[column] = head[head[column]]
    tops = [column for column in range(len(under)) if head[column] == column]
    return (
        {top: sorted(members[top]) for top in tops},
        {top: head[parent[top]] if parent[top] >= 0 else -1 for top in tops},
    )


def _place(
    structure: Columns, members: dict[int, list[int]], parent: dict[int, int],
    rows: np.ndarray, columns: np.ndarray, dim: int,
) -> FrontPlan:  # fmt: skip
    """Order of the fronts, and the places of all numbers."""
    rank, under = structure.rank, structure.under
    size = len(rank)
    inner = np.arange(dim)
    final = np.empty(size, dtype=np.int64)  # of a place in the ordering
    tops = list(members)  # a supernode comes after those below it, as its last column does
    final[np.concatenate([members[top] for top in tops]) if tops else []] = np.arange(size)
    index = {top: at for at, top in enumerate(tops)}
    children: list[list[int]] = [[] for _ in tops]
    for top in tops:
        if parent[top] >= 0:
            children[index[parent[top]]].append(index[top])
    below = [np.sort(final[list(under[top])]) if under[top] else np.zeros(0, dtype=np.int64) for top in tops]
    count = np.array([len(members[top]) for top in tops], dtype=np.int64)
    begin = np.cumsum(count) - count
    local = np.empty(size, dtype=np.int64)

    # Every block lies in the panel of the front of that of its two rows which is eliminated first.
    first, second = final[rank[rows]], final[rank[columns]]
    low, high = np.minimum(first, second), np.maximum(first, second)
    front_of = np.repeat(np.arange(len(tops)), count)
    height = count + np.array([len(x) for x in below], dtype=np.int64)
    keys = np.concatenate([at * size + x for at, x in enumerate(below)]) if tops else np.zeros(0, dtype=np.int64)
    started = np.cumsum(height - count) - (height - count)
    front = front_of[low]
    inside = front_of[high] == front
    found = np.searchsorted(keys, front * size + high) - started[front] + count[front]
    row = np.where(inside, high - begin[front], found) * dim
    column, tall = (low - begin[front]) * dim, height[front] * dim
    order = np.argsort(front, kind="stable")
    row, column, tall, first = row[order], column[order], tall[order], first[order] == high[order]
    # Stored as it is where its own row is the later one, else transposed.
    flipped = np.where(first[:, None, None], inner[:, None] * dim + inner, inner * dim + inner[:, None])
    source = (order[:, None, None] * dim * dim + flipped).ravel()
    target = (row[:, None, None] + inner[:, None] + (column[:, None, None] + inner) * tall[:, None, None]).ravel()
    ends = np.cumsum(np.bincount(front, minlength=len(tops))) * dim * dim

    fronts = []
    for at in range(len(tops)):
        k = int(count[at])
        local[begin[at] : begin[at] + k] = np.arange(k)
        local[below[at]] = k + np.arange(len(below[at]))
        remainders = []
        for child in children[at]:
            where = local[below[child]]
            cuts = np.flatnonzero((np.diff(where) != 1) | (where[1:] == k)) + 1
            starts, stops = [0, *cuts.tolist()], [*cuts.tolist(), len(where)]
            pieces = [(int(where[a]) * dim, int(where[b - 1] + 1) * dim, a * dim) for a, b in zip(starts, stops)]  # noqa: B905
            scalar = (where[:, None] * dim + inner).ravel()
            remainders.append(Remainder(child, scalar, pieces if len(pieces) <= MAX_PIECES else []))
        fronts.append(
            Front(
                int(begin[at]) * dim, int(begin[at] + k) * dim, (below[at][:, None] * dim + inner).ravel(),
                slice(int(ends[at - 1]) if at else 0, int(ends[at])), remainders,
            )
        )  # fmt: skip
    numbers = int((count * height).sum()) * dim * dim
    return FrontPlan(np.argsort(final[rank]), fronts, source, target, numbers)


def solve_fronts(plan: FrontPlan, blocks: np.ndarray, rhs: np.ndarray) -> np.ndarray | None:
    """``A^-1 rhs`` by factorisation and substitution.

    Args:
        plan: of the pattern of ``A``.
        blocks: ``(N, D, D)`` float64, of the lower triangle.
        rhs: ``(n, D)`` or ``(n, D, R)`` float64.

    Returns:
        Of the shape of ``rhs``; None where ``A`` is not positive definite.
    """
    from scipy.linalg.blas import dsyrk, dtrsm
    from scipy.linalg.lapack import dpotrf

    values = blocks.reshape(-1)[plan.source]
    remainders: dict[int, np.ndarray] = {}
    factors = []
    for at, front in enumerate(plan.fronts):
        k, b = front.end - front.begin, len(front.below)
        flat = np.zeros((k + b) * k)
        flat[plan.target[front.entries]] = values[front.entries]
        panel = flat.reshape(k + b, k, order="F")
        rest = np.zeros((b, b) if front.children else (0, 0), order="F")
        for child in front.children:
            _add(panel, rest, remainders.pop(child.front), child, k)
        top, info = dpotrf(panel[:k], lower=1, clean=0)
        if info:
            return None
        bottom = panel[k:]
        if b:
            bottom = dtrsm(1.0, top, panel[k:], side=1, lower=1, trans_a=1)
            if not front.children:
                remainders[at] = dsyrk(-1.0, bottom, lower=1)
            else:
                remainders[at] = dsyrk(-1.0, bottom, beta=1.0, c=rest, lower=1, overwrite_c=1)
        factors.append((top, bottom))
    x = rhs[plan.order].reshape(rhs.shape[0] * rhs.shape[1], -1)
    for front, (top, bottom) in zip(plan.fronts, factors, strict=True):
        part = dtrsm(1.0, top, x[front.begin : front.end], lower=1)
        x[front.begin : front.end] = part
        if len(front.below):
            x[front.below] -= bottom @ part
    for front, (top, bottom) in zip(reversed(plan.fronts), reversed(factors), strict=True):
        part = x[front.begin : front.end]
        if len(front.below):
            part = part - bottom.T @ x[front.below]
        x[front.begin : front.end] = dtrsm(1.0, top, part, lower=1, trans_a=1)
    out = np.empty_like(rhs)
    out[plan.order] = x.reshape(rhs.shape)
    return out


def _add(panel: np.ndarray, rest: np.ndarray, remainder: np.ndarray, child: Remainder, k: int) -> None:
    """Add the lower triangle of a remainder to a front, in place."""
    if not child.pieces:
        cut = int(np.searchsorted(child.at, k))
        panel[np.ix_(child.at, child.at[:cut])] += remainder[:, :cut]
        below = child.at[cut:] - k
        rest[np.ix_(below, below)] += remainder[cut:, cut:]
        return
    for at, (left, right, source) in enumerate(child.pieces):
        width = right - left
        for top, end, place in child.pieces[at:]:
            part = remainder[place : place + end - top, source : source + width]
            if left < k:
                panel[top:end, left:right] += part
            else:
                rest[top - k : end - k, left - k : right - k] += part
