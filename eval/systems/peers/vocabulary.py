"""Vocabulary of ORB descriptors, trained on rendered pictures, for ORB-SLAM3: ``python -m eval vocabulary``.

A tree of k-majority clusters (k-means for binary strings: a centre is the majority of each bit, Grana et al. 2013), in
the text format of DBoW2 (Galvez-Lopez, Tardos 2012) that ORB-SLAM reads: ``branching depth scoring weighting``, then a
line for every node but the root, ``parent is_word byte x 32 weight``, numbered from 1 in order of the lines.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dvo.core.errors import DvoError

FIRST_SEED = 4000  # of the sequences; those of the suites lie elsewhere
# ORB-SLAM groups features by the node 4 levels above the depth that the file states, and matches within groups. A
# stated depth of 4 would put all into one group; 6 gives branching^2 groups, as with its own vocabulary.
STATED_DEPTH = 6
LEAST = {"sequences": 1, "frames": 1, "features": 10, "branching": 2, "depth": 1}  # smallest values that work
_ONES = np.unpackbits(np.arange(1 << 16, dtype=np.uint16).view(np.uint8).reshape(-1, 2), axis=1).sum(1, dtype=np.uint8)


@dataclass(frozen=True)
class Vocabulary:
    """A tree of descriptors; node 0 is the root and has none.

    Attributes:
        branching, depth: most children of a node, most levels below the root.
        parents: ``(n,)`` parent of each node; smaller than its own number.
        descriptors: ``(n, 32)`` uint8.
        weights: ``(n,)`` of words, 0 elsewhere.
    """

    branching: int
    depth: int
    parents: np.ndarray
    descriptors: np.ndarray
    weights: np.ndarray

    @property
    def is_word(self) -> np.ndarray:
        """``(n,)`` bool, the leaves."""
        leaf = np.ones(len(self.parents), bool)
        leaf[self.parents[1:]] = False
        leaf[0] = False
        return leaf

    def words(self, descriptors: np.ndarray) -> np.ndarray:
        """The word (node number) of each descriptor ``(N, 32)``: down the tree to the nearest child."""
        at = np.zeros(len(descriptors), int)
        for _ in range(self.depth):
            for node in np.unique(at):
                children = np.flatnonzero(self.parents == node)
                children = children[children > 0]
                if len(children):
                    mine = np.flatnonzero(at == node)
                    at[mine] = children[hamming(descriptors[mine], self.descriptors[children]).argmin(1)]
        return at


def hamming(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Bits that differ, ``(N, 32)`` and ``(M, 32)`` uint8 to ``(N, M)`` int, by a table of 16-bit counts."""
    left, right = (np.ascontiguousarray(x).view(np.uint16) for x in (a, b))
    distances = np.zeros((len(a), len(b)), np.int64)
    for k in range(left.shape[1]):
        distances += _ONES[left[:, k, None] ^ right[None, :, k]]
    return distances


def majority_clusters(
    descriptors: np.ndarray, count: int, rng: np.random.Generator, rounds: int = 12
) -> tuple[np.ndarray, np.ndarray]:
    """k-majority from a k-means++ start.

    Args:
        descriptors: ``(N, 32)`` uint8, one or more.
        count: clusters wanted.
        rng: draws the start.
        rounds: most iterations.

    Returns:
        ``(K, 32)`` centres, all different and none without members, ``K <= count``; ``(N,)`` the cluster of each.
    """
    centres = descriptors[[int(rng.integers(len(descriptors)))]]
    nearest = hamming(descriptors, centres)[:, 0]
    while len(centres) < count and nearest.any():
        odds = nearest.astype(float) ** 2
        chosen = descriptors[[int(rng.choice(len(descriptors), p=odds / odds.sum()))]]
        centres = np.concatenate([centres, chosen])
        nearest = np.minimum(nearest, hamming(descriptors, chosen)[:, 0])
    bits = np.unpackbits(descriptors, axis=1)
    member = hamming(descriptors, centres).argmin(1)
    for _ in range(rounds):
        groups = [bits[member == k] for k in range(len(centres))]
        fresh = [np.packbits(2 * group.sum(0, dtype=np.int64) >= len(group)) for group in groups if len(group)]
        centres = np.unique(np.array(fresh), axis=0)
        before, member = member, hamming(descriptors, centres).argmin(1)
        if len(before) == len(member) and (before == member).all():
            break
    used, member = np.unique(member, return_inverse=True)
    return centres[used], member.ravel()


def train(images: list[np.ndarray], branching: int, depth: int, seed: int) -> Vocabulary:
    """A vocabulary from the descriptors of images.

    Args:
        images: ``(N_i, 32)`` uint8 descriptors of each.
        branching, depth: of the tree.
        seed: of the starts of the clusters.

    Words weigh the logarithm of one over the part of the images that have them (smoothed: a weight of 0 would make
    ORB-SLAM ignore the features).

    Raises:
        DvoError: fewer descriptors than a tree needs.
    """
    everything = np.concatenate(images) if images else np.zeros((0, 32), np.uint8)
    if len(everything) < branching:
        raise DvoError(f"{len(everything)} descriptors are too few", field="--sequences", remedy="render more")
    rng = np.random.default_rng([seed, 7701])
    parents, centres = [0], [np.zeros(32, np.uint8)]
    level = [(0, np.arange(len(everything)))]
    for _ in range(depth):
        below = []
        for node, rows in level:
            if len(rows) > branching:
                found, member = majority_clusters(everything[rows], branching, rng)
                if len(found) < 2:
                    continue
                for k, centre in enumerate(found):
                    below.append((len(parents), rows[member == k]))
                    parents.append(node)
                    centres.append(centre)
        level = below
    tree = Vocabulary(branching, depth, np.array(parents), np.array(centres), np.zeros(len(parents)))
    if len(parents) == 1:
        raise DvoError("all descriptors are alike", field="--sequences", remedy="render more")
    have = np.zeros(len(parents))
    for descriptors in images:
        have[np.unique(tree.words(descriptors))] += 1
    tree.weights[tree.is_word] = np.log((1 + len(images)) / np.maximum(have, 1))[tree.is_word]
    return tree


def write_vocabulary(path: Path | str, vocabulary: Vocabulary) -> None:
    """Write DBoW2's text format (scoring L1, weighting tf-idf).

    Args:
        path: text file; its folder is made if needed.
        vocabulary: to write.

    Raises:
        DvoError: the file cannot be written.
    """
    lines = [f"{vocabulary.branching} {max(STATED_DEPTH, vocabulary.depth)}  0 0"]
    rows = zip(vocabulary.parents, vocabulary.is_word, vocabulary.descriptors, vocabulary.weights, strict=True)
    for parent, is_word, descriptor, weight in list(rows)[1:]:
        lines.append(f"{parent} {int(is_word)} {' '.join(map(str, descriptor))} {weight:.8g}")
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text("\n".join(lines) + "\n", encoding="ascii")
    except OSError as error:
        raise DvoError(str(error.strerror), file=path, field="--out", remedy="give another file") from error


def read_vocabulary(path: Path | str) -> Vocabulary:
    """Read DBoW2's text format.

    Args:
        path: text file, see :func:`write_vocabulary`.

    Returns:
        The tree; its depth is the one that the file states.

    Raises:
        DvoError: no such file, or another content.
    """
    try:
        with Path(path).open(encoding="ascii") as file:
            branching, depth = (int(word) for word in file.readline().split()[:2])
            rows = np.loadtxt(file, ndmin=2)
        if rows.shape[1:] != (35,) or not (rows[:, 0] < np.arange(1, len(rows) + 1)).all() or (rows[:, 0] < 0).any():
            raise ValueError("rows of a tree have 35 numbers, and parents before their children")
    except (OSError, ValueError) as error:
        raise DvoError(str(error), file=path, remedy="give a vocabulary in the text format of DBoW2") from error
    root = np.zeros((1, 35))
    rows = np.concatenate([root, rows])
    return Vocabulary(branching, depth, rows[:, 0].astype(int), rows[:, 2:34].astype(np.uint8), rows[:, 34])


def rendered_descriptors(sequences: int, frames: int, features: int, seed: int) -> Iterator[np.ndarray]:
    """ORB descriptors ``(N, 32)`` of pictures 640x480, a few seconds apart, of rendered sequences of all families.

    Args:
        sequences, frames: rendered sequences, and pictures of each.
        features: most descriptors of a picture.
        seed: of the renderings.
    """
    from dvo.synth.sequence import make_sequence

    orb = cv2.ORB_create(features, fastThreshold=7)  # type: ignore[attr-defined]
    for number in range(sequences):
        film = make_sequence(FIRST_SEED + 1000 * seed + number, frames=4 * frames, height=480, width=640, fps=2.0)
        for index in range(0, 4 * frames, 4):
            grey = cv2.cvtColor(film.frame(index).image, cv2.COLOR_RGB2GRAY)
            descriptors = orb.detectAndCompute(grey, None)[1]
            if descriptors is not None:
                yield descriptors


def train_on_renderings(out: Path, *, sequences: int = 60, frames: int = 5, features: int = 1000, branching: int = 10,
                        depth: int = 4, seed: int = 0) -> str:  # fmt: skip
    """Train a vocabulary on rendered pictures and write it.

    Args:
        out: text file.
        sequences, frames, features: rendered sequences, pictures of each, descriptors of each picture.
        branching, depth: see :func:`train`.
        seed: of renderings and clusters.

    Returns:
        A sentence on what was written.

    Raises:
        DvoError: a number that is too small, too few descriptors, or a file that cannot be written.
    """
    given = {"sequences": sequences, "frames": frames, "features": features, "branching": branching, "depth": depth}
    for name, least in LEAST.items():
        if given[name] < least:
            raise DvoError(f"must be {least} or more", field=f"--{name}", remedy="give a larger number")
    images = list(rendered_descriptors(sequences, frames, features, seed))
    vocabulary = train(images, branching, depth, seed)
    write_vocabulary(out, vocabulary)
    used = sum(len(image) for image in images)
    return f"{out}: {int(vocabulary.is_word.sum())} words from {used} descriptors of {len(images)} pictures"
