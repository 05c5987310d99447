"""Benchmark of places: true overlap of known views, recall from known scores, and the methods that are compared."""

import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.map.places import PlaceIndex
from dvo.synth.sequence import make_sequence
from eval.benchmarks.place_recognition.methods import aggregate, bag_of_words, fit_vlad, score_words, vlad_method
from eval.benchmarks.place_recognition.scoring import recall_of
from eval.scoring.overlap import depth_maps, shared_view
from eval.systems.peers.vocabulary import read_vocabulary, train, write_vocabulary

K = np.array([40.0, 40.0, 31.5, 23.5])


def test_shared_view_of_a_wall():
    """Three cameras before a wall at 2 m: a shift of half the view, and one that faces away."""
    depth = np.full((3, 48, 64), 2.0, np.float32)
    poses = np.array([[0, 0, 0, 0, 0, 0, 1.0], [1.6, 0, 0, 0, 0, 0, 1.0], [0, 0, 0, 0, 1.0, 0, 0]])
    shared = shared_view(depth, K, poses, np.ones((3, 3), bool))
    assert np.diag(shared).tolist() == [1, 1, 1]
    assert shared[0, 1] == shared[1, 0] == pytest.approx(0.5, abs=0.04)
    assert shared[0, 2] == shared[2, 1] == 0


def test_an_occluded_view_is_not_shared():
    depth = np.full((2, 48, 64), 2.0, np.float32)
    depth[1, :, :32] = 0.5  # something before the second camera hides the left half
    poses = np.tile([0, 0, 0, 0, 0, 0, 1.0], (2, 1))
    pairs = np.array([[False, True], [False, False]])
    shared = shared_view(depth, K, poses, pairs)
    assert shared[0, 1] == pytest.approx(0.5, abs=0.04) and shared[1, 0] == 0


@pytest.mark.long
def test_rendered_depth_agrees_with_the_flow():
    sequence = make_sequence(5, frames=8, fps=2.0, height=96, width=128, family="room")
    depth, intrinsics = depth_maps(sequence, np.array([0, 2, 7]))
    shared = shared_view(depth, intrinsics, sequence.groundtruth.poses_wc[[0, 2, 7]], np.ones((3, 3), bool))
    for row, first in enumerate((0, 2)):
        for column, last in ((1, 2), (2, 7)):
            seen = min(sequence.flow(first, last).visible.mean(), sequence.flow(last, first).visible.mean())
            assert shared[row, column] == pytest.approx(seen, abs=0.1)


def test_recall_by_hand():
    shared = np.zeros((4, 4))
    shared[2, 0], shared[3, 1] = 0.9, 0.5
    allowed = np.tril(np.ones((4, 4), bool), -1)
    scores = np.zeros((4, 4))
    scores[1, 0] = 0.6  # a keyframe that is no revisit: its best candidate bounds the score
    scores[2, :2] = 0.7, 0.1
    scores[3, :3] = 0.2, 0.3, 0.4
    found = recall_of(scores, shared, allowed)
    assert found.queries == 2 and found.first == (0.5, 1.0, 1.0)
    assert found.precise == 0.5
    scores[1, 0] = 0.8
    assert recall_of(scores, shared, allowed).precise == 0
    assert recall_of(scores, shared, allowed, apart=1).first == (0.5, 0.5, 0.5)  # 1 stands beside 2
    assert np.isnan(recall_of(scores, np.zeros((4, 4)), allowed).precise)


def test_recall_agrees_with_the_index():
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(40, 12)).astype(np.float32)
    vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float16).astype(np.float32)
    index, older = PlaceIndex(12), np.tril(np.ones((40, 40), bool), -10)
    shared = np.where(rng.random((40, 40)) < 0.1, 0.5, 0.0)
    for number, vector in enumerate(vectors):
        index.add(number, vector)
    for apart in (0, 3):
        hits = np.array(
            [
                [
                    bool((shared[k, index.query(v, count, before=k - 9, apart=apart).identifiers] >= 0.3).any())
                    for count in (1, 3, 5)
                ]
                for k, v in enumerate(vectors)
            ]
        )
        asked = (np.where(older, shared, 0) >= 0.3).any(1)
        found = recall_of(vectors @ vectors.T, shared, older, apart)
        assert found.queries == asked.sum() and found.first == pytest.approx(hits[asked].mean(0))


def test_vlad_sums_residuals():
    centroids = np.array([[1.0, 0, 0], [0, 1.0, 0]], np.float32)
    features = np.array([[0.8, 0, 0.6], [0.8, 0, -0.6], [0, 1.0, 0]], np.float32)
    vector = aggregate(features, centroids).reshape(2, 3)
    np.testing.assert_allclose(vector, [[-1, 0, 0], [0, 0, 0]], atol=1e-6)


def test_vlad_tells_textures_apart_wherever_they_are():
    def picture(kind, seed):
        rng = torch.Generator().manual_seed(seed)
        base = torch.randn(8, 1, 1, generator=torch.Generator().manual_seed(kind))
        return (base + 0.5 * torch.randn(8, 12, 16, generator=rng))[None, None]

    method = vlad_method(fit_vlad((picture(k % 4, k) for k in range(24)), centroids=2, dimensions=6))
    entries = [method.describe(np.zeros(0), picture(kind, 100 + kind)) for kind in range(4)]
    for kind in range(4):
        query = method.describe(np.zeros(0), picture(kind, 200 + kind).flip(-1))
        assert method.score(query, entries).argmax() == kind
    assert method.size(entries[0]) == 12


@pytest.mark.long
def test_orb_words_and_their_file(tmp_path):
    images = [
        make_sequence(seed, frames=1, height=120, width=160, family="corridor").frame(0).image for seed in range(3)
    ]
    rng = np.random.default_rng(0)
    vocabulary = train([rng.integers(0, 256, (60, 32)).astype(np.uint8) for _ in range(4)], 4, 2, 0)
    write_vocabulary(tmp_path / "words.txt", vocabulary)
    again = read_vocabulary(tmp_path / "words.txt")
    assert (again.descriptors == vocabulary.descriptors).all() and (again.parents == vocabulary.parents).all()
    np.testing.assert_allclose(again.weights, vocabulary.weights, rtol=1e-6)
    entries = [bag_of_words(image, None, again) for image in images]
    assert sum(entries[0].values()) == pytest.approx(1)
    scores = np.stack([score_words(entry, entries) for entry in entries])
    assert np.diag(scores) == pytest.approx(1) and (scores - np.eye(3) < 0.999).all()
    assert score_words(bag_of_words(np.zeros((120, 160, 3), np.uint8), None, again), entries).tolist() == [0, 0, 0]
    (tmp_path / "bad.txt").write_text("10 4 0 0\n0 1 2\n")
    for name in ("bad.txt", "missing.txt"):
        with pytest.raises(DvoError, match="DBoW2"):
            read_vocabulary(tmp_path / name)
