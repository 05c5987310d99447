"""Settings of the memory: of the allocator for large tensors on the CPU, and of the garbage collector."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import sys
from collections.abc import Iterator

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4


def reuse_freed_memory() -> bool:
    """Configure glibc's malloc to reuse freed memory instead of returning it to the system.

    By default every tensor above some megabytes is a new memory mapping whose pages are zeroed by the kernel, which
    takes longer than much of the arithmetic on it. Systems without glibc are left unchanged.

    Returns:
        True if the allocator was configured.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_MMAP_MAX, 0) and mallopt(_TRIM_THRESHOLD, 2**31 - 1))


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
