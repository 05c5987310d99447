"""Training of ORB vocabularies on small data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvo.core.errors import DvoError
from eval.__main__ import main
from eval.systems.peers.orbslam3 import count_words
from eval.systems.peers.vocabulary import (
    STATED_DEPTH,
    Vocabulary,
    hamming,
    majority_clusters,
    train,
    write_vocabulary,
)


def noisy(centres: np.ndarray, count: int, flips: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Copies of centres with some bits flipped, and which centre each is of."""
    rng = np.random.default_rng(seed)
    member = rng.integers(len(centres), size=count)
    bits = np.unpackbits(centres[member], axis=1)
    for row in bits:
        row[rng.choice(256, flips, replace=False)] ^= 1
    return np.packbits(bits, axis=1), member


@pytest.fixture(scope="module")
def centres() -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (12, 32), dtype=np.uint8)


def test_hamming_counts_bits():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 256, (7, 32), dtype=np.uint8), rng.integers(0, 256, (5, 32), dtype=np.uint8)
    expected = (np.unpackbits(a, axis=1)[:, None] != np.unpackbits(b, axis=1)[None]).sum(-1)
    assert (hamming(a, b) == expected).all()


def test_majority_recovers_the_centres(centres):
    descriptors, member = noisy(centres[:4], 400, 25, 1)
    found, assigned = majority_clusters(descriptors, 4, np.random.default_rng(0))
    distance = hamming(found, centres[:4])
    assert sorted(distance.argmin(1)) == [0, 1, 2, 3] and distance.min(1).max() <= 4
    assert (distance.argmin(1)[assigned] == member).all()


def test_alike_descriptors_make_one_cluster():
    found, member = majority_clusters(np.full((9, 32), 7, np.uint8), 4, np.random.default_rng(0))
    assert len(found) == 1 and (member == 0).all()


def test_words_separate(centres):
    images = [noisy(centres, 60, 12, seed)[0] for seed in range(8)]
    vocabulary = train(images, 4, 3, 0)
    descriptors, member = noisy(centres, 300, 12, 99)
    words = vocabulary.words(descriptors)
    assert vocabulary.is_word[words].all()
    for word in np.unique(words):  # a word holds one kind of descriptor (as good as)
        kinds = np.bincount(member[words == word])
        assert kinds.max() >= 0.9 * kinds.sum()
    assert (vocabulary.weights[vocabulary.is_word] > 0).all() and (vocabulary.weights[~vocabulary.is_word] == 0).all()


def test_the_file_is_what_dbow2_reads(centres, tmp_path):
    images = [noisy(centres, 60, 30, seed)[0] for seed in range(5)]
    vocabulary = train(images, 3, 3, 0)
    file = tmp_path / "deep" / "words.txt"
    write_vocabulary(file, vocabulary)
    head, *lines = file.read_text().splitlines()
    assert head.split() == ["3", str(STATED_DEPTH), "0", "0"] and count_words(file) == vocabulary.is_word.sum()
    rows = [line.split() for line in lines]
    assert len(rows) == len(vocabulary.parents) - 1 and all(len(row) == 35 for row in rows)
    parents = np.array([int(row[0]) for row in rows])
    numbers = np.arange(1, len(rows) + 1)
    assert (parents < numbers).all(), "a parent stands before its children"
    assert np.bincount(parents).max() <= 3
    leaf = ~np.isin(numbers, parents)
    assert (leaf == np.array([row[1] == "1" for row in rows])).all()
    assert all(0 <= int(byte) <= 255 for row in rows for byte in row[2:34])
    again = Vocabulary(
        3, 3, np.append(0, parents), np.array([[0] * 32] + [row[2:34] for row in rows], np.uint8), vocabulary.weights
    )
    assert (again.words(images[0]) == vocabulary.words(images[0])).all()


def test_too_little_to_learn_from():
    with pytest.raises(DvoError, match="too few"):
        train([], 10, 4, 0)


@pytest.mark.long
def test_command_is_deterministic(tmp_path: Path, capsys):
    small = ["--sequences", "1", "--frames", "1", "--features", "120", "--branching", "4", "--depth", "2"]
    for name in ("a", "b"):
        assert main(["vocabulary", "--out", str(tmp_path / name), *small]) == 0
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert "words from" in capsys.readouterr().out
    assert (
        main(["vocabulary", "--out", str(tmp_path / "c"), "--branching", "1"]) == 2
        and "--branching" in capsys.readouterr().err
    )
