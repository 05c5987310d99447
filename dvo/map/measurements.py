"""Measurements of a map: edges between keyframes as arrays, and packed for keeping; and depths by a sensor.

Most frames of a slow camera are dropped between two kept keyframes, and their measurements make up most of the memory
of a map. A packed edge takes 9 bytes in place of 22: edges are sorted by their two keyframes, which are stored once for
all of a pair, positions are rounded to 16 significant bits (0.001 feature pixels at 100) and weights to 4 (6 percent).

The inverse depth of a patch that a sensor has measured has the prior ``w (d - d_measured)^2`` with
``w = sigma^2 / var(d_measured)``: weights of bundle adjustment are confidences, of which 1 stands for the standard
deviation ``sigma`` in feature pixels. A Cauchy kernel takes the influence from depths of another surface, which a rough
registration gives near the edges of bodies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dvo.ba.factors import DepthPrior
from dvo.ba.kernels import Kernel
from dvo.ba.patch_problem import PatchProblem

SIGMA = 0.061
"""Standard deviation of a measurement of confidence 1 with the shipped weights, feature pixels (docs/precision.md)."""
DEPTH_KERNEL = Kernel("cauchy", SIGMA)
"""Robust kernel of measured depths: one standard deviation, as errors of depths have long tails."""

_PAIR = 10  # bytes of a pair of keyframes: two int32, and the uint16 number of its edges
_MAX_EDGES = 2**16 - 1  # edges of a pair
_LARGEST = 0xF7  # weight below infinity


@dataclass(frozen=True)
class ArchivedEdges:
    """Measurements between keyframes, one row an edge.

    Attributes:
        source: ``(E,)`` int32 identifier of the keyframe of the patch.
        patch: ``(E,)`` int16 index of the patch in it.
        target: ``(E,)`` int32 identifier of the keyframe in which it was measured.
        position: ``(E, 2)`` float32 measured position of the patch centre, feature-map pixels.
        weight: ``(E, 2)`` float16 confidence.
    """

    source: np.ndarray
    patch: np.ndarray
    target: np.ndarray
    position: np.ndarray
    weight: np.ndarray

    def __len__(self) -> int:
        return len(self.source)

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return sum(a.nbytes for a in (self.source, self.patch, self.target, self.position, self.weight))

    def select(self, rows: np.ndarray) -> ArchivedEdges:
        """Choose edges.

        Args:
            rows: ``(E,)`` bool, or indices.

        Returns:
            The chosen edges.
        """
        return ArchivedEdges(*(a[rows] for a in (self.source, self.patch, self.target, self.position, self.weight)))

    @classmethod
    def concatenate(cls, parts: list[ArchivedEdges]) -> ArchivedEdges:
        """Concatenate edges.

        Args:
            parts: any number of sets of edges.

        Returns:
            All edges, in order.
        """
        empty = (np.zeros(0, np.int32), np.zeros(0, np.int16), np.zeros(0, np.int32),
                 np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float16))  # fmt: skip
        columns = zip(empty, *((p.source, p.patch, p.target, p.position, p.weight) for p in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True)
class PackedEdges:
    """Edges in one array of bytes.

    :meth:`unpack` gives the same arrays each time, and packing these again gives the same bytes.

    Attributes:
        data: ``(n,)`` uint8: source and target of the pairs (int32), numbers of edges of the pairs (uint16), patches
            (one byte each, or two), upper three bytes of the float32 positions, weights (exponent and three bits of
            the mantissa of a float16 number, one byte).
        pairs: number of pairs of keyframes.
        edges: number of edges.
    """

    data: np.ndarray
    pairs: int
    edges: int

    def __len__(self) -> int:
        return self.edges

    @property
    def nbytes(self) -> int:
        """Memory of the array."""
        return self.data.nbytes

    def kept_by(self, keep: Callable[[np.ndarray], np.ndarray]) -> PackedEdges:
        """Copy with another array.

        Args:
            keep: copies an array, such as :meth:`dvo.map.archive.ArrayStorage.keep`.
        """
        return PackedEdges(keep(self.data), self.pairs, self.edges)

    def newest(self) -> np.ndarray:
        """Later keyframe of each pair.

        Returns:
            ``(P,)`` int32 identifiers.
        """
        return self._ends().max(1)

    def unpack(self, chosen: np.ndarray | None = None) -> ArchivedEdges:
        """Arrays of the edges, sorted by source and target.

        Args:
            chosen: ``(P,)`` bool, pairs whose edges are wanted; None for all.

        Returns:
            The edges, in arrays of their own.
        """
        ends, first, count = self._ends(), self.pairs * _PAIR, self.edges
        counts = self.data[8 * self.pairs : first].view(np.uint16)
        width = (len(self.data) - first) // count - 8 if count else 1
        patch = self.data[first : first + width * count].view(np.uint8 if width == 1 else np.int16).astype(np.int16)
        rest = self.data[first + width * count :]
        upper = rest[: 6 * count].reshape(count, 2, 3)
        wide = np.zeros((count, 2, 4), np.uint8)
        wide[..., 1:] = upper
        weight = (rest[6 * count :].reshape(count, 2).astype(np.uint16) << 7).view(np.float16)
        rows = np.repeat(ends, counts, axis=0)
        edges = ArchivedEdges(
            rows[:, 0].copy(), patch, rows[:, 1].copy(), wide.view("<f4")[..., 0].astype(np.float32), weight
        )
        return edges if chosen is None else edges.select(np.repeat(chosen, counts))

    def _ends(self) -> np.ndarray:
        """``(P, 2)`` int32 source and target of each pair."""
        return self.data[: 8 * self.pairs].view(np.int32).reshape(self.pairs, 2)


def pack_edges(edges: ArchivedEdges) -> PackedEdges:
    """Pack edges.

    Args:
        edges: finite positions, and weights that are not negative.

    Returns:
        The edges, sorted by source and target, rounded.
    """
    order = np.lexsort((edges.target, edges.source))
    edges = edges.select(order)
    count = len(edges)
    ends = np.stack([edges.source, edges.target], 1)
    changes = np.flatnonzero((ends[1:] != ends[:-1]).any(1)) + 1
    # A pair begins anew after as many edges as its counter holds.
    starts = np.union1d(changes, np.arange(0, count, _MAX_EDGES))
    counts = np.diff(np.append(starts, count)).astype(np.uint16)
    patch = edges.patch.astype(np.uint8) if edges.patch.max(initial=0) < 256 else edges.patch.astype(np.int16)
    bits = np.ascontiguousarray(edges.position, "<f4").view("<u4").astype(np.uint64) + 0x80  # rounds to nearest
    upper = bits.astype("<u4").view(np.uint8).reshape(count, 2, 4)[..., 1:]
    half = np.ascontiguousarray(edges.weight, np.float16).view(np.uint16)
    weight = ((half + np.uint16(0x40)) >> 7).clip(max=_LARGEST).astype(np.uint8)
    arrays = ends[starts].astype(np.int32), counts, patch, upper, weight
    data = np.concatenate([np.ascontiguousarray(array).reshape(-1).view(np.uint8) for array in arrays])
    return PackedEdges(data, len(starts), count)


def depth_factors(measured: Tensor | None) -> tuple[DepthPrior, ...]:
    """Priors of the patches whose depth was measured.

    Args:
        measured: ``(K, 2)`` inverse depths and weights, 0 for none; None without a depth camera.

    Returns:
        One factor of ``inverse_depths (1, K)``; none without measurements.
    """
    if measured is None:
        return ()
    index = (measured[:, 1] > 0).nonzero()[:, 0]
    if not len(index):
        return ()
    value, weight = measured[index].unbind(1)
    return (DepthPrior(value[None], weight[None], index, DEPTH_KERNEL),)


def measured_depths(problem: PatchProblem) -> Tensor | None:
    """What :func:`depth_factors` has made the priors of a problem of.

    Args:
        problem: one graph.

    Returns:
        ``(K, 2)`` inverse depths and weights, 0 for none; None without such priors.
    """
    found = None
    for prior in problem.factors:
        if isinstance(prior, DepthPrior) and prior.index is not None:
            found = torch.zeros(len(problem.patches), 2).to(prior.value) if found is None else found
            found[prior.index] = torch.stack([prior.value[0], prior.weight[0]], 1)
    return found
