"""Settings of the memory allocator for large tensors on the CPU."""

from __future__ import annotations

import ctypes
import sys

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
