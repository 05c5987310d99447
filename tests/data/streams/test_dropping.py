"""Dropped frames are no gap in time: sources tell what they have received."""

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dvo
from dvo.data.frame import Frame
from dvo.data.streams.live import LiveFrames
from dvo.data.streams.streams import stream
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.odometry.frames.gate import Gate
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])
RNG = np.random.default_rng(0)
IMAGES = RNG.integers(0, 255, (400, 48, 64, 3), np.uint8)


class Gated:
    """Odometry that does nothing but pass frames through the gate of the tracker; a gap begins a segment."""

    name = "gated"

    def __init__(self):
        self.gate, self.gaps, self.times = Gate(None, 4.5), [], []

    def track(self, frame):
        with self.gate.admit(frame) as admitted:
            self.times.append(frame.timestamp)
            if admitted.gap is not None:
                self.gaps.append(str(admitted.gap))
        return Estimate(frame.timestamp, IDENTITY, Status.TRACKING)

    def finish(self):
        rows = Trajectory(np.array(self.times), np.tile(IDENTITY, (len(self.times), 1)))
        return Result(rows, SparseMap(), len(self.times), 0)


def element(kind, number, seconds):
    image = IMAGES[number]
    return (
        Frame(number, seconds, image, CAMERA) if kind == "frames" else image if kind == "images" else (seconds, image)
    )


def with_drops(times, taken, kind="pairs", stride=1):
    """Odometry that has tracked a camera whose frames ``taken`` alone it was fast enough for."""
    arrived, turns = ([threading.Semaphore(0) for _ in taken] for _ in range(2))

    def camera():
        sent = 0
        for last, here, turn in zip(taken, arrived, turns, strict=True):
            for number in range(sent, last + 1):
                yield element(kind, number, times[number])
            sent = last + 1
            here.release()
            turn.acquire(timeout=20)

    live = LiveFrames(camera())
    source = live if kind == "frames" else stream(live, CAMERA, timestamps=times if kind == "images" else None)

    def frames():
        live.start()
        found = iter(source)
        for here, turn in zip(arrived, turns, strict=True):
            assert here.acquire(timeout=20)
            yield next(found)
            turn.release()

    odometry = Gated()
    dvo.run(odometry, frames(), stride=stride, strict=True)
    live.close()
    return odometry


def every_second(count):
    return [0, 1, 2, *range(4, count, 2)]  # a start with close frames


def a_third(count, seed=0):
    return [0, 1, 2, *np.flatnonzero(np.random.default_rng(seed).random(count - 3) < 1 / 3) + 3]


@pytest.mark.parametrize("kind", ["pairs", "frames", "images"])
@pytest.mark.parametrize("rate", [20, 30])
@pytest.mark.parametrize("taken", [every_second(200), a_third(200), [0, 1, 2, *range(3, 200, 40)]])
def test_dropped_frames_are_no_gap(rate, taken, kind):
    times = [number / rate for number in range(200)]
    odometry = with_drops(times, taken, kind)
    assert odometry.times == [times[number] for number in taken]
    assert odometry.gaps == []


@pytest.mark.parametrize("kind", ["pairs", "frames", "images"])
def test_where_nothing_was_received_is_a_gap(kind):
    times = np.arange(60) / 20
    times[33:] += 2.0  # while frames are dropped, between two that are taken
    odometry = with_drops(times.tolist(), every_second(60), kind)
    assert odometry.gaps == ["gap of 2.05 s"]


def test_a_stride_keeps_what_was_dropped():
    times = np.arange(120) / 20
    assert with_drops(times.tolist(), a_third(120), stride=3).gaps == []
    times[70:] += 2.0
    assert len(with_drops(times.tolist(), a_third(120), stride=3).gaps) == 1


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(1, 12), min_size=5, max_size=30), st.floats(5, 120))
def test_any_rate_and_any_dropping(steps, rate):
    taken = np.cumsum([0, *steps]).tolist()
    assert with_drops([number / rate for number in range(taken[-1] + 1)], taken).gaps == []
