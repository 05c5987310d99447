import gc
import itertools
import os
import threading
import time

import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.streams.live import LiveFrames
from dvo.data.streams.streams import stream
from dvo.geometry.camera import Camera
from tests.support.forked import in_fork

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
LIMIT = 20.0  # seconds after which a wait has failed; none takes so long


def until(condition):
    """Wait until something is true that another thread does."""
    end = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.001)


def frame(index):
    return Frame(index, 0.1 * index, np.full((48, 64, 3), index, np.uint8), CAMERA)


def gone(name):
    return not [thread for thread in threading.enumerate() if name in thread.name]


def test_the_oldest_waiting_frames_are_dropped():
    """All arrive while the consumer is at its first one: it then gets the newest two."""
    more, sent = threading.Event(), threading.Event()

    def camera():
        yield 0
        more.wait(LIMIT)
        yield from range(1, 10)
        sent.set()

    live = LiveFrames(camera(), queue=2)
    found = iter(live)
    assert next(found) == 0
    more.set()
    assert sent.wait(LIMIT)
    until(lambda: live.counts.received == 10)
    assert list(found) == [8, 9]
    assert (live.counts.received, live.counts.dropped) == (10, 7)
    assert live.warnings == ["7 of 10 frames were dropped, the stream is faster than tracking"]


@pytest.mark.parametrize("queue", [1, 3])
def test_without_dropping_the_stream_waits(queue):
    asked = []
    live = LiveFrames((asked.append(i) or i for i in range(20)), queue, drop=False)
    live.start()
    until(lambda: len(asked) == queue + 1)  # one more is in the hand of the thread
    assert list(live) == list(range(20))
    assert (live.counts.received, live.counts.dropped, live.warnings) == (20, 0, [])


def test_what_comes_before_the_iteration_is_not_counted():
    go = threading.Event()

    def camera():
        yield from range(50)
        go.wait(LIMIT)
        yield 50

    live = LiveFrames(camera(), queue=3)
    live.start()
    until(lambda: live.counts.received == 50)
    assert live.peek() == 47
    found = iter(live)
    assert (live.counts.received, live.counts.dropped) == (3, 0)
    assert [next(found) for _ in range(3)] == [47, 48, 49]
    go.set()
    assert list(found) == [50] and live.counts.received == 4


def test_an_error_comes_after_the_frames_before_it():
    def camera():
        yield 1
        yield 2
        raise DvoError("unplugged")

    found = iter(LiveFrames(camera(), queue=2))
    until(lambda: gone("dvo stream"))
    assert [next(found), next(found)] == [1, 2]
    with pytest.raises(DvoError, match="unplugged"):
        next(found)


def test_stop_ends_a_wait_and_closes_the_generator():
    """The consumer waits for a camera that sends nothing; stop in another thread, or in a signal handler, ends that."""
    interrupted, closed = threading.Event(), threading.Event()

    def camera():
        try:
            yield 0
            interrupted.wait(LIMIT)
            yield 1
        finally:
            closed.set()

    live = LiveFrames(camera(), name="still", interrupt=interrupted.set)
    threading.Timer(0.05, live.stop).start()
    assert list(live) == [0]
    assert closed.is_set() and gone("dvo stream still")


def test_leaving_the_iteration_ends_the_thread():
    for item in LiveFrames(itertools.count(), name="endless"):
        if item > 5:
            break
    assert gone("dvo stream endless")
    with LiveFrames(itertools.count(), name="context") as live:
        assert live.peek() >= 0
    assert gone("dvo stream context")


def test_a_consumer_that_is_stopped_does_not_see_an_error():
    def camera():
        yield 0
        raise OSError("read was interrupted")

    live = LiveFrames(camera())
    found = iter(live)
    assert next(found) == 0
    live.stop()
    assert list(found) == []


def test_peek_has_a_time_limit_and_tells_the_end():
    wait = threading.Event()
    silent = LiveFrames((wait.wait(LIMIT) for _ in range(1)), interrupt=wait.set)
    with pytest.raises(DvoError, match="no image within 0.01 s"):
        silent.peek(0.01)
    silent.close()
    with pytest.raises(DvoError, match="ends without an image"):
        LiveFrames(iter([])).peek()


def test_bad_use():
    with pytest.raises(DvoError, match="queue.*1 or more"):
        LiveFrames([], queue=0)
    live = LiveFrames([1])
    assert list(live) == [1]
    with pytest.raises(DvoError, match="only once"):
        iter(live)


def test_a_session_takes_live_frames(fake_odometry):
    done = dvo.run(fake_odometry(), LiveFrames((frame(i) for i in range(12)), drop=False))
    assert done.frames_fed == 12 and len(done.result.trajectory) == 12
    pairs = ((0.1 * i, frame(i).image) for i in range(12))
    done = dvo.run(fake_odometry(), stream(LiveFrames(pairs, drop=False), CAMERA))
    assert np.allclose(done.result.trajectory.timestamps, 0.1 * np.arange(12))


def test_an_element_that_was_looked_at_is_skipped():
    live = LiveFrames(iter("abc"), drop=False, queue=1)
    first = live.peek(LIMIT)
    live.skip(first)
    until(lambda: live.peek(LIMIT) == "b")
    live.skip(first)  # it has gone: nothing happens
    assert list(live) == ["b", "c"]


def test_an_error_at_the_end_of_a_generator_reaches_the_consumer():
    class Frames:
        def __init__(self, error):
            self.error = error

        def __call__(self):
            try:
                yield from range(3)
            finally:
                raise self.error

    live = LiveFrames(Frames(OSError("the camera has gone"))(), drop=False)
    with pytest.raises(OSError, match="has gone"):
        list(live)
    live = LiveFrames(Frames(OSError("at its release"))(), drop=False, queue=1)
    assert next(iter(live)) == 0
    live.close()  # closing the generator raises in its thread
    assert gone("dvo stream stream")
    with pytest.raises(OSError, match="at its release"):
        live.peek(LIMIT)


@pytest.mark.long
@pytest.mark.parametrize("use", ["started", "looked at", "iterator", "iterating", "full", "in a cycle"])
def test_a_stream_without_references_ends_its_thread(use):
    """Without ``stop`` or ``close``: a camera would stay open as long as the process."""
    closed = threading.Event()

    def camera():
        try:
            yield from itertools.count()
        finally:
            closed.set()

    live = LiveFrames(camera(), name="forgotten", drop=use != "full")
    live.start()
    holder = [live]
    if use == "looked at":
        live.peek(LIMIT)
    elif use == "iterator":
        holder.append(iter(live))
    elif use == "iterating":
        holder.append(iter(live))
        next(holder[-1])
    elif use == "in a cycle":
        live.itself = live
    assert not closed.is_set()
    holder.clear()
    del live
    gc.collect()
    assert closed.wait(LIMIT)
    until(lambda: gone("dvo stream forgotten"))


def test_a_stream_that_waits_for_its_camera_is_interrupted_by_its_last_reference():
    interrupted = threading.Event()

    def camera():
        interrupted.wait(LIMIT)
        yield 0

    live = LiveFrames(camera(), name="silent", interrupt=interrupted.set)
    live.start()
    del live
    assert interrupted.wait(LIMIT)
    until(lambda: gone("dvo stream silent"))


def test_an_iterator_keeps_its_stream():
    found = iter(LiveFrames(iter(range(100)), drop=False))
    gc.collect()
    assert list(found) == list(range(100))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.parametrize("use", [list, lambda live: live.peek(), lambda live: next(live.begun), LiveFrames.start])
def test_a_forked_process_does_not_wait_for_the_thread(use):
    wait = threading.Event()

    def camera():
        yield 0
        wait.wait(LIMIT)

    with LiveFrames(camera(), name="parent", interrupt=wait.set) as live:
        if use not in (list, LiveFrames.start):
            live.begun = iter(live)
            assert next(live.begun) == 0
        assert in_fork(lambda: use(live)) == (
            "DvoError: parent: is read by a thread of the process that this one was forked from. "
            "Open the stream in the process that reads it."
        )
        assert in_fork(live.close) == "None", "nor does its end"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_stream_that_was_not_begun_is_read_by_the_forked_process():
    live = LiveFrames(iter(range(5)), drop=False)
    assert in_fork(lambda: list(live)) == "[0, 1, 2, 3, 4]"
