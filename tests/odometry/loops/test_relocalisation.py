"""A camera that goes dark and comes back to what it saw before, or somewhere else."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import dvo
from dvo.data.trajectory import Trajectory
from dvo.metrics import evaluate
from dvo.odometry.protocol import Status
from dvo.synth.sequence import make_sequence

LIT, DARK, FPS = 34, 10, 15.0
SHORT = {"keyframe_motion": 0.5, "removal": 5, "lifetime": 4, "optimisation": 5}  # keyframes leave the window soon
ALONE = {"join_inliers": 1.0}  # no frame is joined with the window across the darkness


@cache
def walk(scene):
    return make_sequence(
        scene, frames=40, family="room", kind="handheld", speed=5.0, height=120, width=160, fps=FPS, sensor=False
    )


@cache
def view(scene, k):
    return walk(scene).frame(k)


def interrupted(scene, after, other=None, lit=LIT, dark=DARK):
    """Frames of a scene, darkness, and frames of the same or another one; and the true trajectory of the scene."""
    first = [view(scene, k) for k in range(lit)]
    black = replace(first[0], image=np.zeros_like(first[0].image))
    views = [*first, *[black] * dark, *(view(scene if other is None else other, k) for k in after)]
    times = np.arange(len(views)) / FPS
    frames = [replace(view, timestamp=float(time)) for view, time in zip(views, times, strict=True)]
    order = [*range(lit), *[lit] * dark, *after]
    return frames, Trajectory(times, walk(scene).groundtruth.poses_wc[order])


BACK = [*range(20, -1, -1), *range(1, 20)]


def track(frames, **settings):
    odometry = dvo.load("small", **SHORT, **ALONE, **settings)
    estimates = [odometry.track(frame) for frame in frames]
    return odometry, estimates, odometry.finish()


def told(estimates):
    """Trajectory of the poses that were told while tracking, in the world that they were recovered in."""
    (back,) = [k for k, estimate in enumerate(estimates) if estimate.recovered]
    rows = [e for e in (*estimates[:LIT], *estimates[back:]) if e.status is Status.TRACKING]
    return Trajectory(np.array([e.timestamp for e in rows]), np.stack([e.pose_wc for e in rows]))


@pytest.fixture(scope="module")
def runs():
    """The same way with several seeds: a verdict does not hang on one of them."""
    frames, truth = interrupted(63, BACK)
    return truth, [track(frames, seed=seed) for seed in (0, 1, 2)]


@pytest.mark.slow
def test_the_first_frames_that_show_a_known_place_are_located_in_it(runs):
    truth, found = runs
    for _, estimates, result in found:
        back = [k for k, estimate in enumerate(estimates) if estimate.recovered]
        assert len(back) == 1 and LIT + DARK <= back[0] < LIT + DARK + 3
        assert [segment.joined_to for segment in result.segments] == [None, 0]
        loop = next(loop for loop in result.info["loops"] if loop["kind"] == "relocalisation")
        assert loop["joins_segments"] and loop["to"] < LIT / FPS < loop["from"]
        assert len(result.trajectory) == sum(map(len, result.segments)) == LIT + len(BACK)
    assert np.median([evaluate(told(estimates), truth).ate_percent for _, estimates, _ in found]) < 1.0
    assert np.median([evaluate(result.trajectory, truth).ate_percent for _, _, result in found]) < 0.3


@pytest.mark.slow
def test_while_it_sees_the_map_the_window_has_keyframes_of_it_that_stay(runs):
    frames, _ = interrupted(63, BACK)
    odometry = dvo.load("small", **SHORT, **ALONE)
    for frame in frames[: LIT + DARK + 8]:
        odometry.track(frame)
    window, archive = odometry.window, odometry.graph.archive
    guests, own = window.frames[: window.guests], window.frames[window.guests :]
    assert guests and all(guest.timestamp < LIT / FPS for guest in guests)
    assert own and not any(frame.guest or frame.identifier in archive for frame in own)
    before = odometry.graph.poses_cw(np.array([guest.identifier for guest in guests])).numpy()
    assert np.allclose(window.poses_cw[: window.guests].numpy(), before, atol=1e-5)
    for frame in frames[LIT + DARK + 8 : LIT + DARK + 12]:
        odometry.track(frame)
    odometry.finish()
    assert len({frame.identifier for frame in odometry.graph.archive}) == len(odometry.graph.archive)
    assert sorted(odometry.graph.log.poses) == sorted(f.identifier for f in odometry.graph.archive if f.anchor is None)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [103, 105])
def test_other_scenes_are_found_back_as_well(scene):
    frames, _ = interrupted(scene, BACK)
    _, estimates, result = track(frames)
    assert any(estimate.recovered for estimate in estimates[LIT + DARK : LIT + DARK + 3])
    assert [segment.joined_to for segment in result.segments] == [None, 0]


@pytest.mark.long
@pytest.mark.parametrize(
    ("scene", "other", "lit", "dark", "after"),
    [(63, 105, 22, 6, range(14)), pytest.param(63, 105, LIT, DARK, range(30), marks=pytest.mark.slow),
     pytest.param(105, 103, LIT, DARK, range(30), marks=pytest.mark.slow)],
)  # fmt: skip
def test_another_scene_begins_a_world_of_its_own(scene, other, lit, dark, after):
    frames, _ = interrupted(scene, after, other, lit, dark)
    _, estimates, result = track(frames)
    assert not any(estimate.recovered for estimate in estimates)
    assert [segment.joined_to for segment in result.segments] == [None, None]
    assert not any(loop["joins_segments"] for loop in result.info["loops"])


@pytest.mark.slow
def test_without_loops_nothing_is_located():
    frames, _ = interrupted(63, BACK[:16])
    _, estimates, result = track(frames, loops=False)
    assert not any(estimate.recovered for estimate in estimates)
    assert all(segment.joined_to is None for segment in result.segments)


@pytest.mark.slow
def test_frames_of_a_first_window_whose_edges_have_left_it_are_kept():
    """Little motion for longer than edges stay in the window: nothing speaks against the oldest frames."""
    frames = list(walk(102))
    odometry = dvo.load("small", **SHORT)
    for frame in frames:
        odometry.track(frame)
    result = odometry.finish()
    assert result.frames_lost == 0 and len(result.trajectory) == len(frames)
