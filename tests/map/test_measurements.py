"""Packed measurements: rounding, order, and their memory."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.map.archive import Archive
from dvo.map.measurements import ArchivedEdges, pack_edges


def random_edges(count, seed=0, frames=5, patches=24, spread=100.0):
    rng = np.random.default_rng(seed)
    source, target = (70_000 * rng.integers(0, frames, (2, count))).astype(np.int32)
    patch = rng.integers(0, patches, count).astype(np.int16)
    position = (spread * rng.normal(size=(count, 2))).astype(np.float32)
    return ArchivedEdges(
        source, patch, target, position, np.exp(2 * rng.normal(size=(count, 2)) - 2).astype(np.float16)
    )


def columns(edges):
    return edges.source, edges.patch, edges.target, edges.position, edges.weight


def ordered(edges):
    return edges.select(np.lexsort((edges.target, edges.source)))


@given(
    st.integers(0, 300), st.integers(0, 99), st.sampled_from([24, 256, 257, 2000]), st.sampled_from([1e-6, 1.0, 1e5])
)
@settings(max_examples=60, deadline=None)
def test_packing_rounds_and_keeps_everything_else(count, seed, patches, spread):
    edges = random_edges(count, seed, patches=patches, spread=spread)
    found, wanted = pack_edges(edges).unpack(), ordered(edges)
    assert [a.dtype for a in columns(found)] == [a.dtype for a in columns(wanted)]
    for a, b in zip(columns(found)[:3], columns(wanted)[:3], strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(found.position, wanted.position, rtol=2.0**-16)
    normal = wanted.weight >= 2.0**-14
    np.testing.assert_allclose(found.weight[normal], wanted.weight[normal], rtol=2.0**-4)
    np.testing.assert_allclose(found.weight[~normal], wanted.weight[~normal], atol=2.0**-18)


@given(st.integers(0, 300), st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_packing_again_gives_the_same_bytes(count, seed):
    once = pack_edges(random_edges(count, seed))
    again = pack_edges(once.unpack())
    assert again.data.tobytes() == once.data.tobytes() and (again.pairs, again.edges) == (once.pairs, once.edges)


def test_weights_at_their_ends_and_zero():
    edges = random_edges(4, frames=1)
    weight = np.array([[0, 0], [65504, 1], [2, 6e-8], [0.5, 4]], np.float16)
    found = pack_edges(ArchivedEdges(*columns(edges)[:4], weight)).unpack().weight
    np.testing.assert_array_equal(found, [[0, 0], [61440, 1], [2, 0], [0.5, 4]])


def test_more_edges_of_a_pair_than_a_counter_holds():
    edges = random_edges(200_000, frames=1)
    found = pack_edges(edges)
    assert found.pairs == 4 and len(found.unpack()) == 200_000
    np.testing.assert_array_equal(found.unpack().patch, edges.patch)


def test_an_edge_takes_nine_bytes():
    edges = random_edges(240, frames=3)
    found = pack_edges(edges)
    assert found.nbytes == 240 * 9 + 10 * found.pairs < edges.nbytes / 2


def test_edges_with_an_end_in_a_span_are_found_without_the_others():
    archive, parts = Archive(), [random_edges(50, seed) for seed in range(4)]
    for part in parts:
        archive.add_edges(part)
    every = archive.edges()
    for first, last in ((70_000, None), (140_000, 210_000), (0, 70_000), (1, 2)):
        newest = np.maximum(every.source, every.target)
        wanted = every.select((newest >= first) & (newest <= (np.inf if last is None else last)))
        found = archive.edges(first, last)
        for a, b in zip(columns(found), columns(wanted), strict=True):
            np.testing.assert_array_equal(a, b)
