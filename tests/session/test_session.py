"""A session: strides, interruptions, broken frames, segments and breaks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.odometry.protocol import Break, Estimate, Result, Segment, SparseMap, Status
from dvo.session import session

CAMERA = Camera(50, 50, 31.5, 23.5, 64, 48)


def frames(count: int, broken: int | None = None) -> Iterator[Frame]:
    image = np.zeros((48, 64, 3), np.uint8)
    for index in range(count):
        if index == broken:
            raise DvoError("does not decode", file="clip.mp4", field=f"frame {index}")
        yield Frame(index, 0.1 * index, image, CAMERA)


def test_every_frame_gets_its_row(fake_odometry):
    seen = []
    done = session.run(fake_odometry(), frames(12), on_frame=lambda frame, estimate: seen.append(frame.index))
    assert len(done.result.trajectory) == done.result.frames_read == done.frames_fed == 12
    assert done.result.frames_lost == 0 and done.warnings == () and not done.interrupted
    assert seen == list(range(12))


def test_strided_frames_are_interpolated(fake_odometry):
    odometry = fake_odometry()
    done = session.run(odometry, frames(12), stride=4)
    assert [frame.index for frame in odometry.frames] == [0, 4, 8, 11], "and the last one is fed"
    assert done.frames_fed == 4 and done.result.frames_read == 12
    trajectory = done.result.trajectory
    np.testing.assert_array_equal(trajectory.timestamps, [0.1 * i for i in range(12)])
    truth = np.array([odometry.motion(t) for t in trajectory.timestamps])
    assert np.abs(trajectory.positions - truth[:, :3]).max() < 0.01
    assert np.abs(trajectory.poses_wc[:, 3:] - truth[:, 3:]).max() < 1e-3
    np.testing.assert_array_equal(trajectory.poses_wc[8], truth[8])


def test_a_lost_frame_takes_its_strided_neighbours_along(fake_odometry):
    done = session.run(fake_odometry(lost=(6,)), frames(13), stride=3)
    rows = np.round(done.result.trajectory.timestamps * 10).astype(int)
    assert rows.tolist() == [0, 1, 2, 3, 9, 10, 11, 12]
    assert done.result.frames_lost == 5


def test_stop_keeps_what_was_tracked(fake_odometry):
    odometry = fake_odometry()
    done = session.run(odometry, frames(100), should_stop=lambda: len(odometry.frames) == 7)
    assert done.interrupted and len(done.result.trajectory) == 7
    assert done.warnings == ("interrupted after 7 frames",)


def test_keyboard_interrupt_from_the_source_keeps_what_was_tracked(fake_odometry):
    def interrupted() -> Iterator[Frame]:
        yield from frames(5)
        raise KeyboardInterrupt

    done = session.run(fake_odometry(), interrupted())
    assert done.interrupted and len(done.result.trajectory) == 5


@pytest.mark.parametrize("stride", [1, 2])
def test_broken_frame_keeps_what_was_tracked(fake_odometry, stride):
    done = session.run(fake_odometry(), frames(20, broken=9), stride=stride)
    assert len(done.result.trajectory) == 9 and not done.interrupted
    (warning,) = done.warnings
    assert "stopped at frame 9" in warning and "clip.mp4" in warning


def test_broken_first_frame_is_an_error(fake_odometry):
    with pytest.raises(DvoError, match="does not decode"):
        session.run(fake_odometry(), frames(20, broken=0))


def test_no_frames_is_an_error(fake_odometry):
    with pytest.raises(DvoError, match="no frames"):
        session.run(fake_odometry(), frames(0))


def test_a_bug_is_not_swallowed(fake_odometry):
    def fail() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        session.run(fake_odometry(at_frame={3: fail}), frames(5))


def test_interpolation_does_not_reach_out_of_the_trajectory():
    trajectory = Trajectory(np.array([1.0, 2.0]), np.tile([0, 0, 0, 0, 0, 0, 1.0], (2, 1)))
    filled = session.fill_skipped(trajectory, np.array([1.0, 2.0]), np.array([0.5, 1.5, 2.5]))
    assert filled.timestamps.tolist() == [1.0, 1.5, 2.0]


def test_strict_raises_instead_of_warning(fake_odometry):
    def stop() -> None:
        raise KeyboardInterrupt

    assert session.run(fake_odometry(), frames(12, broken=5)).warnings
    with pytest.raises(DvoError, match="does not decode"):
        session.run(fake_odometry(), frames(12, broken=5), strict=True)
    with pytest.raises(KeyboardInterrupt):
        session.run(fake_odometry(at_frame={3: stop}), frames(12), strict=True)


def test_every_frame_fed_has_its_time(fake_odometry):
    done = session.run(fake_odometry(), frames(12), stride=4)
    assert len(done.frame_seconds) == done.frames_fed == 4 and min(done.frame_seconds) >= 0
    assert sum(done.frame_seconds) == pytest.approx(done.seconds["tracking"])


def test_frames_are_interpolated_within_segments_only(fake_odometry):
    """Frames 9 to 11 lie between a tracked frame of one segment and one of the next: they have no pose."""
    odometry = fake_odometry(new_segment=(12,))
    result = session.run(odometry, frames(25), stride=4).result
    rows = [np.round(segment.trajectory.timestamps * 10).astype(int).tolist() for segment in result.segments]
    assert rows == [list(range(9)), list(range(12, 25))]
    assert result.longest == 1 and len(result.trajectory) == 13
    assert (result.frames_read, result.frames_tracked, result.frames_lost) == (25, 22, 3)
    (found,) = result.breaks
    assert (found.start, found.end, found.frames, found.new_segment) == (
        pytest.approx(0.8),
        pytest.approx(1.2),
        3,
        True,
    )
    second = result.segments[1]
    truth = np.array([2 * odometry.motion(t)[:3] + 10 for t in second.trajectory.timestamps])
    assert np.abs(second.trajectory.positions - truth).max() < 0.05, "of its own world and scale"


@pytest.mark.parametrize("stride", [1, 3])
def test_counts_and_breaks_cover_every_frame(fake_odometry, stride):
    lost = (0, 1, 2, 12, 13, 14, 15, 30)
    result = session.run(fake_odometry(lost=lost, new_segment=(15,)), frames(31), stride=stride).result
    assert result.frames_read == 31 == result.frames_tracked + result.frames_lost
    assert sum(found.frames for found in result.breaks) == result.frames_lost >= 8
    first, middle, last = result.breaks
    assert first.start is None and last.end is None
    assert [found.new_segment for found in result.breaks] == [False, True, False]
    assert {found.reason for found in result.breaks} == {"black image"}
    assert middle.start == pytest.approx(1.1 if stride == 1 else 0.9)
    assert middle.end == pytest.approx(1.6 if stride == 1 else 1.8)


def test_breaks_of_the_odometry_are_kept_and_counted_in_frames_of_the_source(fake_odometry):
    odometry = fake_odometry(lost=(8, 12))
    told = odometry.finish

    def finish() -> Result:
        result = told()
        times = [frame.timestamp for frame in odometry.frames]
        return replace(result, breaks=(Break(times[1], times[4], 2, "covered lens", new_segment=False),))

    odometry.finish = finish
    (found,) = session.run(odometry, frames(21), stride=4).result.breaks
    assert found.reason == "covered lens" and found.frames == 11, "5 to 15"


def test_a_change_of_segment_without_a_lost_frame_is_a_break(fake_odometry):
    (found,) = session.run(fake_odometry(new_segment=(4,)), frames(9)).result.breaks
    assert found.frames == 0 and found.new_segment and found.end == pytest.approx(0.4)


def test_the_trajectory_stays_that_of_the_odometry():
    """Of two segments with the same number of rows, the map belongs to the one that the odometry chose."""

    class Chooses:
        name = "chooses"

        def track(self, frame: Frame) -> Estimate:
            return Estimate(frame.timestamp, None, Status.INITIALISING)

        def finish(self) -> Result:
            poses = np.tile([0, 0, 0, 0, 0, 0, 1.0], (3, 1))
            first, second = (Trajectory(0.1 * np.arange(start, start + 3), poses) for start in (0, 3))
            segments = tuple(Segment(t, float(t.timestamps[0]), float(t.timestamps[-1])) for t in (first, second))
            return Result(second, SparseMap(), 6, 0, segments=segments)

    result = session.run(Chooses(), frames(6)).result
    assert result.longest == 1 and result.trajectory.timestamps[0] == pytest.approx(0.3)
