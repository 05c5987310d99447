"""Index of places: descriptors of keyframes, searched for those that may show what a new image shows.

A descriptor is a unit vector, made from the features of the tracker's network by
``dvo/odometry/loops/place_descriptors.py``; the score of two images is their inner product. The index answers with a
few candidates, which a geometric check accepts or rejects.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dvo.core.errors import DvoError

LARGEST = 1.01
"""Norm of a descriptor above which it is no unit vector; float16 rounds by less."""


class Candidates(NamedTuple):
    """Keyframes that may show the same place, the best first.

    Attributes:
        identifiers: ``(k,)`` int64.
        scores: ``(k,)`` float32 inner products, at most 1.
    """

    identifiers: np.ndarray
    scores: np.ndarray


class PlaceIndex:
    """Descriptors of keyframes in bounded memory, in float16.

    A full index drops the keyframe that is most like the one before it, so that it becomes sparser where the camera
    stood or moved slowly, and no part of the way is forgotten.

    Args:
        dimensions: of a descriptor.
        capacity: largest number of keyframes.

    Raises:
        DvoError: a number below 1, or a capacity below 2.

    Example:
        >>> index = PlaceIndex(dimensions=2)
        >>> index.add(7, np.array([0.6, 0.8]))
        >>> index.query(np.array([0.0, 1.0]), count=3).identifiers.tolist()
        [7]
    """

    def __init__(self, dimensions: int, capacity: int = 20_000) -> None:
        if dimensions < 1 or capacity < 2:
            raise DvoError("out of range", field="dimensions, capacity", remedy="give 1 or more, and 2 or more")
        self.dimensions, self.capacity = dimensions, capacity
        self._identifiers = np.zeros(0, np.int64)  # increasing; only the first _count rows of the arrays are in use
        self._descriptors = np.zeros((0, dimensions), np.float16)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __contains__(self, identifier: object) -> bool:
        return identifier in self.identifiers

    @property
    def identifiers(self) -> np.ndarray:
        """Identifiers ``(n,)`` of the keyframes, increasing."""
        return self._identifiers[: self._count]

    @property
    def nbytes(self) -> int:
        """Memory of the keyframes that are kept."""
        return self._count * (self.dimensions * self._descriptors.itemsize + self._identifiers.itemsize)

    def add(self, identifier: int, descriptor: np.ndarray) -> None:
        """Add a keyframe, or replace the one of the same identifier.

        Args:
            identifier: of the keyframe.
            descriptor: ``(dimensions,)`` unit vector; zeros for an image without content.

        Raises:
            DvoError: a vector of another length, longer than a unit vector, or not finite.
        """
        row = self._checked(descriptor).astype(np.float16)
        at = int(np.searchsorted(self.identifiers, identifier))
        if at < self._count and self._identifiers[at] == identifier:
            self._descriptors[at] = row
            return
        self._reserve()
        for array, value in ((self._identifiers, identifier), (self._descriptors, row)):
            array[at + 1 : self._count + 1] = array[at : self._count]
            array[at] = value
        self._count += 1
        if self._count > self.capacity:
            self._delete(self._most_redundant())

    def remove(self, identifier: int) -> None:
        """Remove a keyframe; nothing happens if it is not there.

        Args:
            identifier: of the keyframe.
        """
        at = int(np.searchsorted(self.identifiers, identifier))
        if at < self._count and self._identifiers[at] == identifier:
            self._delete(at)

    def descriptor(self, identifier: int) -> np.ndarray | None:
        """Descriptor of a keyframe.

        Args:
            identifier: of the keyframe.

        Returns:
            ``(dimensions,)`` float32, as it is kept; None if the keyframe is not there.
        """
        at = int(np.searchsorted(self.identifiers, identifier))
        here = at < self._count and self._identifiers[at] == identifier
        return self._descriptors[at].astype(np.float32) if here else None

    def query(self, descriptor: np.ndarray, count: int = 5, *, before: int | None = None, apart: int = 0) -> Candidates:
        """Find the keyframes whose descriptors are most like that of an image.

        Args:
            descriptor: ``(dimensions,)`` unit vector, or ``(views, dimensions)`` of the image as it would look from
                neighbouring viewpoints (``PlaceDescriptor.views``), of which the best counts.
            count: largest number of candidates.
            before: only keyframes with a smaller identifier; None for all.
            apart: identifiers of two candidates differ by more than this, so that they are not all of one place.

        Returns:
            The candidates by falling score, those of equal score by identifier.

        Raises:
            DvoError: as :meth:`add`.
        """
        views = np.stack([self._checked(view) for view in np.atleast_2d(descriptor)], 1)
        known = self._count if before is None else int(np.searchsorted(self.identifiers, before))
        identifiers = self._identifiers[:known]
        # Sums of equal rows may differ in their last bits by their place in the array.
        scores = np.round(self._descriptors[:known].astype(np.float32) @ views, 5).max(1)
        chosen: list[int] = []
        for row in np.lexsort((identifiers, -scores)):
            if len(chosen) >= count:
                break
            if all(abs(identifiers[row] - identifiers[other]) > apart for other in chosen):
                chosen.append(int(row))
        return Candidates(identifiers[chosen].copy(), scores[chosen])

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Content for a file.

        Returns:
            ``identifiers`` (n,) int64, ``descriptors`` (n, dimensions) float16 and ``capacity`` () int64.
        """
        return {
            "identifiers": self.identifiers.copy(),
            "descriptors": self._descriptors[: self._count].copy(),
            "capacity": np.array(self.capacity, np.int64),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> PlaceIndex:
        """Restore an index.

        Args:
            arrays: of :meth:`to_arrays`.

        Returns:
            The index; it answers every query as the saved one does.

        Raises:
            DvoError: arrays that are missing or do not belong together, or identifiers that do not increase.
        """
        try:
            identifiers, descriptors, capacity = (arrays[k] for k in ("identifiers", "descriptors", "capacity"))
        except KeyError as error:
            raise DvoError("missing", field=str(error.args[0]), remedy="give the arrays of to_arrays") from error
        fits = descriptors.ndim == 2 and identifiers.shape == descriptors.shape[:1] and len(identifiers) <= capacity
        if not fits or not (np.diff(identifiers) > 0).all() or not np.isfinite(descriptors).all():
            raise DvoError("no index of places", field="descriptors", remedy="give the arrays of to_arrays")
        index = cls(descriptors.shape[1], int(capacity))
        index._identifiers, index._descriptors = identifiers.astype(np.int64), descriptors.astype(np.float16)
        index._count = len(identifiers)
        return index

    def _checked(self, descriptor: np.ndarray) -> np.ndarray:
        vector = np.asarray(descriptor, np.float32)
        norm = float(np.linalg.norm(vector))
        if vector.shape != (self.dimensions,) or not norm <= LARGEST:  # NaN fails too
            problem = f"shape {vector.shape}, norm {norm:.3g}"
            raise DvoError(problem, field="descriptor", remedy=f"give a unit vector of {self.dimensions} numbers")
        return vector

    def _reserve(self) -> None:
        """Room for one more row."""
        if self._count == len(self._identifiers):
            rows = min(max(64, 2 * self._count), self.capacity + 1)
            identifiers, descriptors = np.zeros(rows, np.int64), np.zeros((rows, self.dimensions), np.float16)
            identifiers[: self._count] = self.identifiers
            descriptors[: self._count] = self._descriptors[: self._count]
            self._identifiers, self._descriptors = identifiers, descriptors

    def _most_redundant(self) -> int:
        """Row that is most like the one before it; never the first nor the last."""
        rows = self._descriptors[: self._count].astype(np.float32)
        return 1 + int(np.round((rows[1:-1] * rows[:-2]).sum(1), 5).argmax())

    def _delete(self, at: int) -> None:
        for array in (self._identifiers, self._descriptors):
            array[at : self._count - 1] = array[at + 1 : self._count]
        self._count -= 1
