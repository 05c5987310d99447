"""Storage of long-lived arrays apart from the heap of the process.

Arrays that stay between temporary tensors of many sizes keep the heap from being reused: it grows by several times what
they take. Here they lie one after the other in memory mappings of their own.
"""

from __future__ import annotations

import mmap

import numpy as np

CHUNK = 2**18
"""Bytes of a mapping; larger arrays get one of their own."""
_ALIGNMENT = 64


class ArrayStorage:
    """Arrays in memory mappings, written one after the other.

    A mapping is returned to the system when the last array in it is gone. Use a storage of its own for what is released
    together.

    Args:
        chunk: bytes of a mapping.

    Example:
        >>> storage = ArrayStorage()
        >>> storage.keep(np.arange(3))
        array([0, 1, 2])
    """

    def __init__(self, chunk: int = CHUNK) -> None:
        self.chunk = chunk
        self._free = np.zeros(0, np.uint8)

    def keep(self, array: np.ndarray) -> np.ndarray:
        """Copy an array into the storage.

        Args:
            array: of numbers.

        Returns:
            The copy, C-contiguous and writable; an empty array itself.
        """
        if not array.nbytes:
            return array
        size = -(-array.nbytes // _ALIGNMENT) * _ALIGNMENT
        if size > self.chunk:
            room = _mapping(size)
        else:
            if size > len(self._free):
                self._free = _mapping(self.chunk)
            room, self._free = self._free[:size], self._free[size:]
        copy = room[: array.nbytes].view(array.dtype).reshape(array.shape)
        copy[...] = array
        return copy


def _mapping(size: int) -> np.ndarray:
    """New private mapping ``(size,)`` uint8, of zeros."""
    if hasattr(mmap, "MAP_PRIVATE"):
        return np.frombuffer(mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS), np.uint8)
    return np.frombuffer(mmap.mmap(-1, size), np.uint8)
