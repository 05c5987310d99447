"""Edges of a patch graph and their neighbourhoods: edges of the same patch, of the same frame pair, next in time.

An edge ``e`` joins patch ``kk[e]``, extracted in frame ``ii[e]``, with a target frame ``jj[e]``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor


@dataclass(frozen=True)
class Groups:
    """Partition of the edges, padded so that a soft aggregation is a dense masked softmax.

    Attributes:
        members: ``(G, M)`` edge indices, padded with 0.
        mask: ``(G, M, 1)`` True where a member is real.
        group: ``(E,)`` index of the group of each edge.
        full: True if there is no padding.
    """

    members: Tensor
    mask: Tensor
    group: Tensor
    full: bool


@dataclass(frozen=True)
class PatchGraph:
    """Edges of a patch graph with their neighbourhoods.

    Attributes:
        ii, jj, kk: ``(E,)`` source frame, target frame, patch.
        previous, following: ``(E,)`` the edge of the same patch with the next smaller / larger target frame, 0 if none.
        has_previous, has_following: ``(E, 1)`` bool.
        by_patch, by_pair: edges grouped by patch, and by (source, target) frame pair.
    """

    ii: Tensor
    jj: Tensor
    kk: Tensor
    previous: Tensor
    following: Tensor
    has_previous: Tensor
    has_following: Tensor
    by_patch: Groups
    by_pair: Groups

    def __len__(self) -> int:
        return len(self.ii)


def group_edges(keys: Int[Tensor, " E"]) -> Groups:
    """Partition edges by equal key.

    Args:
        keys: integer key of each edge.

    Returns:
        The groups, by increasing key.
    """
    order = torch.argsort(keys, stable=True)
    _, group, counts = torch.unique(keys, return_inverse=True, return_counts=True)
    sizes = counts.tolist()
    widest = max(sizes, default=0)
    first = torch.cumsum(counts, 0) - counts
    slots = torch.arange(widest, device=keys.device)
    mask = slots < counts[:, None]
    members = order[(first[:, None] + slots).clamp(max=max(len(keys) - 1, 0))] if len(keys) else slots[None, :0]
    members = torch.where(mask, members, torch.zeros_like(members))
    return Groups(members, mask[..., None], group, all(size == widest for size in sizes))


def ordered(groups: Groups, rank: Int[Tensor, " E"]) -> Groups:
    """Sort the members of each group.

    Args:
        groups: partition of the ``E`` edges.
        rank: of each edge, by which members are sorted; edges of equal rank keep their order.

    Returns:
        The same groups, their members by increasing rank and the padding last. If no two members of a group have the
        same rank, the order does not depend on the order of the edges.
    """
    ranks = rank[groups.members].masked_fill(~groups.mask[..., 0], torch.iinfo(rank.dtype).max)
    return replace(groups, members=groups.members.gather(1, torch.argsort(ranks, dim=1, stable=True)))


def build_graph(
    ii: Int[Tensor, " E"], jj: Int[Tensor, " E"], kk: Int[Tensor, " E"], frames: int | None = None
) -> PatchGraph:
    """Build the neighbourhoods of a set of edges.

    Args:
        ii, jj, kk: source frame, target frame and patch of each edge, in any order.
        frames: their number, if it is known: else an accelerator is waited for.

    Returns:
        The graph, its edges in the given order.
    """
    if frames is None:
        frames = int(torch.maximum(ii.max(), jj.max())) + 1 if len(ii) else 1
    keys = kk * frames + jj
    order = torch.argsort(keys, stable=True)
    same = kk[order][1:] == kk[order][:-1]
    previous = torch.zeros_like(kk)
    following = torch.zeros_like(kk)
    has_previous = torch.zeros_like(kk, dtype=torch.bool)
    has_following = torch.zeros_like(kk, dtype=torch.bool)
    previous[order[1:]] = torch.where(same, order[:-1], 0)
    has_previous[order[1:]] = same
    following[order[:-1]] = torch.where(same, order[1:], 0)
    has_following[order[:-1]] = same
    return PatchGraph(
        ii,
        jj,
        kk,
        previous,
        following,
        has_previous[:, None],
        has_following[:, None],
        group_edges(kk),
        group_edges(ii * frames + jj),
    )
