"""Descriptors that are compared: the default one of the library, and two that it does without.

A method describes an image (an entry of its index), scores one image against many entries, and says how many bytes it
takes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from torch import Tensor

from dvo.odometry.loops.place_descriptors import SHIPPED, load_descriptor
from eval.systems.peers.vocabulary import Vocabulary, read_vocabulary

FEATURES = 500
"""Most ORB features of an image."""
SAMPLES = 150
"""Features of a training picture that the centroids of VLAD are fitted to."""


class Method(NamedTuple):
    """One way of recognition.

    Attributes:
        name: for the table.
        describe: entry of an image ``(H, W, 3)`` with its matching features ``(1, 1, C, h, w)``.
        score: similarity ``(n,)`` of an entry with ``n`` entries.
        size: bytes of an entry.
        shipped: bytes of its files.
    """

    name: str
    describe: Callable[[np.ndarray, Tensor], Any]
    score: Callable[[Any, Sequence[Any]], np.ndarray]
    size: Callable[[Any], int]
    shipped: int


def _vector_bytes(entry: np.ndarray) -> int:
    return 2 * entry.size  # float16 in the index


def _stored(entries: Sequence[np.ndarray]) -> np.ndarray:
    return np.stack(entries).astype(np.float16).astype(np.float32)


def grid_method(shifted: bool) -> Method:
    """The default descriptor.

    Args:
        shifted: search with the views that are shifted by a column, too.
    """
    descriptor = load_descriptor()

    def score(query: np.ndarray, entries: Sequence[np.ndarray]) -> np.ndarray:
        views = descriptor.views(query) if shifted else query[None]
        return (_stored(entries) @ views.T).max(1)

    name = descriptor.name + (", shifted views" if shifted else "")
    return Method(name, descriptor, score, _vector_bytes, SHIPPED.stat().st_size)


@dataclass(frozen=True)
class Vlad:
    """Vector of locally aggregated descriptors (Jegou et al., CVPR 2010) of the matching features.

    Residuals of unit features to their nearest centroid are summed by centroid; every sum is made a unit vector
    (intra-normalisation, Arandjelovic and Zisserman, CVPR 2013), entries are replaced by signed square roots, and the
    whole is projected by whitening.

    Attributes:
        centroids: ``(K, C)``.
        mean: ``(K C,)``.
        projection: ``(K C, D)``.
    """

    centroids: np.ndarray
    mean: np.ndarray
    projection: np.ndarray

    def __call__(self, image: np.ndarray, maps: Tensor) -> np.ndarray:
        """``(D,)`` unit vector of ``(1, 1, C, h, w)`` features."""
        return _unit((aggregate(local_features(maps), self.centroids) - self.mean) @ self.projection)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def local_features(maps: Tensor) -> np.ndarray:
    """Unit features ``(n, C)`` of every other row and column of ``(1, 1, C, h, w)``."""
    return _unit(maps[0, 0, :, ::2, ::2].flatten(1).T.float().cpu().numpy())


def aggregate(features: np.ndarray, centroids: np.ndarray) -> np.ndarray:
    """VLAD ``(K C,)`` of features ``(n, C)``, before the projection."""
    nearest = ((centroids**2).sum(1) - 2 * features @ centroids.T).argmin(1)
    member = np.zeros((len(features), len(centroids)), np.float32)
    member[np.arange(len(features)), nearest] = 1
    sums = _unit(member.T @ features - member.sum(0)[:, None] * centroids).ravel()
    return _unit(np.sign(sums) * np.sqrt(np.abs(sums)))


def fit_vlad(maps: Iterator[Tensor], centroids: int = 32, dimensions: int = 256, seed: int = 0) -> Vlad:
    """Fit centroids (k-means), mean and projection (principal directions over the fourth root of their variance).

    Args:
        maps: ``(1, 1, C, h, w)`` of training pictures.
        centroids, dimensions: K and D.
        seed: of the start and of the features that are drawn.
    """
    rng = np.random.default_rng([seed, 7702])
    pictures = [local_features(one).astype(np.float16) for one in maps]
    drawn = np.concatenate([p[rng.choice(len(p), min(SAMPLES, len(p)), replace=False)] for p in pictures])
    drawn = drawn.astype(np.float32)
    centres = drawn[rng.choice(len(drawn), centroids, replace=False)]
    for _ in range(15):
        nearest = ((centres**2).sum(1) - 2 * drawn @ centres.T).argmin(1)
        centres = np.stack([drawn[nearest == k].mean(0) if (nearest == k).any() else c for k, c in enumerate(centres)])
    vectors = np.stack([aggregate(p.astype(np.float32), centres) for p in pictures])
    mean = vectors.mean(0)
    _, singular, directions = np.linalg.svd(vectors - mean, full_matrices=False)
    kept = min(dimensions, int((singular > 1e-3 * singular[0]).sum()))
    variances = singular[:kept] ** 2 / len(vectors)
    return Vlad(centres, mean, (directions[:kept] / variances[:, None] ** 0.25).T)


def vlad_method(fitted: Vlad) -> Method:
    """VLAD.

    Args:
        fitted: centroids and projection.
    """
    shipped = 2 * (fitted.centroids.size + fitted.mean.size + fitted.projection.size)  # as float16
    name = f"VLAD {len(fitted.centroids)}, {fitted.projection.shape[1]} dimensions"
    return Method(name, fitted, lambda query, entries: _stored(entries) @ query, _vector_bytes, shipped)


def bag_of_words(image: np.ndarray, maps: Tensor | None, vocabulary: Vocabulary) -> dict[int, float]:
    """Weights (tf-idf, of sum 1) of the ORB words of an image (Galvez-Lopez and Tardos, T-RO 2012).

    Args:
        image: ``(H, W, 3)`` uint8 RGB.
        maps: not used.
        vocabulary: tree of words.
    """
    orb = cv2.ORB_create(FEATURES, fastThreshold=7)  # type: ignore[attr-defined]
    descriptors = orb.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)[1]
    if descriptors is None:
        return {}
    words, counts = np.unique(vocabulary.words(descriptors), return_counts=True)
    weights = counts * vocabulary.weights[words]
    return dict(zip(words.tolist(), (weights / max(weights.sum(), 1e-9)).tolist(), strict=True))


def score_words(query: dict[int, float], entries: Sequence[dict[int, float]]) -> np.ndarray:
    """One less half of the L1 distance, which is the sum of the smaller weights of the words in common."""
    return np.array([sum(min(w, entry[word]) for word, w in query.items() if word in entry) for entry in entries])


def orb_method(file: Path) -> Method:
    """Bag of ORB words.

    Args:
        file: vocabulary in the text format of DBoW2.

    Raises:
        DvoError: a file that is no vocabulary.
    """
    vocabulary = read_vocabulary(file)
    describe = partial(bag_of_words, vocabulary=vocabulary)
    shipped = vocabulary.descriptors.nbytes + 6 * len(vocabulary.parents)  # parents as int32, weights as float16
    name = f"ORB, {int(vocabulary.is_word.sum())} words"
    return Method(name, describe, score_words, lambda entry: 6 * len(entry), shipped)  # word int32, weight float16
