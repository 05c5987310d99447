"""Limits of the system on this process: memory, threads, stack. What is too little is told before torch is imported.

Under a limit that is too low torch and its libraries end in a crash, or in an error of many lines. The numbers are of a
rendered clip of 320x240 pixels with the shipped weights (``dvo demo --frames 5`` with kernels compiled anew, under
``ulimit -v`` and ``-d``, torch 2.13 for the CPU); larger images need more, and end in an error that :func:`limit_error`
describes.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.core.text import first_line
from dvo.core.threads import CGROUPS, MEMBERSHIP, current_threads, group_folders

_MB = 2**20
_A_THREAD = 64  # MB of addresses for the stack and the allocator of a further thread
_STACK = 256 * 1024  # bytes

_NO_MEMORY = re.compile(
    r"(can't|cannot|unable to|failed to|could not) (allocate|mmap|map segment)|out of memory|insufficient memory"
    r"|not enough memory|bad_?alloc|DefaultCPUAllocator|memory allocation",
    re.IGNORECASE,
)
_NO_THREAD = re.compile(r"can't start new thread|thread creation failed|pthread_create", re.IGNORECASE)
_NO_SHARED = re.compile(r"shared memory|/dev/shm|unable to write to file </torch|shm_open|bus error", re.IGNORECASE)
_NO_HANDLE = re.compile(r"too many open files", re.IGNORECASE)


@dataclass(frozen=True)
class Needs:
    """Least memory of a command, MB.

    Attributes:
        addresses: of the address space (``ulimit -v``).
        data: of its writable part (``ulimit -d``).
        resident: of the machine (a control group).
    """

    addresses: int
    data: int
    resident: int


LOADING = Needs(880, 240, 256)
"""Of a command that imports torch."""
TRACKING = Needs(2200, 1150, 640)
"""Of a command that tracks images."""


def check_limits(needs: Needs, membership: Path = MEMBERSHIP, root: Path = CGROUPS) -> None:
    """Check that the limits on this process suffice.

    Args:
        needs: of the command.
        membership: file that lists the control groups of the process.
        root: folder of the control groups.

    Raises:
        DvoError: too little memory or stack, or no further threads, with the limit.
    """
    further = _A_THREAD * (current_threads().count - 1)
    found = [
        ("ulimit -v", _soft_limit("RLIMIT_AS"), needs.addresses + further),
        ("ulimit -d", _soft_limit("RLIMIT_DATA"), needs.data),
        ("memory limit of the control group", memory_of_group(membership, root), needs.resident),
    ]
    for name, limit, least in found:
        if limit is not None and limit < least * _MB:
            raise DvoError(
                f"{limit // _MB} MB of memory are allowed ({name}), at least {least} MB are needed",
                remedy="raise the limit" + (f": {name} unlimited" if name.startswith("ulimit") else ""),
            )
    stack = _soft_limit("RLIMIT_STACK")
    if stack is not None and stack < _STACK:
        message = f"a stack of {stack // 1024} kB is allowed (ulimit -s), at least {_STACK // 1024} kB are needed"
        raise DvoError(message, remedy="raise the limit: ulimit -s 8192")
    _check_threads(current_threads().count + 2)  # those of a stream and of a progress bar beside them


def memory_of_group(membership: Path, root: Path) -> int | None:
    """Memory that the control group of a process may use, bytes; None without a limit.

    Args:
        membership: file that lists the control groups of the process.
        root: folder of the control groups.
    """
    limits = []
    for folder, is_first in group_folders(membership, root, "memory"):
        try:
            text = (
                (folder / ("memory.limit_in_bytes" if is_first else "memory.max")).read_text(encoding="utf-8").strip()
            )
        except (OSError, UnicodeDecodeError):
            continue
        if text.isascii() and text.isdigit():
            limits.append(int(text))
    return min(limits, default=None)


def limit_error(error: BaseException, file: object | None = None) -> DvoError | None:
    """Describe an error whose cause is a limit of the system: memory, threads, shared memory, open files.

    Args:
        error: of Python or another library.
        file: that was read, if it is known.

    Returns:
        Exception to raise; None for an error of another kind.
    """
    if isinstance(error, DvoError):
        return None
    text = first_line(error)
    if isinstance(error, MemoryError) or _NO_MEMORY.search(str(error)):
        if type(error).__name__ == "OutOfMemoryError":  # torch's, of an accelerator
            return DvoError("the memory of the device does not suffice", remedy="give --device cpu, or smaller images")
        remedy = "raise the limit of memory (ulimit -v), end other programs, or give a smaller file or smaller images"
        return DvoError("the memory does not suffice", file=file, remedy=remedy)
    for pattern, message, remedy in (
        (_NO_THREAD, "no further thread can start", "raise the limit of processes (ulimit -u, or that of a container)"),
        (_NO_SHARED, f"shared memory does not suffice ({text})", "make space in /dev/shm, or use no worker processes"),
        (_NO_HANDLE, "too many open files", "raise the limit of open files: ulimit -n 1024"),
    ):  # fmt: skip
        if pattern.search(str(error)):
            return DvoError(message, file=file, remedy=remedy)
    return None


def _soft_limit(name: str) -> int | None:
    """Limit of the process in bytes; None for none, and on systems without such limits."""
    try:
        import resource
    except ImportError:
        return None
    number = getattr(resource, name, None)
    limit = resource.RLIM_INFINITY if number is None else resource.getrlimit(number)[0]
    return None if limit == resource.RLIM_INFINITY or limit < 0 else limit


def _check_threads(count: int) -> None:
    """Start as many threads at a time, and end them."""
    done, started = threading.Event(), []
    try:
        for thread in _waiting(done, count):
            thread.start()
            started.append(thread)
    except RuntimeError as error:
        raise limit_error(error) or error from error
    finally:
        done.set()
        for thread in started:
            thread.join()


def _waiting(done: threading.Event, count: int) -> Iterator[threading.Thread]:
    return (threading.Thread(target=done.wait, daemon=True) for _ in range(count))
