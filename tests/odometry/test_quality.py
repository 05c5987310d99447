"""Verdicts: good results are good, manufactured failures are told, and what says so is measured."""

from dataclasses import replace

import numpy as np
import pytest

import dvo
from dvo.data.trajectory import Trajectory
from dvo.geometry.undistort import Undistorter
from dvo.odometry.checks.measures import count_jumps
from dvo.odometry.protocol import Result, SparseMap
from dvo.odometry.quality import LEAST_AGREEMENT, MOST_DEVIATION, Quality, judge
from dvo.synth.sequence import make_sequence
from eval.benchmarks.verdict.failures import before_still_camera, with_crowd, with_overlay, with_waves

GOOD = Quality(
    "good", tracked=1.0, inliers=0.6, spread=1.0, agreement=0.999, residual=0.1, deviation=0.01, check=0.98, checks=9
)


@pytest.fixture(scope="module")
def film():
    size = {"frames": 36, "height": 120, "width": 160, "fps": 15.0}
    return list(make_sequence(61, family="room", kind="handheld", speed=3.0, **size))


def result_of(frames, **settings):
    return dvo.run(dvo.load("small", device="cpu", seed=0, **settings), frames).result


@pytest.mark.long
def test_a_good_result(film):
    quality = result_of(film).quality
    assert quality.verdict == "good" and not quality.reason and not quality.remedy and str(quality) == "good"
    assert quality.tracked == 1 and quality.checks > 3 and quality.check > 0.9 and quality.agreement > 0.98
    assert 0 < quality.inliers <= 1 and 0.5 < quality.spread <= 1 and 0 < quality.residual < 2
    assert quality.initialised_at > film[0].timestamp and quality.fixed == 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "number"),
    [pytest.param(with_crowd, 0, marks=pytest.mark.slow), pytest.param(with_waves, 0, marks=pytest.mark.slow),
     (with_overlay, 2)],
)  # fmt: skip
def test_a_failure_is_not_good(film, change, number):
    """A crowd of six to twelve large bodies, a sea of two thirds, a reflection over all of the picture."""
    quality = result_of(change(np.random.default_rng(3), film, number)).quality
    assert quality.verdict == "doubtful" and quality.reason and quality.remedy


@pytest.mark.long
def test_a_calibration_without_the_distortion_of_the_lens_is_told():
    """The focal length is that of the lens; without its distortion the poses are off by several percent."""
    size = {"frames": 36, "height": 120, "width": 160, "fps": 15.0}
    walk = make_sequence(61, family="room", kind="handheld", speed=3.0, **size)
    lens = replace(walk.camera, fx=110.0, fy=110.0, model="eucm", coefficients=(0.4, 1.0))
    recorded = list(replace(walk, camera=lens))
    pinhole = replace(lens, model="none", coefficients=())
    quality = result_of([replace(frame, camera=pinhole) for frame in recorded]).quality
    assert quality.verdict == "doubtful" and "a lens with more barrel distortion" in quality.reason
    assert "--calib FILE" in quality.remedy
    right = Undistorter(lens)
    frames = [replace(frame, image=right(frame.image), camera=right.camera) for frame in recorded]
    assert result_of(frames).quality.verdict == "good"


@pytest.mark.long
def test_motion_before_a_still_camera_is_not_good(film):
    quality = result_of(before_still_camera(np.random.default_rng(0), film, 1)).quality
    assert quality.verdict in ("doubtful", "failed")


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_clip_of_a_few_frames_fails(film, count):
    result = result_of(film[:count])
    assert result.frames_tracked == 0 and result.quality.verdict == "failed"
    assert "too little motion" in result.quality.reason and "too few" in result.quality.reason


def test_a_tripod_fails(film):
    rng = np.random.default_rng(0)
    still = [
        replace(frame, image=(film[0].image + rng.normal(0, 2, film[0].image.shape)).clip(0, 255).astype(np.uint8))
        for frame in film
    ]
    result = result_of(still)
    assert result.frames_tracked == 0 and len(result.map.points) == 0
    assert result.quality.verdict == "failed" and "too little motion" in result.quality.reason


@pytest.mark.long
def test_standing_still_after_the_start_is_good(film):
    rng = np.random.default_rng(0)
    stand = [(film[19].image + rng.normal(0, 2, film[0].image.shape)).clip(0, 255).astype(np.uint8) for _ in range(16)]
    frames = [*film[:20], *(replace(frame, image=image) for frame, image in zip(film[20:], stand, strict=True))]
    result = result_of(frames)
    assert result.frames_lost == 0 and result.quality.verdict == "good"


@pytest.mark.long
def test_the_share_of_the_frames_through_which_corners_hardly_move(film):
    """The camera stands from frame 20 on: what is seen then does not count."""
    frames = [*film[:20], *(replace(frame, image=film[19].image) for frame in film[20:])]
    for still, share in ([(20, 35)], 0.0), ([(8, 14), (20, 35)], 6 / 12), ([(8, 20), (20, 35)], 12 / 12):
        odometry = dvo.load("small", device="cpu", seed=0)
        for frame in frames:
            odometry.track(frame)
        checks = odometry.state.checks
        pair = checks.pairs[0]
        checks.pairs = [replace(pair, first=14, second=20)] if still[0] != (8, 20) else []
        checks.still = still
        assert odometry.finish().quality.still == pytest.approx(share)


@pytest.mark.parametrize(
    ("changed", "verdict", "words"),
    [
        ({}, "good", ""),
        ({"deviation": MOST_DEVIATION + 0.01}, "doubtful", "do not agree with the poses"),
        ({"deviation": 0.06, "check": 0.6, "agreement": 0.95}, "doubtful", "(off by 6% of their motion)"),
        ({"deviation": 0.03, "agreement": 0.89}, "doubtful", "contradict each other"),
        ({"deviation": 0.03, "check": 0.6, "agreement": 0.92}, "good", ""),
        ({"deviation": float("nan"), "checks": 0}, "doubtful", "too little of the picture moves"),
        ({"agreement": LEAST_AGREEMENT - 0.01}, "doubtful", "contradict each other"),
        ({"agreement": float("nan")}, "doubtful", "there are none"),
        ({"still": 0.3}, "good", ""),
        ({"still": 0.4}, "doubtful", "too little of the picture moves for 40% of the time"),
        ({"fixed": 0.3}, "doubtful", "30% of the picture"),
        ({"tracked": 0.3}, "doubtful", "30% of the frames"),
        ({"jumps": 3}, "doubtful", "jumps 3 times"),
        ({"tracked": 0.0}, "failed", "black image"),
    ],
)
def test_each_measure_has_its_say(changed, verdict, words):
    found, reason, remedy = judge(replace(GOOD, **changed), 100, "black image")
    assert found == verdict and words in reason and bool(reason) == bool(remedy) == (verdict != "good")


def test_jumps_are_counted():
    positions = np.column_stack([np.arange(20.0), np.zeros(20), np.zeros(20)])
    poses = np.column_stack([positions, np.tile([0.0, 0, 0, 1], (20, 1))])
    times = 0.1 * np.arange(20)

    def jumps(poses, times=times):
        return count_jumps(Result(Trajectory(times, poses), SparseMap(), len(poses), 0))

    assert jumps(poses) == 0
    moved = poses.copy()
    moved[10:, 1] += 30
    assert jumps(moved) == 1
    later = times.copy()
    astray = poses.copy()
    astray[4:6, 1] += 50.0, -50.0  # three steps in a row are far too long
    assert jumps(astray) == 3
    later[10:] += 5.0  # a gap in time is no jump
    assert jumps(moved, later) == 0
    assert jumps(np.tile(poses[0], (20, 1))) == 0
