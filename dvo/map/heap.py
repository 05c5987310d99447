"""Release of heap memory that is free, but lies between memory in use.

Tracking allocates and frees temporary tensors of many sizes. Between them, on the same heap, lie features that stay for
some frames. The C library extends its heap when no gap fits, and returns memory only from the end: the resident memory
of a long sequence grows by several times what is kept of it, although the memory in use does not.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache


def release_free_memory() -> bool:
    """Return unused pages of the heap to the system. Values are not affected.

    Takes some milliseconds, and as much again until the pages that are needed are there again.

    Returns:
        True if there were any; False too where the C library is not glibc.
    """
    trim = _trim()
    return trim is not None and bool(trim(0))


@cache
def _trim() -> Callable[[int], int] | None:
    """``malloc_trim`` of glibc, None without it."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        return ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):  # another C library, for instance musl
        return None
