"""Sparse Cholesky factorisation by dense tiles.

Consecutive block rows of a block-sparse matrix are grouped into tiles, and tiles are eliminated in an order that keeps
fill small: all tiles of least degree that are no neighbours of each other at once (multiple minimum degree; Liu,
"Modification of the minimum-degree algorithm by multiple elimination", 1985). All arithmetic is on dense tiles, and
that of the tiles of a round is one batch, so the few operations are large ones. Consecutive block rows should be
neighbours, as the frames of a video are.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import torch
from torch import Tensor

TILE_SIZES = (16, 8, 4, 2, 1)
"""Block rows of a tile, the candidates."""
SECONDS_PER_ROUND, SECONDS_PER_TILE, SECONDS_PER_NUMBER, SECONDS_PER_PRODUCT = 2e-4, 3e-7, 6e-9, 2e-11
"""Rough costs of the calls for a round; of a product of tiles, of each number in it, and of a multiplication."""

AT_ONCE = 512
"""Rows below a tile up to which all its products are one product: twice the arithmetic, but few calls."""
MAX_BLOCKS = 2**17
"""Blocks of the products of a batch, at most, if there is more than one tile in it."""
LARGE = 256
"""Numbers of a tile from which adding one after the other is faster than gathering and scattering them all."""
MAX_PRODUCTS, MAX_NUMBERS = 5e11, 1.2e8
"""Multiplications and stored numbers of a factorisation that is still worth doing."""


@dataclass(frozen=True)
class Round:
    """Tiles that are eliminated together: no two of them share an entry, and each has ``m`` tiles below it.

    Attributes:
        tile: ``(g,)`` tile rows.
        diagonal: ``(g,)`` storage of the diagonal tiles.
        under: ``(g, m)`` rows of the tiles below.
        here: ``(g, m)`` storage of these.
        goes: ``(g, m (m + 1) / 2)`` storage of the tiles that the products of two of those go to, in the order of
            ``torch.tril_indices``.
        turns: positions in ``goes``, flattened, in parts of which none holds a storage twice.
        rows_in_turn: the same for ``under``.
    """

    tile: Tensor
    diagonal: Tensor
    under: Tensor
    here: Tensor
    goes: Tensor
    turns: list[Tensor]
    rows_in_turn: list[Tensor]


@dataclass(frozen=True)
class TilePlan:
    """Order of elimination and places of the tiles.

    Attributes:
        size: block rows ``n``.
        width: block rows of a tile.
        rounds: tiles in the order of elimination.
        tile, row, column: ``(N,)`` storage of each stored block, and its block row and column within the tile.
        flip: ``(N,)`` bool, the block is stored transposed.
        tiles: stored tiles, with fill.
        products: multiplications of tiles.
    """

    size: int
    width: int
    rounds: list[Round]
    tile: Tensor
    row: Tensor
    column: Tensor
    flip: Tensor
    tiles: int
    products: int

    def seconds(self, dim: int) -> float:
        """Rough time of a factorisation with blocks of ``dim``."""
        side = self.width * dim
        return len(self.rounds) * SECONDS_PER_ROUND + self.products * _seconds_per_product(side)

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
    chosen = _eliminate(neighbours, limit)
    if chosen is None:
        return None
    place = {tile: at for at, (tile, _) in enumerate(pair for group in chosen for pair in group)}
    stored: dict[tuple[int, int], int] = {}
    for group in chosen:
        for tile, under in group:
            under.sort(key=place.__getitem__)
            for i in (tile, *under):
                stored[i, tile] = len(stored)
    device = rows.device
    steps = []
    for group in chosen:
        most = max(1, MAX_BLOCKS // max(1, len(group[0][1]) * width) ** 2)
        steps += [_round(group[k : k + most], stored, device) for k in range(0, len(group), most)]
    rank = torch.tensor([place[tile] for tile in range(count)], device=device)
    flip = rank[a] < rank[b]
    keys = torch.tensor([i * count + j for i, j in stored], dtype=torch.long, device=device)
    sorted_keys, at = keys.sort()
    storage = at[torch.searchsorted(sorted_keys, torch.where(flip, b * count + a, a * count + b))]
    row, column = torch.where(flip, columns, rows) % width, torch.where(flip, rows, columns) % width
    products = sum((len(under) + 1) * (len(under) + 2) // 2 for group in chosen for _, under in group)
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
        side = width * dim
        limit = MAX_PRODUCTS / side**3 if best is None else 1.5 * best.seconds(dim) / _seconds_per_product(side)
        plan = plan_tiles(size, rows, columns, width, limit)
        if plan is None and best is not None:  # smaller tiles take longer still
            break
        if plan is None or plan.numbers(dim) > MAX_NUMBERS:
            continue
        if best is None or plan.seconds(dim) < best.seconds(dim):
            best = plan
    return best


def _seconds_per_product(side: int) -> float:
    return SECONDS_PER_TILE + side**2 * SECONDS_PER_NUMBER + side**3 * SECONDS_PER_PRODUCT


def _round(group: list[tuple[int, list[int]]], stored: dict[tuple[int, int], int], device: torch.device) -> Round:
    """Round of tiles with as many tiles below each."""

    count, m = len(group), len(group[0][1])
    pairs = [(i, j) for i in range(m) for j in range(i + 1)]

    def whole(values: list[int], *shape: int) -> Tensor:
        return torch.tensor(values, dtype=torch.long, device=device).view(*shape)

    under = whole([i for _, rows in group for i in rows], count, m)
    goes = whole([stored[rows[i], rows[j]] for _, rows in group for i, j in pairs], count, len(pairs))
    return Round(
        whole([tile for tile, _ in group], count), whole([stored[tile, tile] for tile, _ in group], count), under,
        whole([stored[i, tile] for tile, rows in group for i in rows], count, m), goes,
        _turns(goes.view(-1)), _turns(under.view(-1)),
    )  # fmt: skip


def _turns(values: Tensor) -> list[Tensor]:
    """Positions of values ``(N,)`` in parts: the first occurrence of each value, the second of each, and so on."""
    ordered, position = values.sort(stable=True)
    _, counts = ordered.unique_consecutive(return_counts=True)
    first = (counts.cumsum(0) - counts).repeat_interleave(counts)
    turn = torch.arange(len(values), device=values.device) - first
    return [position[turn == k].sort().values for k in range(int(counts.max()) if len(counts) else 0)]


def _eliminate(neighbours: list[set[int]], limit: float) -> list[list[tuple[int, list[int]]]] | None:
    """Rounds of tiles, each with its remaining neighbours; None where they take more products than the limit."""
    queue = [(len(x), i) for i, x in enumerate(neighbours)]
    heapq.heapify(queue)
    gone = [False] * len(neighbours)
    rounds: list[list[tuple[int, list[int]]]] = []
    products = 0.0
    while queue:
        least = -1
        group: list[tuple[int, list[int]]] = []
        blocked: set[int] = set()
        touched: set[int] = set()
        while queue and (not group or queue[0][0] == least):
            degree, tile = heapq.heappop(queue)
            if gone[tile] or degree != len(neighbours[tile]):
                continue
            if tile in blocked:  # a neighbour of one that is eliminated in this round; its degree may change
                touched.add(tile)
                continue
            least = degree
            gone[tile] = True
            around = neighbours[tile]
            group.append((tile, list(around)))
            blocked |= around
            products += (degree + 1) * (degree + 2) / 2
            if products > limit:
                return None
        for tile, around_list in group:
            around = set(around_list)
            for i in around_list:
                neighbours[i] |= around
                neighbours[i].discard(i)
                neighbours[i].discard(tile)
            touched |= around
            neighbours[tile] = set()
        for i in sorted(touched):
            heapq.heappush(queue, (len(neighbours[i]), i))
        if group:
            rounds.append(group)
    return rounds


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
    side, count = plan.width * dim, -(-n // plan.width)
    tiles = blocks.new_zeros(plan.tiles, plan.width, plan.width, dim, dim)
    tiles[plan.tile, plan.row, plan.column] = torch.where(plan.flip[:, None, None], blocks.mT, blocks)
    tiles = tiles.transpose(2, 3).reshape(plan.tiles, side, side)
    unused = count * plan.width - n  # the last tile is filled up
    if unused:
        last = next(int(r.diagonal[k]) for r in plan.rounds for k in (r.tile == count - 1).nonzero()[:, 0].tolist())
        tiles[last].diagonal()[side - unused * dim :] = 1
    factors, panels = [], []
    info = torch.zeros((), dtype=torch.int32, device=rhs.device)
    for step in plan.rounds:
        factor, bad = torch.linalg.cholesky_ex(tiles.index_select(0, step.diagonal))
        info = torch.maximum(info, bad.abs().amax())
        g, m = step.under.shape
        panel = tiles.index_select(0, step.here.view(-1)).view(g, m * side, side)
        if m:
            panel = torch.linalg.solve_triangular(factor.mT, panel, upper=True, left=False)
            _subtract_products(tiles, panel, step, side)
        factors.append(factor)
        panels.append(panel)
    if bool(info != 0):
        return torch.full_like(rhs, torch.nan)
    x = torch.nn.functional.pad(rhs, (0, 0, 0, unused)).reshape(count, side, 1)
    for step, factor, panel in zip(plan.rounds, factors, panels, strict=True):
        part = torch.linalg.solve_triangular(factor, x.index_select(0, step.tile), upper=False)
        x.index_copy_(0, step.tile, part)
        _subtract(x, (panel @ part).view(-1, side, 1), step.under.view(-1), step.rows_in_turn)
    for step, factor, panel in zip(plan.rounds[::-1], factors[::-1], panels[::-1], strict=True):
        rest = x.index_select(0, step.tile)
        if step.under.numel():
            below = x.index_select(0, step.under.view(-1)).view(len(rest), -1, 1)
            rest = rest - panel.mT @ below
        x.index_copy_(0, step.tile, torch.linalg.solve_triangular(factor.mT, rest, upper=True))
    return x.view(-1, dim)[:n]


def _subtract_products(tiles: Tensor, panel: Tensor, step: Round, side: int) -> None:
    """Subtract the products of the tiles below those of a round, in place.

    Args:
        tiles: ``(N, side, side)``.
        panel: ``(g, m * side, side)``.
        step: the round.
        side: rows of a tile.
    """
    g, m = step.under.shape
    if m * side <= AT_ONCE:
        row, column = torch.tril_indices(m, m, device=tiles.device)
        product = (panel @ panel.mT).view(g, m, side, m, side).transpose(2, 3)[:, row, column]
        _subtract(tiles, product.reshape(-1, side, side), step.goes.view(-1), step.turns)
        return
    for k in range(g):
        done = 0
        for at in range(m):
            part = panel[k, : (at + 1) * side] @ panel[k, at * side : (at + 1) * side].mT
            target = step.goes[k, done : done + at + 1]  # each once
            tiles.index_add_(0, target, part.view(at + 1, side, side).mT, alpha=-1)
            done += at + 1


def _subtract(values: Tensor, change: Tensor, index: Tensor, turns: list[Tensor]) -> None:
    """``values[index] -= change`` in place, also where an index is there several times."""
    if values[0].numel() >= LARGE:
        values.index_add_(0, index, change, alpha=-1)
        return
    for turn in turns if len(turns) > 1 else [slice(None)] * len(turns):
        at = index[turn]
        values.index_copy_(0, at, values.index_select(0, at) - change[turn])
