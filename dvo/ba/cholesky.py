"""Sparse Cholesky factorisation by dense tiles.

Consecutive block rows of a block-sparse matrix are grouped into tiles, and tiles are eliminated in an order that keeps
fill small (minimum degree; Davis, "Direct methods for sparse linear systems", 2006, chapter 7). All arithmetic is on
dense tiles, so the few operations are large ones. Consecutive block rows should be neighbours, as the frames of a video
are.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import torch
from torch import Tensor

TILE_SIZES = (16, 8, 4, 2)
"""Block rows of a tile, the candidates."""
SECONDS_PER_PRODUCT = 1e-10
"""Rough cost of a multiplication and addition, against which :data:`SECONDS_PER_CALL` is weighed."""
SECONDS_PER_CALL = 1.5e-5

AT_ONCE = 512
"""Rows below a tile up to which all products of a column are one product: twice the arithmetic, but few calls."""
MAX_PRODUCTS, MAX_NUMBERS = 5e11, 1.2e8
"""Multiplications and stored numbers of a factorisation that is still worth doing."""


@dataclass(frozen=True)
class TilePlan:
    """Order of elimination and places of the tiles.

    Attributes:
        size: block rows ``n``.
        width: block rows of a tile.
        columns: tile columns in the order of elimination: ``(tile row, storage of the diagonal tile, rows below,
            storage of the tiles below, storage of the tiles that each product of two of those goes to)``.
        tile, row, column: ``(N,)`` storage of each stored block, and its block row and column within the tile.
        flip: ``(N,)`` bool, the block is stored transposed.
        tiles: stored tiles, with fill.
        products: multiplications of tiles.
    """

    size: int
    width: int
    columns: list[tuple[int, int, list[int], Tensor, list[Tensor]]]
    tile: Tensor
    row: Tensor
    column: Tensor
    flip: Tensor
    tiles: int
    products: int

    def seconds(self, dim: int) -> float:
        """Rough time of a factorisation with blocks of ``dim``."""
        side = self.width * dim
        return self.products * (side**3 * SECONDS_PER_PRODUCT) + 3 * self.tiles * SECONDS_PER_CALL

    def numbers(self, dim: int) -> int:
        """Stored numbers with blocks of ``dim``."""
        return self.tiles * (self.width * dim) ** 2


def plan_tiles(size: int, rows: Tensor, columns: Tensor, width: int, limit: float = float("inf")) -> TilePlan | None:
    """Symbolic factorisation.

    Args:
        size: block rows ``n``.
        rows, columns: ``(N,)`` blocks of the lower triangle, with the diagonal.
        width: block rows of a tile.
        limit: of the products of tiles.

    Returns:
        The plan, or None where it takes more products than the limit.
    """
    count = -(-size // width)
    a, b = torch.div(rows, width, rounding_mode="floor"), torch.div(columns, width, rounding_mode="floor")
    neighbours: list[set[int]] = [set() for _ in range(count)]
    for key in (a * count + b).unique().tolist():
        i, j = divmod(key, count)
        if i != j:
            neighbours[i].add(j)
            neighbours[j].add(i)
    order, below = _eliminate(neighbours, width, limit)
    if len(order) < count:
        return None
    place = {tile: at for at, tile in enumerate(order)}
    stored: dict[tuple[int, int], int] = {}
    for tile, under in zip(order, below, strict=True):
        under.sort(key=place.__getitem__)
        for i in (tile, *under):
            stored[i, tile] = len(stored)
    device = rows.device
    steps = []
    for tile, under in zip(order, below, strict=True):
        here = torch.tensor([stored[i, tile] for i in under], dtype=torch.long, device=device)
        goes = [
            torch.tensor([stored[i, j] for j in under[: at + 1]], dtype=torch.long, device=device)
            for at, i in enumerate(under)
        ]
        steps.append((tile, stored[tile, tile], under, here, goes))
    rank = torch.tensor([place[tile] for tile in range(count)], device=device)
    flip = rank[a] < rank[b]
    keys = torch.tensor([i * count + j for i, j in stored], dtype=torch.long, device=device)
    sorted_keys, at = keys.sort()
    storage = at[torch.searchsorted(sorted_keys, torch.where(flip, b * count + a, a * count + b))]
    row, column = torch.where(flip, columns, rows) % width, torch.where(flip, rows, columns) % width
    products = sum((len(under) + 1) * (len(under) + 2) // 2 for under in below)
    return TilePlan(size, width, steps, storage, row, column, flip, len(stored), products)


def best_plan(size: int, rows: Tensor, columns: Tensor, dim: int) -> TilePlan | None:
    """Plan with the tile width that is likely to be fastest.

    Args:
        size, rows, columns: as of :func:`plan_tiles`.
        dim: rows of a block.

    Returns:
        None where every plan exceeds :data:`MAX_PRODUCTS` or :data:`MAX_NUMBERS`: the matrix is large and not sparse.
    """
    best: TilePlan | None = None
    for width in TILE_SIZES:
        each = float((width * dim) ** 3)
        limit = MAX_PRODUCTS / each if best is None else best.seconds(dim) / (each * SECONDS_PER_PRODUCT)
        plan = plan_tiles(size, rows, columns, width, limit)
        if plan is None or plan.numbers(dim) > MAX_NUMBERS:
            continue
        if best is None or plan.seconds(dim) < best.seconds(dim):
            best = plan
        elif plan.seconds(dim) > 1.5 * best.seconds(dim):
            break
    return best


def _eliminate(neighbours: list[set[int]], width: int, limit: float) -> tuple[list[int], list[list[int]]]:
    """Minimum-degree order, and for each eliminated tile its remaining neighbours; cut short at the limit."""
    queue = [(len(x), i) for i, x in enumerate(neighbours)]
    heapq.heapify(queue)
    gone = [False] * len(neighbours)
    order: list[int] = []
    below: list[list[int]] = []
    products = 0.0
    while queue and products <= limit:
        degree, tile = heapq.heappop(queue)
        if gone[tile] or degree != len(neighbours[tile]):
            continue
        gone[tile] = True
        around = neighbours[tile]
        order.append(tile)
        below.append(list(around))
        products += (len(around) + 1) * (len(around) + 2) / 2
        for i in around:
            mine = neighbours[i]
            mine |= around
            mine.discard(i)
            mine.discard(tile)
            heapq.heappush(queue, (len(mine), i))
        neighbours[tile] = set()
    return order, below


def solve_cholesky(plan: TilePlan, blocks: Tensor, rhs: Tensor) -> Tensor:
    """``A^-1 rhs`` by factorisation and substitution.

    Args:
        plan: of the pattern of ``A``.
        blocks: ``(N, D, D)`` of the lower triangle.
        rhs: ``(n, D)``.

    Returns:
        ``(n, D)``; NaN where ``A`` is not positive definite.
    """
    n, dim = rhs.shape
    side, count = plan.width * dim, len(plan.columns)
    tiles = blocks.new_zeros(plan.tiles, plan.width, plan.width, dim, dim)
    tiles[plan.tile, plan.row, plan.column] = torch.where(plan.flip[:, None, None], blocks.mT, blocks)
    tiles = tiles.transpose(2, 3).reshape(plan.tiles, side, side)
    unused = count * plan.width - n  # the last tile is filled up
    for tile, diagonal, *_ in plan.columns:
        if tile == count - 1 and unused:
            tiles[diagonal].diagonal()[side - unused * dim :] = 1
    factors, panels = [], []
    lower: dict[int, Tensor] = {}
    info = torch.zeros((), dtype=torch.int32, device=rhs.device)
    for _, diagonal, under, here, goes in plan.columns:
        factor, bad = torch.linalg.cholesky_ex(tiles[diagonal])
        info = info + bad.abs()
        panel = tiles[here].view(-1, side)
        if under:
            panel = torch.linalg.solve_triangular(factor.mT, panel, upper=True, left=False)
        if 0 < len(panel) <= AT_ONCE:
            row, column = lower.setdefault(len(under), torch.tril_indices(*[len(under)] * 2, device=rhs.device))
            product = (panel @ panel.mT).view(len(under), side, len(under), side)[row, :, column]
            tiles.index_add_(0, torch.cat(goes), product, alpha=-1)
            goes = []
        for at, target in enumerate(goes):
            product = panel[: (at + 1) * side] @ panel[at * side : (at + 1) * side].mT
            tiles.index_add_(0, target, product.view(at + 1, side, side).mT, alpha=-1)
        factors.append(factor)
        panels.append(panel)
    if bool(info != 0):
        return torch.full_like(rhs, torch.nan)
    x = torch.nn.functional.pad(rhs, (0, 0, 0, unused)).reshape(count, side, 1)
    for (tile, _, under, _, _), factor, panel in zip(plan.columns, factors, panels, strict=True):
        x[tile] = torch.linalg.solve_triangular(factor, x[tile], upper=False)
        if under:
            x[under] -= (panel @ x[tile]).view(-1, side, 1)
    for (tile, _, under, _, _), factor, panel in zip(plan.columns[::-1], factors[::-1], panels[::-1], strict=True):
        rest = x[tile] - panel.mT @ x[under].view(-1, 1) if under else x[tile]
        x[tile] = torch.linalg.solve_triangular(factor.mT, rest, upper=True)
    return x.view(-1, dim)[:n]
