"""Index of places: order of the candidates, the bound of memory, and the way to a file and back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.map.places import PlaceIndex


def unit(rng, count, dimensions):
    vectors = rng.normal(size=(count, dimensions)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def filled(identifiers, vectors, capacity=1000):
    index = PlaceIndex(vectors.shape[1], capacity)
    for identifier, vector in zip(identifiers, vectors, strict=True):
        index.add(identifier, vector)
    return index


@given(st.integers(0, 1000), st.integers(1, 100), st.integers(1, 12), st.integers(0, 300))
@settings(max_examples=40, deadline=None)
def test_candidates_are_the_best_of_all_rows_whatever_the_order_of_adding(seed, count, wanted, before):
    rng = np.random.default_rng(seed)
    vectors, query = unit(rng, count, 16), unit(rng, 1, 16)[0]
    identifiers = rng.choice(300, count, replace=False)
    found = filled(identifiers, vectors).query(query, wanted, before=before)
    scores = vectors.astype(np.float16).astype(np.float32) @ query
    known = identifiers < before
    expected = identifiers[known][np.argsort(-scores[known])][:wanted]
    assert found.identifiers.tolist() == expected.tolist()
    np.testing.assert_allclose(found.scores, np.sort(scores[known])[::-1][:wanted], atol=1e-5)
    again = filled(identifiers[::-1], vectors[::-1]).query(query, wanted, before=before)
    assert again.identifiers.tolist() == found.identifiers.tolist() and (again.scores == found.scores).all()


def test_equal_scores_come_by_identifier():
    rng = np.random.default_rng(0)
    same = unit(rng, 1, 384)
    index = filled(rng.permutation(77), np.repeat(same, 77, 0))
    assert index.query(same[0], 77).identifiers.tolist() == list(range(77))


def test_the_best_view_counts():
    index = filled([0, 1], np.eye(3, dtype=np.float32)[:2])
    views = np.array([[0.0, 0.6, 0.8], [0.9, 0.0, 0.1]], np.float32)
    found = index.query(views)
    assert found.identifiers.tolist() == [0, 1] and found.scores.tolist() == pytest.approx([0.9, 0.6])


def test_candidates_keep_their_distance():
    angles = 0.1 * np.arange(40)
    index = filled(range(40), np.stack([np.cos(angles), np.sin(angles)], 1))
    query = np.array([np.cos(2.03), np.sin(2.03)])
    assert index.query(query, 3).identifiers.tolist() == [20, 21, 19]
    assert index.query(query, 3, apart=4).identifiers.tolist() == [20, 25, 15]


def test_a_full_index_forgets_what_repeats_and_keeps_the_rest():
    rng = np.random.default_rng(1)
    way = unit(rng, 10, 64)
    index = PlaceIndex(64, capacity=12)
    for identifier in range(60):  # ten places, six times the same picture at each
        index.add(identifier, way[identifier // 6])
    assert len(index) == 12 and index.nbytes == 12 * (2 * 64 + 8)
    assert set((index.identifiers // 6).tolist()) == set(range(10))
    assert 0 in index and 59 in index


def test_replacing_and_removing():
    index = filled([3, 5], np.eye(2, dtype=np.float32))
    index.add(3, np.array([0.0, -1.0]))
    assert len(index) == 2 and index.query(np.array([0.0, 1.0])).scores.tolist() == [1.0, -1.0]
    index.remove(5)
    index.remove(4)
    assert index.identifiers.tolist() == [3] and 5 not in index
    assert PlaceIndex(2).query(np.array([1.0, 0.0])).identifiers.tolist() == []


def test_to_arrays_and_back():
    rng = np.random.default_rng(2)
    vectors, fresh = unit(rng, 30, 20), unit(rng, 40, 20)
    index = filled(range(30), vectors, capacity=50)
    again = PlaceIndex.from_arrays(index.to_arrays())
    for k, vector in enumerate(fresh):  # beyond the capacity, so that both forget
        index.add(100 + k, vector)
        again.add(100 + k, vector)
    assert again.identifiers.tolist() == index.identifiers.tolist() and len(again) == 50
    ours, theirs = index.query(fresh[7], 9), again.query(fresh[7], 9)
    assert (ours.identifiers == theirs.identifiers).all() and (ours.scores == theirs.scores).all()


@pytest.mark.parametrize(
    "change",
    [
        {"identifiers": np.array([1, 1])},
        {"identifiers": np.array([1])},
        {"descriptors": np.full((2, 3), np.nan, np.float16)},
        {"capacity": np.array(1)},
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(change):
    arrays = filled([1, 2], np.eye(3, dtype=np.float32)[:2]).to_arrays()
    PlaceIndex.from_arrays(arrays)
    with pytest.raises(DvoError):
        PlaceIndex.from_arrays({**arrays, **change})
    with pytest.raises(DvoError, match="missing"):
        PlaceIndex.from_arrays({name: array for name, array in arrays.items() if name not in change})


@pytest.mark.parametrize("vector", [np.ones(3), np.array([np.nan, 0, 0]), np.zeros(2), np.zeros((1, 1, 3))])
def test_what_is_no_descriptor_is_refused(vector):
    index = PlaceIndex(3)
    with pytest.raises(DvoError, match="unit vector"):
        index.add(0, vector)
    with pytest.raises(DvoError):
        PlaceIndex(0)
