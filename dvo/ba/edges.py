"""Layout of the edges of a patch graph for fast sums, and the check of their indices.

Edges come in any order. Most of what an edge needs depends on its frame pair only, and the 6x6 blocks are sums over the
edges of a pair. Edges are therefore sorted into groups of equal size that share a pair, the last group of a pair being
filled up with empty places: then a sum over edges is a matrix product, and nothing of the pair is copied for each edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from dvo.core.errors import DvoError

CHUNK = 1 << 17
"""Places linearised at a time: bounds the memory when every pixel of a feature map is a patch."""


@dataclass(frozen=True)
class EdgePlan:
    """``G`` groups of ``M`` places for ``E`` edges with ``P`` different frame pairs.

    Attributes:
        frames, patches: their numbers.
        pair_i, pair_j: ``(P,)`` source and target frame of each pair.
        group_pair: ``(G,)`` pair of each group.
        order: ``(G * M,)`` edge of each place (any edge, if empty).
        filled: ``(G, M)`` bool.
        kk: ``(G * M,)`` patch of each place.
        numbers: ``(E,)`` of the edges in the given order, see :func:`edge_numbers`.
    """

    frames: int
    patches: int
    pair_i: Tensor
    pair_j: Tensor
    group_pair: Tensor
    order: Tensor
    filled: Tensor
    kk: Tensor
    numbers: Tensor

    @property
    def groups(self) -> int:
        return self.filled.shape[0]

    @property
    def size(self) -> int:
        return self.filled.shape[1]

    @cached_property
    def layouts(self) -> dict[tuple[int, bytes], Any]:
        """What sparse solutions of the graph share, by the number of unknowns and those of the frames."""
        return {}

    def chunks(self) -> list[slice]:
        """Slices of groups of at most ``CHUNK`` places each."""
        step = max(1, CHUNK // max(1, self.size))
        return [slice(start, min(start + step, self.groups)) for start in range(0, self.groups, step)]


def check_index(index: Tensor, count: int, field: str) -> None:
    """Check that indices ``(E,)`` lie in ``0 .. count - 1``. Waits for the device on an accelerator.

    Raises:
        DvoError: an index out of range.
    """
    if len(index) == 0:
        return
    low, high = (int(x) for x in index.aminmax())
    if low < 0 or high >= count:
        raise DvoError(
            f"index {low if low < 0 else high} outside 0..{count - 1}",
            field=field,
            remedy="give indices of frames and patches of this problem",
        )


def edge_numbers(ii: Tensor, jj: Tensor, kk: Tensor, frames: int, patches: int) -> Tensor:
    """Numbers ``(E,)`` that tell edges apart, ``(i frames + j) patches + k``."""
    return torch.add(kk, torch.add(jj, ii, alpha=frames), alpha=patches)


def plan_edges(ii: Tensor, jj: Tensor, kk: Tensor, frames: int, patches: int) -> EdgePlan:
    """Sort edges into groups. A graph that does not change needs this once.

    On an accelerator this waits for the device, as the number of groups depends on the data.

    Args:
        ii, jj, kk: ``(E,)`` source frame, target frame and patch, in any order. Indices are not checked here, see
            :func:`check_index`: one out of range would stand for another pair of frames.
        frames: number of frames.
        patches: number of patches.
    """
    device, edges = ii.device, ii.shape[0]
    if edges == 0:
        none = torch.zeros(0, dtype=torch.long, device=device)
        return EdgePlan(frames, patches, none, none, none, none, none.view(0, 1).bool(), none, none)
    by_pair, order = (ii * frames + jj).sort(stable=True)
    pairs, count = torch.unique_consecutive(by_pair, return_counts=True)
    # Groups as long as the longest pair if pairs are alike; else shorter, so that at most two thirds of the places
    # are empty.
    size = min(int(count.max()), max(4, -(-2 * edges // len(pairs))), CHUNK)
    needed = torch.div(count + size - 1, size, rounding_mode="floor")
    pair = torch.arange(len(pairs), device=device)
    group_pair = pair.repeat_interleave(needed)
    start, first_group = count.cumsum(0) - count, needed.cumsum(0) - needed
    within = (torch.arange(len(group_pair), device=device) - first_group[group_pair]) * size
    rank = within[:, None] + torch.arange(size, device=device)
    filled = rank < count[group_pair][:, None]
    order = order[torch.where(filled, start[group_pair][:, None] + rank, 0).flatten()]
    numbers = edge_numbers(ii, jj, kk, frames, patches)
    pair_i, pair_j = torch.div(pairs, frames, rounding_mode="floor"), pairs % frames
    return EdgePlan(frames, patches, pair_i, pair_j, group_pair, order, filled, kk[order], numbers)
