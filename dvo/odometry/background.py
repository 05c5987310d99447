"""Work beside tracking, in one thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

import torch

T = TypeVar("T")


class Task(Generic[T]):
    """Work whose result is there, or will be.

    Args:
        outcome: of the work.
    """

    def __init__(self, outcome: Future[T]) -> None:
        self._outcome = outcome

    @classmethod
    def finished(cls, result: T) -> Task[T]:
        """Task with a result that is known already."""
        outcome: Future[T] = Future()
        outcome.set_result(result)
        return cls(outcome)

    @property
    def done(self) -> bool:
        """True if :meth:`result` returns at once."""
        return self._outcome.done()

    def result(self) -> T:
        """Result of the work, waited for if need be.

        Raises:
            Exception: that ended the work.
        """
        return self._outcome.result()


class Background:
    """Thread that does one piece of work after the other, without gradients.

    What the work reads must not change meanwhile. The thread is started with the first work, and ends with the process
    or when nothing refers to it any more.
    """

    def __init__(self) -> None:
        self._executor: ThreadPoolExecutor | None = None

    def start(self, work: Callable[[], T]) -> Task[T]:
        """Begin a piece of work.

        Args:
            work: called in the thread.
        """
        if self._executor is None:
            self._executor = ThreadPoolExecutor(1, "dvo-background")
        return Task(self._executor.submit(_without_gradients, work))


def _without_gradients(work: Callable[[], T]) -> T:
    with torch.inference_mode():
        return work()
