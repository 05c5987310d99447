import io
import itertools
import time

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data import Calibration, open_source
from dvo.data.interval import Interval
from dvo.data.recording import ImageRecording
from dvo.data.streams.live_source import open_stream

CALIB = Calibration(50, 50, 31, 23)
LARGE = Calibration(100, 100, 80, 60)


def chosen(interval, times, stride=1):
    items = enumerate(times)
    return [index for index, _ in interval.select(items, lambda item: item[1], stride, "clip")]


@given(st.integers(0, 30), st.integers(1, 31), st.integers(1, 4))
def test_numbers_and_times_choose_the_same_frames(start, length, stride):
    times = 1e9 + 0.1 * np.arange(40)
    end = start + length
    wanted = list(range(start, min(end, 40), stride))
    assert chosen(Interval.of(f"{start}f", f"{end}f"), times, stride) == wanted
    assert chosen(Interval.of(0.1 * start, f"{0.1 * end}"), times, stride) == wanted
    assert chosen(Interval.of(0.1 * start, f"{end}f"), times, stride) == wanted


def test_nothing_is_read_behind_the_end():
    read = []
    items = ((read.append(i), (i, 0.1 * i))[1] for i in itertools.count())
    assert [i for i, _ in Interval.of(None, 0.5).select(items, lambda item: item[1], 1, "clip")] == list(range(5))
    assert len(read) == 6


@pytest.mark.parametrize(
    ("start", "end", "message"),
    [
        ("two", None, "'two' is no time"), (-1, None, "no time from the first"), ("nan", None, "no time"),
        (None, "0f", "ends at 0"), ("5f", "5f", "from 5f to 5f is empty"), (2.0, "1.5", "is empty"),
        (True, None, "no time"), ("-3f", None, "no time"),
    ],
)  # fmt: skip
def test_bounds_that_are_none(start, end, message):
    with pytest.raises(DvoError, match=message):
        Interval.of(start, end)


def folder(make, count=12):
    path = make.images("clip", [f"{i:03d}.png" for i in range(count)])
    make.text("times.txt", "".join(f"{100 + 0.5 * i}\n" for i in range(count)))
    return path


def test_a_folder_keeps_times_and_numbers_and_decodes_no_other_image(make, monkeypatch):
    path, read = folder(make), []
    frame = ImageRecording.frame
    source = open_source(path, calib=CALIB, times="../times.txt", start=1.0, end="9f", stride=3)
    monkeypatch.setattr(
        ImageRecording, "frame", lambda self, index, *others: (read.append(index), frame(self, index, *others))[1]
    )
    frames = list(source)
    assert [(f.index, f.timestamp) for f in frames] == [(2, 101.0), (5, 102.5), (8, 104.0)]
    assert read == [2, 5, 8] and len(source) == 3 and len(source.timestamps) == 12
    whole = list(open_source(path, calib=CALIB, times="../times.txt"))
    assert all(np.array_equal(f.image, whole[f.index].image) for f in frames)


def test_ground_truth_of_the_whole_folder_stays_at_its_times(make):
    path = folder(make)
    truth = make.text("poses.txt", "".join(f"1 0 0 {i} 0 1 0 0 0 0 1 0\n" for i in range(12)))
    source = open_source(path, calib=CALIB, times="../times.txt", groundtruth=truth, start="4f")
    truths = dict(zip(source.groundtruth.timestamps.tolist(), source.groundtruth.poses_wc[:, 0].tolist(), strict=True))
    assert [truths[frame.timestamp] for frame in source] == list(range(4, 12))


def test_an_empty_interval_of_a_folder_is_found_when_it_is_opened(make):
    with pytest.raises(DvoError, match=r"no frame from frame 12; read were 12 frames"):
        open_source(folder(make), calib=CALIB, fps=2, start="12f")
    with pytest.raises(DvoError, match=r"no frame from 30 s; read were 12 frames, 5.500 s"):
        open_source(folder(make), calib=CALIB, fps=2, start=30)


@pytest.mark.parametrize(("name", "codec"), [("v.mp4", "mp4v"), ("v.avi", "MJPG")])
@pytest.mark.parametrize("bounds", [{"start": 0.35, "end": 0.8}, {"start": "7f", "end": "16f"}])
def test_a_video_begins_exactly_and_is_decoded_once(make, monkeypatch, name, codec, bounds):
    video = make.video(name, codec)
    whole = list(open_source(video, calib=LARGE))
    source = open_source(video, calib=LARGE, stride=3, **bounds)
    grabbed, real = [], cv2.VideoCapture

    class Capture:
        def __init__(self, *arguments):
            self.real = real(*arguments)

        def __getattr__(self, name):
            return getattr(self.real, name)

        def grab(self):
            grabbed.append(self.real.grab())
            return grabbed[-1]

    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    frames = list(source)
    assert [frame.index for frame in frames] == [7, 10, 13]
    assert grabbed == 17 * [True] and source.warnings == []
    for frame in frames:
        assert np.array_equal(frame.image, whole[frame.index].image) and frame.timestamp == whole[frame.index].timestamp


def test_an_empty_interval_of_a_video(make):
    with pytest.raises(DvoError, match="no frame from 5 s; read were 20 frames, 0.950 s"):
        list(open_source(make.video("v.mp4", "mp4v"), calib=LARGE, start=5))


def pipe(make, count=10):
    return io.BytesIO(b"".join(cv2.imencode(".png", make.image(i))[1].tobytes() for i in range(count)))


@pytest.mark.parametrize("end", ["4f", 0.4])
def test_a_stream_ends(make, end):
    source = open_stream(pipe(make), calib=CALIB, fps=10, end=end)
    assert [frame.index for frame in source] == [0, 1, 2, 3]


def test_a_frame_that_waits_at_the_end_of_a_stream_was_not_dropped(make):
    source = open_stream(pipe(make), calib=CALIB, fps=10, end="4f")
    for frame in source:
        while frame.index == 3 and source.counts.received < 5:  # one more waits
            time.sleep(0.001)
    assert source.counts.dropped == 0 and not any("dropped" in warning for warning in source.warnings)


def test_a_stream_has_no_start():
    with pytest.raises(DvoError, match="start: not for a stream"):
        open_source("webcam:0", start=1)
