"""Live frames: a thread takes frames as they arrive, and what is too old to be tracked is dropped."""

from __future__ import annotations

import math
import os
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from numbers import Real
from types import GeneratorType
from typing import Any, Generic, TypeVar, cast

from dvo.core.arguments import checked_arguments
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory

T = TypeVar("T")

JOIN_TIMEOUT = 0.5
"""Seconds to wait for the thread at the end; one that hangs in a driver dies with the process."""
LONGEST = 1_000_000
"""Longest queue, frames."""
_SLOW = 0.25  # of the frames that are tracked: below it, a camera may move on too far between them
_CHECK = 1.0  # seconds after which a waiting consumer looks again, see LiveFrames._wait


@dataclass
class StreamCounts:
    """Frames of a live stream, counted from the first iteration on; updated while it runs.

    Attributes:
        received: frames that have arrived.
        dropped: of these, frames that were never processed.
    """

    received: int = 0
    dropped: int = 0


@dataclass(frozen=True)
class Reception:
    """What was received since the element before one.

    Attributes:
        dropped: elements between them, which were dropped.
        silence: longest time in which none was received, seconds, by the times of the elements (``timestamp``, or the
            first of a pair), or else of their arrival.
    """

    dropped: int = 0
    silence: float = 0.0

    def then(self, silence: float, dropped: int = 0) -> Reception:
        """After more of them.

        Args:
            silence: seconds before the next element.
            dropped: how many are dropped.
        """
        return Reception(self.dropped + dropped, max(self.silence, silence))


NOTHING = Reception()


@dataclass(frozen=True)
class _Entry(Generic[T]):
    item: T
    silence: float  # since the element received before it


@dataclass(eq=False)
class _Queue(Generic[T]):
    """What the thread and the consumer share. The thread refers to nothing else, so that it does not keep the
    :class:`LiveFrames` alive.

    Attributes:
        size: elements that may wait.
        drop: drop the oldest waiting element if it is full; otherwise wait.
        interrupt: ends a read that blocks.
        counts: received and dropped elements.
        changed: its lock is reentrant, so that a signal handler, or a finaliser, may call ``stop`` while its thread
            holds it.
        ended, stopping: the thread has ended; it shall end.
        error: that ended the thread.
        process: that the thread runs in; None before its start.
        since: what was received, and not taken, since the element that was taken last.
    """

    size: int
    drop: bool
    interrupt: Callable[[], object] | None
    counts: StreamCounts = field(default_factory=StreamCounts)
    changed: threading.Condition = field(default_factory=threading.Condition)
    waiting: deque[_Entry[T]] = field(init=False)
    since: Reception = NOTHING
    ended: bool = False
    stopping: bool = False
    error: Exception | None = None
    process: int | None = None
    _received: float | None = None  # time of the last element

    def __post_init__(self) -> None:
        self.waiting = deque()

    @property
    def is_elsewhere(self) -> bool:
        """The thread is one of the process that this one was forked from; it may have held the lock then."""
        return self.process not in (None, os.getpid())

    def stop(self) -> None:
        """End the thread as soon as possible; what waits is dropped."""
        if self.is_elsewhere:
            return
        with self.changed:
            # The lock of an event is not reentrant: a signal handler must not set it while this thread does.
            is_first, self.stopping = not self.stopping, True
            self.counts.dropped += len(self.waiting)
            self.waiting.clear()
            self.changed.notify_all()
        if is_first and self.interrupt is not None:
            self.interrupt()

    def put(self, item: T) -> bool:
        """Add an element; False if nobody wants one any more."""
        with self.changed:
            while not self.drop and len(self.waiting) >= self.size and not self.stopping:
                self.changed.wait()
            if self.stopping:
                return False
            self.counts.received += 1
            seconds = _seconds(item)
            silence = 0.0 if self._received is None else max(seconds - self._received, 0.0)
            self._received = seconds
            if len(self.waiting) >= self.size:
                self.counts.dropped += 1
                self.since = self.since.then(self.waiting.popleft().silence, dropped=1)
            self.waiting.append(_Entry(item, silence))
            self.changed.notify_all()
            return True

    def take(self) -> tuple[T, Reception]:
        """Take the oldest element, with the lock held.

        Raises:
            IndexError: there is none.
        """
        entry = self.waiting.popleft()
        since, self.since = self.since.then(entry.silence), NOTHING
        self.changed.notify_all()
        return entry.item, since

    def read(self, frames: Iterable[T]) -> None:
        """Body of the thread."""
        error: Exception | None = None
        try:
            for item in frames:
                if not self.put(item):
                    break
            if isinstance(frames, GeneratorType):
                frames.close()
        except Exception as caught:  # whatever it is, also of the generator's end, the consumer gets it
            error = caught
        finally:
            with self.changed:
                self.error, self.ended = error, True
                self.changed.notify_all()


def _seconds(item: Any) -> float:
    """Time of an element: its own, or else that of its arrival."""
    own = item[0] if isinstance(item, tuple) and len(item) == 2 else getattr(item, "timestamp", None)
    if isinstance(own, Real) and math.isfinite(own):
        return float(own)
    return time.monotonic()


class LiveFrames(Generic[T]):
    """Elements of a stream for a consumer that may be slower than the stream.

    A thread of its own reads ``frames`` without a pause, and puts them into a queue. If the queue is full, the oldest
    element in it is dropped: the newest is always kept, and the consumer is never more than ``queue`` elements behind.
    With ``drop=False`` the thread waits instead, and every element is processed. Neither side polls. A
    :class:`dvo.Frame` behind dropped ones says so (``silence``), and so do those that :func:`dvo.stream` makes: where
    frames were received there is no gap in time.

    An error of ``frames`` is raised in the consumer, after the elements before it. It can be iterated once; the end of
    the iteration, or leaving it early, ends the thread, and so does the last reference to it and its iterator. A
    generator given as ``frames`` is closed in its thread. A forked process has no such thread: reading there is an
    error.

    Args:
        frames: frames, or anything else, for instance pairs ``(time.monotonic(), image)`` for :func:`dvo.stream`. Only
            the thread touches it.
        queue: elements that may wait.
        drop: drop the oldest waiting element if the queue is full; otherwise wait.
        name: for messages and the results folder.
        groundtruth: camera-to-world poses on the clock of the frames.
        interrupt: ends a read of ``frames`` that blocks; called by :meth:`stop`, maybe in a signal handler.

    Attributes:
        name, groundtruth: as given.
        kind: ``"stream"``.
        frame_count: None, the number is not known.
        counts: received and dropped elements.
        reception: what was received since the element before the one that the iteration has given last.

    Raises:
        DvoError: a queue of less than one element.

    Example:
        >>> live = dvo.LiveFrames(iter(range(5)), drop=False)
        >>> list(live), live.counts
        ([0, 1, 2, 3, 4], StreamCounts(received=5, dropped=0))
    """

    kind = "stream"
    frame_count: int | None = None

    @checked_arguments
    def __init__(
        self,
        frames: Iterable[T],
        queue: int = 1,
        *,
        drop: bool = True,
        name: str = "stream",
        groundtruth: Trajectory | None = None,
        interrupt: Callable[[], object] | None = None,
    ) -> None:
        if not 1 <= queue <= LONGEST:
            message = f"must be 1 or more, and {LONGEST} at most, got {queue}"
            raise DvoError(message, field="queue", remedy="give a whole number of frames")
        self.name, self.groundtruth = name, groundtruth
        self._frames, self._queue = frames, _Queue[T](queue, drop, interrupt)
        self._thread: threading.Thread | None = None
        self._iterated = False
        self.reception = NOTHING
        # It asks the thread to end, and does not wait for that: it may run in any thread, whatever this one holds.
        weakref.finalize(self, self._queue.stop).atexit = False

    @property
    def counts(self) -> StreamCounts:
        """Received and dropped elements."""
        return self._queue.counts

    @property
    def warnings(self) -> list[str]:
        """Faults so far, a sentence each."""
        received, dropped = self.counts.received, self.counts.dropped
        if not (self._iterated and dropped):
            return []
        is_fast = received - dropped < _SLOW * received
        remedy = ": --preset fast, smaller images or a slower camera help" if is_fast else ""
        return [f"{dropped} of {received} frames were dropped, the stream is faster than tracking{remedy}"]

    def start(self) -> None:
        """Begin to read; otherwise the iteration does. What is dropped before the iteration is not counted.

        Raises:
            DvoError: a process that was forked while the stream was being read.
        """
        self._check_process()
        with self._queue.changed:
            if self._thread is None and not self._queue.stopping:
                self._queue.process = os.getpid()
                self._thread = threading.Thread(
                    target=self._queue.read, args=(self._frames,), name=f"dvo stream {self.name}", daemon=True
                )
                self._thread.start()

    def peek(self, timeout: float | None = None) -> T:
        """Wait for an element and look at it; it stays in the queue.

        Args:
            timeout: seconds; None for any time.

        Raises:
            DvoError: the stream has ended, or there is nothing in time; any error of the stream.
        """
        self.start()
        with self._queue.changed:
            in_time = self._wait(timeout)
            if self._queue.waiting:
                return self._queue.waiting[0].item
            if self._queue.error is not None:
                raise self._queue.error
        problem = "ends without an image" if in_time else f"no image within {timeout:g} s"
        raise DvoError(problem, file=self.name, remedy="check that the camera or the stream is on")

    def skip(self, item: T) -> None:
        """Take an element that :meth:`peek` has shown out of the queue, unless it has been dropped since.

        Args:
            item: the same object.
        """
        with self._queue.changed:
            if self._queue.waiting and self._queue.waiting[0].item is item:
                _, self._queue.since = self._queue.take()

    def __iter__(self) -> Iterator[T]:
        """Elements in order of arrival.

        Raises:
            DvoError: a second iteration; a process that was forked while the stream was being read.
        """
        self._check_process()
        if self._iterated:
            raise DvoError("a stream can be read only once", file=self.name, remedy="open it anew")
        self._iterated = True
        with self._queue.changed:
            self.counts.received, self.counts.dropped = len(self._queue.waiting), 0
        self.start()
        return self._take_all()

    def stop(self) -> None:
        """End the iteration as soon as possible; what waits is dropped. May be called from any thread, and in a signal
        handler."""
        self._queue.stop()

    def close(self) -> None:
        """Stop, and wait for the end of the thread."""
        self.stop()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(JOIN_TIMEOUT)

    def __enter__(self) -> LiveFrames[T]:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take_all(self) -> Iterator[T]:
        try:
            while True:
                self._check_process()
                with self._queue.changed:
                    self._wait(None)
                    if not self._queue.waiting:
                        error, self._queue.error = self._queue.error, None
                        if error is not None and not self._queue.stopping:
                            raise error
                        return
                    try:
                        item, self.reception = self._queue.take()
                    except IndexError:  # a signal handler has called stop since the line above
                        return
                if isinstance(item, Frame) and self.reception.dropped:
                    item = cast(T, item.with_silence(max(self.reception.silence, item.silence or 0.0)))
                yield item
        finally:
            self.close()

    def _check_process(self) -> None:
        """Raise DvoError where the thread cannot be waited for."""
        if self._queue.is_elsewhere:
            remedy = "open the stream in the process that reads it"
            raise DvoError(
                "is read by a thread of the process that this one was forked from", file=self.name, remedy=remedy
            )

    def _wait(self, timeout: float | None) -> bool:
        """Wait, with the lock held, for an element or the end; False if there is neither in time."""
        # A signal handler that calls stop between the test and the wait wakes nobody: hence the second look.
        done = lambda: bool(self._queue.waiting) or self._queue.ended or self._queue.stopping  # noqa: E731
        if timeout is not None:
            return self._queue.changed.wait_for(done, timeout)
        while not self._queue.changed.wait_for(done, _CHECK):
            pass
        return True
