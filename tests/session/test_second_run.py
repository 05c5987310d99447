"""Second run, backward and with another seed: when it is made, what it says, and that nothing is lost by it."""

from dataclasses import replace

import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data.calibration.focal_guess import guess_from_angle
from dvo.data.streams.live import LiveFrames
from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status
from dvo.odometry.quality import Quality, leaves_doubt
from dvo.session import second_run
from dvo.session.second_run import can_be_read_again, compare_again, is_due
from tests.support.tiny_tracker import frames

SURE = Quality("good", tracked=1.0, agreement=1.0, deviation=0.0, check=1.0, checks=9)
UNSURE = replace(SURE, deviation=0.05)


class Walk:
    """Odometry of a known path, scaled and bent, with a quality."""

    name = "walk"

    def __init__(self, bend=0.0, quality=UNSURE, fail=False):
        self.bend, self.quality, self.fail, self.times, self.numbers, self.sizes = bend, quality, fail, [], [], set()

    def track(self, frame):
        if self.fail:
            raise DvoError("broken")
        self.times.append(frame.timestamp)
        self.numbers.append(frame.index)
        self.sizes.add((*frame.image.shape[:2], frame.camera.height, frame.camera.width))
        return Estimate(frame.timestamp, None, Status.TRACKING)

    def finish(self):
        t, times = 0.1 * np.array(self.numbers), np.array(self.times)
        positions = np.column_stack([t, np.sin(t) + self.bend * t**2, np.zeros_like(t)]) * (1 + self.bend)
        poses = np.column_stack([positions, np.tile([0.0, 0, 0, 1], (len(t), 1))])
        return Result(Trajectory(times, poses), SparseMap(), len(t), 0, quality=self.quality)


def ran(again, first=UNSURE, source=None, **options):
    return dvo.run(Walk(quality=first), frames(30) if source is None else source, again=again, **options)


def test_it_is_made_where_a_good_result_leaves_doubt():
    assert leaves_doubt(UNSURE) and not leaves_doubt(SURE) and not leaves_doubt(None)
    assert not leaves_doubt(replace(UNSURE, verdict="doubtful", deviation=0.5))
    never = lambda number: pytest.fail("a second run of a sure result")  # noqa: E731
    assert "checking" not in ran(never, first=SURE).seconds
    ran(never, source=iter(frames(30)))


def test_measured_depths_need_none():
    first = Walk().finish()
    assert is_due(first, frames(3)) and not is_due(first, iter(frames(3)))
    for source, due in (("stereo", False), ("depth", False), ("height", True)):
        assert is_due(replace(first, info={"scale": {"source": source}}), frames(3)) is due


def test_runs_that_agree_stay_good():
    done = ran(lambda number: Walk(0.0))
    assert done.result.quality.verdict == "good" and done.result.quality.second == pytest.approx(0, abs=1e-6)
    assert done.seconds["checking"] > 0 and done.frames_fed == 30


@pytest.mark.parametrize("stride", [1, 3])
def test_runs_that_differ_are_doubtful(stride):
    quality = ran(lambda number: Walk(2.0), stride=stride).result.quality
    assert quality.verdict == "doubtful" and quality.second > 3 and quality.remedy
    assert f"differs by {quality.second:.0f}% of the path" in quality.reason


def test_a_second_run_that_fits_its_measurements_worse_says_nothing_of_the_first():
    """Unless it is doubtful by itself."""
    for own, residual, verdict in (
        ("good", 0.25, "doubtful"), ("good", 0.4, "good"), ("doubtful", 0.4, "doubtful"), ("good", np.nan, "doubtful")
    ):  # fmt: skip
        again = Walk(2.0, quality=replace(UNSURE, verdict=own, residual=residual))
        quality = ran(lambda number, again=again: again, first=replace(UNSURE, residual=0.3)).result.quality
        assert quality.verdict == verdict and quality.second > 3


def test_a_second_run_that_finds_no_motion_leaves_doubt():
    """Where the first has begun in the first half of the frames, and there are enough of them."""

    class Lost(Walk):
        def __init__(self, number):
            super().__init__()

        def finish(self):
            return replace(super().finish(), trajectory=Trajectory(np.zeros(0), np.zeros((0, 7))))

    for begun, source, verdict in ((0.2, frames(30), "doubtful"), (2.5, frames(30), "good"), (0.2, frames(12), "good"),
                                   (None, frames(30), "good")):  # fmt: skip
        quality = ran(Lost, first=replace(UNSURE, initialised_at=begun), source=source).result.quality
        assert quality.verdict == verdict and np.isnan(quality.second)
        assert ("finds no motion" in quality.reason) is (verdict == "doubtful") and bool(quality.remedy) is (
            verdict == "doubtful"
        )


@pytest.mark.parametrize("third, verdict", [(0.0, "good"), (0.3, "doubtful")])
def test_a_third_run_decides_where_they_differ(third, verdict):
    """Forward, and with a seed of its own; the difference of the second is told all the same."""
    walks = {1: Walk(2.0), 2: Walk(third)}
    quality = ran(walks.pop).result.quality
    assert quality.verdict == verdict and quality.second > 3 and not walks


def test_a_second_run_that_fits_better_is_not_outvoted():
    """Two runs forward may share what misleads them."""
    for residual, verdict in ((0.28, "doubtful"), (0.3, "good"), (0.32, "good")):
        first = replace(UNSURE, residual=0.3)
        walks = {1: Walk(2.0, quality=replace(UNSURE, residual=residual)), 2: Walk(quality=first)}
        quality = ran(walks.pop, first=first).result.quality
        assert quality.verdict == verdict and quality.second > 3 and bool(walks) is (verdict == "doubtful")


def test_a_second_run_that_is_as_good_leaves_doubt_by_a_smaller_difference():
    """It fits its measurements better, or as well and is doubtful by itself."""
    first = replace(UNSURE, residual=0.3)
    for bend, own, residual, verdict in (
        (0.01, "good", 0.28, "good"), (0.07, "good", 0.28, "doubtful"), (0.07, "good", 0.32, "good"),
        (0.07, "doubtful", 0.32, "doubtful"), (0.07, "doubtful", 0.4, "good"), (0.01, "doubtful", 0.32, "good"),
        (0.07, "doubtful", np.nan, "good"),
    ):  # fmt: skip
        again = Walk(bend, quality=replace(UNSURE, verdict=own, residual=residual))
        quality = ran(lambda number, again=again: again, first=first).result.quality
        assert quality.verdict == verdict and (1 < quality.second < 3 if bend > 0.05 else quality.second < 1)


def test_a_second_run_without_a_quality_is_judged_by_its_difference():
    """And a third one decides, as of any that is no better."""
    for bend, third, verdict in ((0.07, 0.0, "good"), (2.0, 0.0, "good"), (2.0, 0.3, "doubtful")):
        walks = {1: Walk(bend, quality=None), 2: Walk(third, quality=None)}
        assert ran(walks.pop).result.quality.verdict == verdict


def test_frames_with_equal_times_are_an_error_of_the_library_or_none():
    """The first run ends before them; the second one meets them."""
    twice = frames(30)
    twice[20] = replace(twice[20], timestamp=twice[19].timestamp)
    assert compare_again(Walk().finish(), lambda number: Walk(), twice).verdict == "good"


def test_no_third_run_where_they_agree_or_after_a_stop():
    never = {1: Walk(0.0)}
    assert ran(never.pop).result.quality.verdict == "good" and not never
    first, second, third = Walk(), Walk(2.0), Walk(0.0)
    for frame in frames(30):
        first.track(frame)
    stop = lambda: len(third.times) >= 12  # noqa: E731
    quality = compare_again(first.finish(), {1: second, 2: third}.pop, frames(30), should_stop=stop)
    assert quality.verdict == "doubtful" and len(third.times) == 12


def test_the_beginning_alone_is_tracked_again(monkeypatch):
    monkeypatch.setattr(second_run, "FRAMES", 5)
    other = Walk()
    compare_again(Walk().finish(), lambda number: other, frames(30), stride=2)
    assert other.times == [pytest.approx(0.2 * k) for k in range(5)] and other.numbers == [8, 6, 4, 2, 0]


def test_large_images_are_kept_small(monkeypatch):
    monkeypatch.setattr(second_run, "MAX_PIXELS", 40 * 30)
    other = Walk()
    assert compare_again(Walk().finish(), lambda number: other, frames(12)).verdict == "good"
    ((height, width, *camera),) = other.sizes
    assert height * width <= 1.1 * 40 * 30 and camera == [height, width]


def test_a_second_run_that_fails_or_is_stopped_leaves_the_first():
    assert ran(lambda number: Walk(fail=True)).result.quality == UNSURE
    pressed = []
    other = Walk()

    def begin(number):
        pressed.append(True)
        return other

    done = ran(begin, should_stop=lambda: bool(pressed))
    assert done.result.quality.verdict == "good" and not other.times and len(done.result.trajectory) == 30


def test_a_picture_that_moves_as_a_whole_is_doubtful_where_the_focal_length_is_a_guess():
    class Clip(list):
        guess = None

    flat, clip = replace(SURE, relief=0.01), Clip(frames(5))
    assert dvo.run(Walk(quality=flat), clip).result.quality.verdict == "good"
    clip.guess = guess_from_angle(64, 48)
    quality = dvo.run(Walk(quality=flat), clip).result.quality
    assert quality.verdict == "doubtful" and "moves as a whole" in quality.reason and "calibration" in quality.remedy
    for relief in (0.2, np.nan):
        assert dvo.run(Walk(quality=replace(SURE, relief=relief)), clip).result.quality.verdict == "good"


def test_a_picture_that_turns_is_doubtful_where_no_calibration_was_given():
    class Clip(list):
        calibrated = True

    turned, clip = replace(SURE, turn_parallax=0.3), Clip(frames(5))
    assert dvo.run(Walk(quality=turned), clip).result.quality.verdict == "good"
    clip.calibrated = False
    quality = dvo.run(Walk(quality=turned), clip).result.quality
    assert quality.verdict == "doubtful" and "turned in its place" in quality.reason
    for share in (0.6, np.nan):
        assert (
            dvo.run(Walk(quality=replace(SURE, turn_parallax=share, relief=0.01)), clip).result.quality.verdict
            == "good"
        )


def test_what_arrives_once_is_not_read_again():
    assert can_be_read_again(frames(3)) and not can_be_read_again(iter(frames(3)))
    assert not can_be_read_again(LiveFrames(frames(3)))
