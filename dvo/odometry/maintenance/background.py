"""Work beside tracking: in one thread, in steps, some of which each frame takes, or in both ways at once."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Generic, TypeVar

import torch

from dvo.core.errors import DvoError

T = TypeVar("T")

# Added to that of the process. More than a little would starve the thread beside other busy processes, and tracking,
# which waits for its results, with it; without privileges a priority that was lowered cannot be raised again.
_NICE = 5


class Task(Generic[T]):
    """Work whose result is there, or will be.

    Args:
        outcome: of the work.
    """

    def __init__(self, outcome: Future[T]) -> None:
        self._outcome, self._process = outcome, os.getpid()

    @property
    def done(self) -> bool:
        """True if :meth:`result` returns, or raises, at once."""
        return self._outcome.done() or self._process != os.getpid()

    def withdraw(self) -> bool:
        """Take the work back; True if it has not begun, and never will."""
        return self._outcome.cancel()

    def result(self) -> T:
        """Result of the work, waited for if need be.

        Raises:
            DvoError: the work goes on in the process that this one was forked from.
            Exception: that ended the work.
        """
        if self._process != os.getpid() and not self._outcome.done():
            raise DvoError(
                "this process was forked while a thread worked for the map, which it does not have",
                field="fork",
                remedy="fork before the first frame, or build an odometry in each process",
            )
        return self._outcome.result()


class Steps(Generic[T]):
    """Work in steps, some of which each frame takes. Frames and steps are the same whatever else the machine does.

    Args:
        generator: takes a step up to each ``yield``, and returns the result.
    """

    def __init__(self, generator: Generator[None, None, T]) -> None:
        self._generator = generator
        self._outcome: list[T] = []  # empty until it is known

    @property
    def done(self) -> bool:
        """True if :meth:`result` returns at once."""
        return bool(self._outcome)

    def step(self) -> bool:
        """Take a step.

        Returns:
            True once all have been taken.
        """
        return bool(self._outcome) or self._next()

    def result(self) -> T:
        """Result of the work, for which steps that are missing are taken."""
        while not self._outcome:
            self._next()
        return self._outcome[0]

    def _next(self) -> bool:
        try:
            with torch.inference_mode():
                next(self._generator)
        except StopIteration as end:
            self._outcome.append(end.value)
        return bool(self._outcome)


def all_steps(generator: Generator[None, None, T]) -> T:
    """Take all steps of a work.

    Args:
        generator: see :class:`Steps`.

    Returns:
        Its result.
    """
    return Steps(generator).result()


class Background:
    """Thread that does one piece of work after the other, without gradients.

    What the work reads must not change meanwhile. The thread is started with the first work, and ends with the process
    or when nothing refers to it any more. It computes without further threads, which would take the cores that tracking
    waits for, and on Linux with a lower priority.
    """

    def __init__(self) -> None:
        self._executor: ThreadPoolExecutor | None = None
        self._process = 0  # that the thread runs in

    def start(self, work: Callable[[], T]) -> Task[T]:
        """Begin a piece of work.

        Args:
            work: called in the thread.
        """
        if self._executor is None or self._process != os.getpid():  # a forked process has none of the threads
            self._process = os.getpid()
            count = torch.get_num_threads()
            self._executor = ThreadPoolExecutor(1, "dvo-background")
            self._executor.submit(_give_way).result()
            torch.set_num_threads(count)  # of other threads that begin later
        return Task(self._executor.submit(_without_gradients, work))


class StepsAhead(Generic[T]):
    """Work in steps as :class:`Steps`, which a thread takes ahead of the frames: the same frame has the result.

    Args:
        generator: see :class:`Steps`; what it reads must not change meanwhile.
        background: its thread.
    """

    def __init__(self, generator: Generator[None, None, T], background: Background) -> None:
        self._generator = generator
        self._ahead, self._taken, self._ended = 0, 0, False  # steps by the thread, and by the frames
        self._changed = threading.Condition()
        self._task = background.start(self._work)

    @property
    def done(self) -> bool:
        """True if :meth:`result` returns at once."""
        return self._task.done

    def step(self) -> bool:
        """Take a step, which is waited for if the thread has not come to it.

        Returns:
            True once all have been taken.
        """
        self._taken += 1
        if not self._task.done:  # a forked process has no thread that would notify it
            with self._changed:
                self._changed.wait_for(lambda: self._ahead >= self._taken or self._ended)
        if self._ahead >= self._taken:
            return False
        self.result()  # raises what has ended the work
        return True

    def result(self) -> T:
        """Result of the work; see :meth:`Task.result`."""
        return self._task.result()

    def _work(self) -> T:
        try:
            while True:
                try:
                    next(self._generator)
                except StopIteration as end:
                    return end.value
                with self._changed:
                    self._ahead += 1
                    self._changed.notify()
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()


def _give_way() -> None:
    """Leave the cores to other threads, as far as the calling thread is concerned."""
    torch.get_num_threads()  # the first call in a thread sets the number of the process
    torch.set_num_threads(1)
    if sys.platform.startswith("linux"):  # elsewhere a priority is that of the whole process
        thread = threading.get_native_id()
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + _NICE)


def _without_gradients(work: Callable[[], T]) -> T:
    with torch.inference_mode():
        return work()
