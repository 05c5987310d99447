"""A process of its own for a part of the study, so that its peak memory and processor time are its own."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable
from typing import Any

from dvo.core.errors import DvoError
from dvo.core.processes import die_with_parent
from dvo.core.text import print_line


def apart(function: Callable[..., None], *arguments: Any) -> None:
    """Call a function in a new process with one thread, which ends with this one.

    Args:
        function: of a module.
        arguments: for it.

    Raises:
        SystemExit: the process failed, and has printed the reason; with its code, or 1 if a signal ended it.
    """
    process = multiprocessing.get_context("spawn").Process(target=_run, args=(function, arguments), daemon=True)
    process.start()
    try:
        process.join()
    finally:
        if process.is_alive():
            process.terminate()
            process.join()
    if process.exitcode and process.exitcode < 0:
        print(f"error: signal {-process.exitcode} ended {function.__name__}; run it again to go on", file=sys.stderr)
    if process.exitcode:
        raise SystemExit(max(process.exitcode, 1))


def _run(function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    die_with_parent()  # states are written as a whole
    use_one_thread()
    try:
        function(*arguments)
    except DvoError as error:
        print_line(f"error: {error}", error=True)
        sys.exit(2)


def use_one_thread() -> None:
    """Restrict torch and OpenCV to one thread, and let the allocator reuse freed memory."""
    import cv2
    import torch

    from dvo.core.allocator import reuse_freed_memory

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    reuse_freed_memory()
