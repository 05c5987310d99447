"""Order of the edges within their groups."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.map.edges import build_graph, group_edges, ordered


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 9)), min_size=1, max_size=20))
@settings(max_examples=30)
def test_members_are_sorted_by_their_rank_and_stay_in_their_group(pairs):
    keys, rank = (torch.tensor(x) for x in zip(*pairs, strict=True))
    before = group_edges(keys)
    groups = ordered(before, rank)
    mask = groups.mask[..., 0]
    assert torch.equal(mask, before.mask[..., 0]) and torch.equal(groups.group, before.group)
    for members, real, first in zip(groups.members, mask, before.members, strict=True):
        assert rank[members[real]].tolist() == sorted(rank[first[real]].tolist())
        assert set(members[real].tolist()) == set(first[real].tolist())


def test_the_order_of_a_patch_does_not_depend_on_the_order_of_the_edges():
    kk, jj = torch.tensor([0, 0, 0, 1, 1]), torch.tensor([4, 1, 3, 2, 0])
    for seed in range(5):
        mixed = torch.randperm(5, generator=torch.Generator().manual_seed(seed))
        graph = build_graph(torch.zeros_like(kk), jj[mixed], kk[mixed])
        groups = ordered(graph.by_patch, graph.jj)
        assert graph.jj[groups.members[0]].tolist() == [1, 3, 4]
        assert graph.jj[groups.members[1, :2]].tolist() == [0, 2] and not groups.mask[1, 2]
