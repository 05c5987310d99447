"""Memory of the process: settings of the allocator and of the garbage collector, and pages that are given back."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import sys
from collections.abc import Iterator
from functools import cache
from typing import Any

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4


def reuse_freed_memory() -> bool:
    """Configure glibc's malloc to reuse freed memory instead of returning it to the system.

    By default every tensor above some megabytes is a new memory mapping whose pages are zeroed by the kernel, which
    takes longer than much of the arithmetic on it. Systems without glibc are left unchanged.

    Returns:
        True if the allocator was configured.
    """
    mallopt = _of_glibc("mallopt")
    return mallopt is not None and bool(mallopt(_MMAP_MAX, 0) and mallopt(_TRIM_THRESHOLD, 2**31 - 1))


def release_free_memory() -> bool:
    """Return unused pages of the heap to the system. Values are not affected.

    Tracking allocates and frees temporary tensors of many sizes. Between them, on the same heap, lie features that stay
    for some frames. The C library extends its heap when no gap fits, and returns memory only from the end: the resident
    memory of a long sequence grows by several times what is kept of it, although the memory in use does not. Takes
    some milliseconds, and as much again until the pages that are needed are there again.

    Returns:
        True if there were any; False too where the C library is not glibc.
    """
    trim = _of_glibc("malloc_trim")
    return trim is not None and bool(trim(0))


@cache
def _of_glibc(name: str) -> Any:
    """Function of the C library, None where that is not glibc."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        return getattr(ctypes.CDLL("libc.so.6"), name)
    except (OSError, AttributeError):  # another C library, for instance musl
        return None


@contextlib.contextmanager
def without_old_garbage() -> Iterator[None]:
    """Have the garbage collector leave alone what there is already, for the time of a run.

    Modules and weights stay, and are so many objects that a collection that looks through them takes longer than a
    frame.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
