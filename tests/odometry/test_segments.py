"""Segments and breaks from the log of the frames."""

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.map.keyframe_log import KeyframeLog
from dvo.map.map import Recording
from dvo.odometry.protocol import Break, Result, SparseMap
from dvo.odometry.segments import breaks_of, result_of_log, segments_of


def log_of(text):
    """A log from a character a frame: the number of its segment, or ``x`` for a lost frame; times are positions."""
    log = KeyframeLog()
    for position, sign in enumerate(text):
        record = log.add(float(position), anchor=position)
        log.set_pose(position, np.array([position, 0, 0, 0, 0, 0, 1.0]))
        if sign == "x":
            record.lost, record.anchor, record.reason = True, None, "black image"
        else:
            record.segment = int(sign)
    return log


def test_segments_in_order_with_their_own_rows():
    found = segments_of(log_of("00xx1110"))
    assert [len(segment) for segment in found] == [3, 3]
    assert (found[1].start, found[1].end) == (4.0, 6.0)
    assert [len(segment) for segment in segments_of(log_of("000"))] == [3]
    assert segments_of(log_of("xx")) == ()


def test_breaks_tell_from_when_until_when_and_why():
    assert breaks_of(log_of("000")) == ()
    assert breaks_of(log_of("00xx11")) == (Break(1.0, 4.0, 2, "black image", True),)
    assert breaks_of(log_of("0x00x1")) == (
        Break(0.0, 2.0, 1, "black image", False),
        Break(3.0, 5.0, 1, "black image", True),
    )
    assert breaks_of(log_of("x0")) == (Break(None, 1.0, 1, "black image", False),)
    assert breaks_of(log_of("0x")) == (Break(0.0, None, 1, "black image", False),)
    assert breaks_of(log_of("0011")) == (Break(1.0, 2.0, 0, "change of segment", True),)


def test_a_frame_joined_across_a_gap_is_a_break_without_lost_frames():
    log = log_of("000")
    log.frames[2].reason = "gap of 5.00 s"
    assert breaks_of(log) == (Break(1.0, 2.0, 0, "gap of 5.00 s", False),)


def test_a_result_without_segments_has_its_trajectory_as_the_only_one():
    rows = segments_of(log_of("000"))[0].trajectory
    result = Result(rows, SparseMap(), 4, 1)
    assert [len(segment) for segment in result.segments] == [3] and result.frames_tracked == 3


def test_frames_of_a_keyframe_that_is_given_up_are_lost():
    log = log_of("0000")
    log.frames[2].anchor = 1
    log.lose(1, "no match")
    assert [record.lost for record in log.frames] == [False, True, True, False]
    assert log.frames[2].reason == "no match"


def test_the_trajectory_of_joined_segments_is_not_that_of_a_longer_one_apart():
    """Two segments of one world have more rows together than the longest; ``longest`` names one of theirs."""

    def rows(start, count):
        return Trajectory(start + np.arange(count, dtype=float), np.tile([0.0, 0, 0, 0, 0, 0, 1], (count, 1)))

    log = KeyframeLog()
    for number, (start, count) in enumerate([(0, 3), (10, 4), (20, 3)]):
        for time in rows(start, count).timestamps:
            log.set_pose(number, np.array([0.0, 0, 0, 0, 0, 0, 1]))
            log.add(float(time), number).segment = number
    result, main = result_of_log(log, {}, worlds={0: 0, 1: 1, 2: 0})
    assert main == 0 and len(result.trajectory) == 6 and result.longest in (0, 2)
    assert [segment.joined_to for segment in result.segments] == [None, None, 0]
    apart, main = result_of_log(log, {})
    assert main == 1 and len(apart.trajectory) == 4 and apart.longest == 1


def test_a_recording_in_a_map_has_the_rows_of_its_own_segments():
    log = log_of("0011x2233344")
    begun = Recording(frame=5, keyframe=5, segment=2)
    found, main = result_of_log(log, {}, None, {2: 2, 3: 0, 4: 0}, begun)
    assert [(len(s), s.joined_to, s.in_map) for s in found.segments] == [
        (2, None, False),
        (3, None, True),
        (2, 1, True),
    ]
    assert main == 1 and found.trajectory.timestamps.tolist() == [7.0, 8.0, 9.0, 10.0, 11.0]
    assert (found.frames_read, found.frames_lost) == (7, 0)
    assert [(b.start, b.end) for b in found.breaks] == [(6.0, 7.0), (9.0, 10.0)]
    # The world of the map comes first, however short; without it the longest one.
    short, main = result_of_log(log, {}, None, {4: 1}, begun)
    assert main == 2 and short.trajectory.timestamps.tolist() == [10.0, 11.0]
    assert result_of_log(log, {}, None, None, begun)[1] == 1
