"""Live frames: a thread takes frames as they arrive, and what is too old to be tracked is dropped."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from types import GeneratorType
from typing import Generic, TypeVar

from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory

T = TypeVar("T")

JOIN_TIMEOUT = 2.0
"""Seconds to wait for the thread at the end; one that hangs in a driver dies with the process."""
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


class LiveFrames(Generic[T]):
    """Elements of a stream for a consumer that may be slower than the stream.

    A thread of its own reads ``frames`` without a pause, and puts them into a queue. If the queue is full, the oldest
    element in it is dropped: the newest is always kept, and the consumer is never more than ``queue`` elements behind.
    With ``drop=False`` the thread waits instead, and every element is processed. Neither side polls.

    An error of ``frames`` is raised in the consumer, after the elements before it. It can be iterated once; the end of
    the iteration, or leaving it early, ends the thread. A generator given as ``frames`` is closed in its thread.

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

    Raises:
        DvoError: a queue of less than one element.

    Example:
        >>> live = LiveFrames(iter(range(5)), drop=False)
        >>> list(live), live.counts
        ([0, 1, 2, 3, 4], StreamCounts(received=5, dropped=0))
    """

    kind = "stream"
    frame_count: int | None = None

    def __init__(
        self,
        frames: Iterable[T],
        queue: int = 2,
        *,
        drop: bool = True,
        name: str = "stream",
        groundtruth: Trajectory | None = None,
        interrupt: Callable[[], object] | None = None,
    ) -> None:
        if queue < 1:
            raise DvoError(f"must be 1 or more, got {queue}", field="queue", remedy="give a whole number of frames")
        self.name, self.groundtruth = name, groundtruth
        self.counts = StreamCounts()
        self._frames, self._queue, self._drop, self._interrupt = frames, queue, drop, interrupt
        # The lock of a condition is reentrant, so that a signal handler may call stop while its thread holds it.
        self._changed = threading.Condition()
        self._waiting: deque[T] = deque()
        self._thread: threading.Thread | None = None
        self._ended = self._stopping = self._iterated = False
        self._error: Exception | None = None

    @property
    def warnings(self) -> list[str]:
        """Faults so far, a sentence each."""
        received, dropped = self.counts.received, self.counts.dropped
        if not (self._iterated and dropped):
            return []
        return [f"{dropped} of {received} frames were dropped, the stream is faster than tracking"]

    def start(self) -> None:
        """Begin to read; otherwise the iteration does. What is dropped before the iteration is not counted."""
        with self._changed:
            if self._thread is None and not self._stopping:
                self._thread = threading.Thread(target=self._read, name=f"dvo stream {self.name}", daemon=True)
                self._thread.start()

    def peek(self, timeout: float | None = None) -> T:
        """Wait for an element and look at it; it stays in the queue.

        Args:
            timeout: seconds; None for any time.

        Raises:
            DvoError: the stream has ended, or there is nothing in time; any error of the stream.
        """
        self.start()
        with self._changed:
            in_time = self._wait(timeout)
            if self._waiting:
                return self._waiting[0]
            if self._error is not None:
                raise self._error
        problem = "ends without an image" if in_time else f"no image within {timeout:g} s"
        raise DvoError(problem, file=self.name, remedy="check that the camera or the stream is on")

    def skip(self, item: T) -> None:
        """Take an element that :meth:`peek` has shown out of the queue, unless it has been dropped since.

        Args:
            item: the same object.
        """
        with self._changed:
            if self._waiting and self._waiting[0] is item:
                self._waiting.popleft()
                self._changed.notify_all()

    def __iter__(self) -> Iterator[T]:
        """Elements in order of arrival.

        Raises:
            DvoError: a second iteration.
        """
        if self._iterated:
            raise DvoError("a stream can be read only once", file=self.name, remedy="open it anew")
        self._iterated = True
        with self._changed:
            self.counts.received, self.counts.dropped = len(self._waiting), 0
        self.start()
        return self._take_all()

    def stop(self) -> None:
        """End the iteration as soon as possible; what waits is dropped. May be called from any thread, and in a signal
        handler."""
        with self._changed:
            # The lock of an event is not reentrant: a signal handler must not set it while this thread does.
            is_first, self._stopping = not self._stopping, True
            self.counts.dropped += len(self._waiting)
            self._waiting.clear()
            self._changed.notify_all()
        if is_first and self._interrupt is not None:
            self._interrupt()

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
                with self._changed:
                    self._wait(None)
                    if not self._waiting:
                        error, self._error = self._error, None
                        if error is not None and not self._stopping:
                            raise error
                        return
                    try:
                        item = self._waiting.popleft()
                    except IndexError:  # a signal handler has called stop since the line above
                        return
                    self._changed.notify_all()
                yield item
        finally:
            self.close()

    def _wait(self, timeout: float | None) -> bool:
        """Wait, with the lock held, for an element or the end; False if there is neither in time."""
        # A signal handler that calls stop between the test and the wait wakes nobody: hence the second look.
        done = lambda: bool(self._waiting) or self._ended or self._stopping  # noqa: E731
        if timeout is not None:
            return self._changed.wait_for(done, timeout)
        while not self._changed.wait_for(done, _CHECK):
            pass
        return True

    def _read(self) -> None:
        """Body of the thread."""
        error: Exception | None = None
        try:
            for item in self._frames:
                if not self._put(item):
                    break
            if isinstance(self._frames, GeneratorType):
                self._frames.close()
        except Exception as caught:  # whatever it is, also of the generator's end, the consumer gets it
            error = caught
        finally:
            with self._changed:
                self._error, self._ended = error, True
                self._changed.notify_all()

    def _put(self, item: T) -> bool:
        """Add an element; False if nobody wants one any more."""
        with self._changed:
            while not self._drop and len(self._waiting) >= self._queue and not self._stopping:
                self._changed.wait()
            if self._stopping:
                return False
            self.counts.received += 1
            if len(self._waiting) >= self._queue:
                self._waiting.popleft()
                self.counts.dropped += 1
            self._waiting.append(item)
            self._changed.notify_all()
            return True
