"""Inertial samples beside the tracker, with an untrained network and an alignment that is given."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from dvo.ba.patch_problem import PatchProblem
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry import se3, sim3
from dvo.geometry.poses import rotation_vector, split
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.odometry.global_ba.graph_adjustment import Adjusted
from dvo.odometry.global_ba.inertial_adjustment import VisualInertialSolution as Solution
from dvo.odometry.inertial.estimator import Similarity
from dvo.odometry.inertial.smoother import Smoothed, spaced
from dvo.odometry.patch.inertial import UNTOLD, _led, _runs, _turns_of
from dvo.odometry.protocol import Estimate, ScaleState, Status
from dvo.odometry.quality import Quality
from tests.support.steady_samples import IDENTITY, SPEED, UPRIGHT, align, with_samples
from tests.support.tiny_tracker import SMALL, frames, plain, tracker


def dark(images: list[Frame], first: int, last: int) -> list[Frame]:
    """Frames of which some are black."""
    return [
        replace(frame, image=np.zeros_like(frame.image)) if first <= k < last else frame
        for k, frame in enumerate(images)
    ]


@pytest.mark.long
def test_until_it_is_aligned_the_output_equals_that_without_samples() -> None:
    (alone, first), aided = plain(14), tracker()
    for a, other in zip(alone, with_samples(frames(14)), strict=True):
        b = aided.track(other)
        assert a.scale_state is ScaleState.NONE and b.scale_state is ScaleState.INITIALISING
        assert (a.pose_wc is None) == (b.pose_wc is None)
        assert a.pose_wc is None or b.pose_wc is None or a.pose_wc.tobytes() == b.pose_wc.tobytes()
    second = aided.finish()
    assert first.trajectory.poses_wc.tobytes() == second.trajectory.poses_wc.tobytes()
    assert second.info["inertial"]["state"] == "initialising" and second.info["inertial"]["reason"]
    assert "inertial" not in first.info and not second.metric


@pytest.mark.parametrize(("error", "source"), [(0.002, "gyroscope"), (0.03, "camera")])
def test_a_rolling_shutter_is_corrected_where_the_gyroscope_has_told_the_turns(error: float, source: str) -> None:
    odometry = tracker()
    for frame in with_samples(frames(8)):
        odometry.track(replace(frame, camera=replace(frame.camera, readout=0.02)))
        odometry.inertial._errors = error**2, 0.02**2, 0.02**2
    shutter, times = odometry.state.shutter, np.array([odometry.graph.log.frames[-1].timestamp])
    turned = None if shutter.turns is None else shutter.turns(times, np.array([-0.01, 0.01]))
    assert shutter.readout == 0.02 and (turned is not None) == (source == "gyroscope")
    assert turned is None or not turned.any()  # the camera moves during the readout, and turns no more
    info = odometry.finish().info
    assert (info["readout"], info["readout_from"]) == (0.02, source)


@given(st.lists(st.booleans(), min_size=1, max_size=8), st.booleans())
def test_images_that_were_read_at_once_do_not_turn_and_others_do_as_is_told(at_once: list[bool], known: bool) -> None:
    times, mask = 100.0 + 0.05 * np.arange(len(at_once)), np.array(at_once)
    assume(mask.any())
    turned = np.random.default_rng(0).normal(size=(len(times), 5, 3))
    turns = _turns_of(times[mask], (lambda _, __: turned) if known else None)(times + 1e-9, np.zeros(5))
    assert turns.shape == turned.shape and not turns[mask].any()
    assert np.array_equal(turns[~mask], turned[~mask]) if known else np.isnan(turns[~mask]).all()


def test_samples_are_ignored_on_request() -> None:
    odometry = tracker(replace(SMALL, inertial={"use": False}))
    estimates = [odometry.track(frame) for frame in with_samples(frames(8))]
    assert {estimate.scale_state for estimate in estimates} == {ScaleState.NONE}
    assert "inertial" not in odometry.finish().info


def test_another_source_of_metres_is_left_alone() -> None:
    aided = tracker(replace(SMALL, scale={"distances": [[0.5, 1.0, 2.0]]}))
    for k, (a, other) in enumerate(zip(plain(14)[0], with_samples(frames(14)), strict=True)):
        b = aided.track(other)
        if k == 9:
            align(aided, other.timestamp)
        assert a.pose_wc is None or b.pose_wc is None or a.pose_wc.tobytes() == b.pose_wc.tobytes()
    result = aided.finish()
    assert result.info["inertial"]["reason"] == "metres come from another source"
    assert result.info["scale"]["source"] == "distance"


@pytest.mark.long
def test_poses_turn_upright_and_metric_and_so_does_the_result() -> None:
    (alone, before), aided = plain(14), tracker()
    aided.inertial.coupling.similarity = lambda: None  # else the samples would change the visual poses as well
    for k, (a, other) in enumerate(zip(alone, with_samples(frames(14)), strict=True)):
        b = aided.track(other)
        if k == 9:
            align(aided, other.timestamp)
        if k > 9:
            assert a.pose_wc is not None and b.pose_wc is not None and b.inertial is not None
            assert b.scale_state is ScaleState.ALIGNED
            np.testing.assert_allclose(b.pose_wc[:3], 2 * UPRIGHT @ a.pose_wc[:3], atol=1e-9)
            np.testing.assert_allclose(split(b.pose_wc)[0], UPRIGHT @ split(a.pose_wc)[0], atol=1e-9)
            assert a.covariance is not None and b.covariance is not None
            np.testing.assert_allclose(b.covariance[:3, :3], 4 * a.covariance[:3, :3], rtol=1e-6)
    so_far = aided.current()
    result = aided.finish()
    assert result.metric and result.info["scale"]["source"] == "inertial"
    expected = 2 * before.trajectory.positions @ UPRIGHT.T
    np.testing.assert_allclose(result.trajectory.positions, expected, atol=1e-5)
    np.testing.assert_allclose(result.map.points, 2 * before.map.points @ UPRIGHT.T, atol=1e-3)
    assert np.isfinite(so_far.trajectory.poses_wc).all() and len(so_far.trajectory) == len(result.trajectory)


@pytest.mark.long
def test_frames_without_a_view_are_predicted_and_never_counted_as_tracked() -> None:
    odometry = tracker()
    images = with_samples(dark(frames(16), 12, 16))
    estimates: list[Estimate] = []
    for k, frame in enumerate(images):
        estimates.append(odometry.track(frame))
        if k == 11:
            align(odometry, frame.timestamp)
    black = estimates[12:]
    assert [estimate.status for estimate in black] == [Status.INERTIAL] * 4
    assert all(estimate.reason == "black image" for estimate in black)
    step = np.diff([estimate.pose_wc[:3] for estimate in black], axis=0)  # type: ignore[index]
    np.testing.assert_allclose(step, np.tile(SPEED * 0.1, (3, 1)), atol=1e-6)
    sigmas = [estimate.position_sigma for estimate in black]
    assert sigmas == sorted(sigmas) and sigmas[0] < sigmas[-1]  # type: ignore[type-var,operator]
    result = odometry.finish()
    assert len(result.trajectory) == 16 and len(result.inertial) == 4
    assert result.frames_tracked == 12 and result.frames_lost == 0
    assert result.quality is not None and result.quality.tracked == 12 / 16
    assert set(result.inertial) == {frame.timestamp for frame in images[12:]}


@pytest.mark.long
def test_frames_after_a_dropped_keyframe_are_bridged_too() -> None:
    """With a threshold that no motion passes, the keyframe before the dark is dropped later."""
    odometry = tracker(replace(SMALL, keyframe_motion=1e9))
    for k, frame in enumerate(with_samples(dark(frames(24), 12, 14))):
        odometry.track(frame)
        if k == 11:
            align(odometry, frame.timestamp)
    result = odometry.finish()
    assert len(result.inertial) == 2 and len(result.trajectory) == 24


@pytest.mark.long
@pytest.mark.parametrize(("longest", "nodes"), [(10.0, [9]), (10.0, [9, 11, 12, 14]), (0.1, [9])])
def test_frames_of_a_segment_whose_scale_is_not_told_are_predicted_unless_it_is_long(
    longest: float, nodes: list[int]
) -> None:
    odometry = tracker(replace(SMALL, inertial={"longest": longest}))
    for k, frame in enumerate(with_samples(frames(16))):
        odometry.track(frame)
        if k == 9:
            align(odometry, frame.timestamp)
    for record in odometry.graph.log.frames[11:14]:
        record.segment = 5
    estimator, times = odometry.inertial.estimator, 0.1 * np.array(nodes)
    places = (times - times[0])[:, None] * SPEED
    rows = {name: np.repeat(getattr(estimator.solution, name), len(nodes), 0)
            for name in ("segment", "rotation", "velocity", "gyro_bias", "accel_bias", "log_scale")}  # fmt: skip
    estimator.solution = replace(estimator.solution, times=times, position=places, **rows)  # type: ignore[type-var]
    estimator.untold = {5}
    result = odometry.finish()
    stamps = [0.1 * k for k in range(11, 14)] if longest > 1 else []
    np.testing.assert_allclose(result.inertial, stamps, atol=1e-9)
    if longest > 1:
        steps = np.diff(result.trajectory.positions[11:14], axis=0)
        np.testing.assert_allclose(steps, np.tile(SPEED * 0.1, (2, 1)), atol=1e-6)


@pytest.mark.long
def test_a_frame_that_cannot_be_predicted_either_is_lost_with_a_reason() -> None:
    odometry = tracker()
    for k, frame in enumerate(with_samples(frames(16))):
        odometry.track(frame)
        if k == 9:
            align(odometry, frame.timestamp)
    for record in odometry.graph.log.frames[:3]:  # nothing is known before them
        record.segment = 5
    odometry.inertial.estimator.untold = {5}
    result = odometry.finish()
    assert len(result.trajectory) == 13 and not len(result.inertial)
    assert [entry.reason for entry in result.breaks] == [UNTOLD]


@pytest.mark.long
@pytest.mark.parametrize(("size", "error", "sigma", "taken"),
                         [(1.02, 1.0, 0.01, True), (1.02, 9.0, 0.01, False), (1.5, 1.0, 0.01, False),
                          (1.02, 1.0, 0.2, False), (1.02, 1.0, np.nan, False)])  # fmt: skip
def test_at_the_end_images_and_samples_decide_together(
    size: float, error: float, sigma: float, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[float] = []

    def solved(part: PatchProblem, times: np.ndarray, start: Smoothed, *_: object, **given: Any) -> Solution:
        """A world that is larger, about the same first camera."""
        poses_wc = se3.inverse(part.poses_cw)
        poses_wc[:, :3] = poses_wc[0, :3] + size * (poses_wc[:, :3] - poses_wc[0, :3])
        seen.append(float(given["shutter"].readout))
        depths = part.inverse_depths.view(len(times), -1) / size
        return Solution(part.identifiers, se3.inverse(poses_wc), depths, start, np.log(size), sigma, error)

    results = []
    for stub in (lambda *_, **__: None, solved):
        monkeypatch.setattr("dvo.odometry.patch.inertial_adjustments.adjust_with_samples", stub)
        odometry = tracker()
        for k, frame in enumerate(with_samples(frames(14))):
            odometry.track(replace(frame, camera=replace(frame.camera, readout=0.01)))
            if k == 9:
                align(odometry, frame.timestamp)
        results.append(odometry.finish())
    alone, result = results
    assert seen == [0.01]
    told = result.info["inertial"]["scale_sigma"], result.info["scale"]["segments"][0]["deviation"]
    assert (told == (sigma, sigma)) is taken
    before, after = (run.trajectory.positions - run.trajectory.positions[0] for run in results)
    np.testing.assert_allclose(after, (size if taken else 1.0) * before, atol=1e-5)
    points = alone.map.points - alone.trajectory.positions[0]
    larger = result.map.points - result.trajectory.positions[0]
    np.testing.assert_allclose(larger, (size if taken else 1.0) * points, rtol=1e-3, atol=1e-3)


@pytest.mark.long
def test_without_a_final_adjustment_there_is_none_with_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dvo.odometry.patch.inertial_adjustments.adjust_with_samples", lambda *_, **__: 1 / 0)
    odometry = tracker(replace(SMALL, final_adjustment=False))
    for k, frame in enumerate(with_samples(frames(14))):
        odometry.track(frame)
        if k == 9:
            align(odometry, frame.timestamp)
    assert odometry.finish().metric


@pytest.mark.parametrize("reason", ["", "samples and images do not fit"])
def test_metres_that_samples_do_not_confirm_leave_a_doubt(monkeypatch: pytest.MonkeyPatch, reason: str) -> None:
    odometry = tracker()
    for k, frame in enumerate(with_samples(frames(14))):
        odometry.track(frame)
        if k == 9:
            align(odometry, frame.timestamp)

    def judged(graph: KeyframeGraph, *_: object) -> Quality:
        assert graph.metric  # what is given is judged
        return Quality("good", tracked=1.0)

    monkeypatch.setattr("dvo.odometry.patch.tracker.judge_result", judged)
    monkeypatch.setattr(odometry.inertial.estimator, "settle", lambda *_: None)
    odometry.inertial.estimator.reason = reason
    result = odometry.finish()
    assert result.metric and result.quality is not None
    assert result.quality.verdict == ("doubtful" if reason else "good") and reason in result.quality.reason


@pytest.mark.long
def test_a_world_that_is_not_there_any_more_moves_nothing() -> None:
    once, twice = tracker(), tracker()
    for odometry in (once, twice):
        for k, frame in enumerate(with_samples(frames(14))):
            odometry.track(frame)
            if k == 9:
                align(odometry, frame.timestamp)
    twice.inertial.estimator.worlds[5] = Similarity(9.0, np.eye(3), np.ones(3))
    twice.graph.worlds[5] = 0  # joined by a loop since
    expected, result = once.finish(), twice.finish()
    np.testing.assert_allclose(result.trajectory.poses_wc, expected.trajectory.poses_wc, atol=1e-9)


@pytest.mark.long
def test_poses_in_metres_keep_their_place_when_an_adjustment_moves_the_map() -> None:
    """Into another unit and other axes, beside tracking: the next poses are those without it."""
    change = sim3.exp(torch.tensor([0.5, -0.3, 0.2, 0.1, -0.2, 0.3, 0.4], dtype=torch.float64))
    expected, found = tracker(), tracker()
    for odometry in (expected, found):
        for k, frame in enumerate(with_samples(frames(14))):
            odometry.track(frame)
            if k == 9:
                align(odometry, frame.timestamp)
    graph, loops = found.graph, found.loops
    kept = np.array([frame.identifier for frame in graph.archive if frame.anchor is None])
    moved = sim3.compose(sim3.from_se3(graph.poses_cw(kept)), sim3.inverse(change))
    depths = np.stack([graph.archive[k].inverse_depth for k in kept.tolist()]) * moved[:, 7:].numpy()
    adjusted = Adjusted(kept, moved, depths.astype(np.float32), 1, 1.0, 0.5, 0.0)
    assert loops.adjuster is not None
    apply = partial(loops.adjuster.take, world=0, cause="request", begun=0.0)
    loops.maintenance.job = loops.maintenance.beside("adjustment", lambda: adjusted, apply, 0)
    here, there = (odometry.track(with_samples(frames(15))[14]) for odometry in (expected, found))
    assert loops.adjuster.records and here.pose_wc is not None and there.pose_wc is not None
    assert found.inertial.estimator.worlds[0].scale == pytest.approx(2.0 / float(change[7]))
    np.testing.assert_allclose(there.pose_wc[:3], here.pose_wc[:3], atol=0.02)
    assert np.linalg.norm(rotation_vector(split(there.pose_wc)[0].T @ split(here.pose_wc)[0])) < 0.01


def test_darkness_that_lasts_is_lost() -> None:
    odometry = tracker(replace(SMALL, inertial={"longest": 0.25}))
    statuses = []
    for k, frame in enumerate(with_samples(dark(frames(16), 12, 16))):
        statuses.append(odometry.track(frame).status)
        if k == 11:
            align(odometry, frame.timestamp)
    assert statuses[12:] == [Status.INERTIAL, Status.INERTIAL, Status.LOST, Status.LOST]


def test_samples_may_come_late_and_beside_the_frames() -> None:
    odometry, images = tracker(), with_samples(frames(4))
    for frame in images:
        odometry.track(replace(frame, inertial=None))
    parts = [frame.inertial for frame in images]
    for part in (parts[1], parts[0], parts[3], parts[2], parts[2]):
        assert part is not None
        odometry.add_inertial(part)
    whole = odometry.inertial.estimator.stream.samples()
    assert whole is not None and len(whole) == sum(len(part) for part in parts if part is not None)
    assert (np.diff(whole.timestamps) > 0).all()
    bad = replace(whole, gyro=np.full_like(whole.gyro, np.nan))
    with pytest.raises(DvoError, match="finite"):
        odometry.add_inertial(bad)
    with pytest.raises(DvoError, match="inertial: accel: .*sample 0"):
        odometry.add_inertial(replace(whole, accel=np.full_like(whole.accel, 1e300)))
    for late in (1.7e9, -1.7e9, 1e6):
        with pytest.raises(DvoError, match="inertial: timestamps: samples are .* the newest frame.*one clock"):
            odometry.add_inertial(replace(whole, timestamps=whole.timestamps + late))
    odometry.add_inertial(whole.between(0.0, 0.0))
    same = odometry.inertial.estimator.stream.samples()
    assert same is not None and same.timestamps.tolist() == whole.timestamps.tolist()


def test_samples_of_a_wrong_time_cost_no_others() -> None:
    odometry, images = tracker(), with_samples(frames(4))
    for k, frame in enumerate(images):
        odometry.track(replace(frame, inertial=None))
        part = frame.inertial
        assert part is not None
        if k == 1:
            odometry.add_inertial(replace(part, timestamps=part.timestamps + 5000))
        odometry.add_inertial(part)
        kept = odometry.inertial.estimator.stream.samples()
        assert kept is not None and np.isin(part.timestamps, kept.timestamps).all()
    assert np.isin(images[2].inertial.timestamps, kept.timestamps).all()


def test_samples_that_do_not_meet_the_images_are_told() -> None:
    odometry = tracker()
    for frame in with_samples(frames(28)):
        part = frame.inertial
        assert part is not None
        odometry.track(replace(frame, inertial=replace(part, timestamps=part.timestamps + 100)))
    told = odometry.finish().info["inertial"]["reason"]
    assert told.startswith("too few samples: they are from 100.") or told.startswith(
        "too few samples: they are from 99."
    )
    assert "images from 0." in told


def test_nodes_stand_on_either_side_of_a_break() -> None:
    times = np.concatenate([np.arange(0, 1, 0.05), np.arange(2, 2.5, 0.05)])
    chosen = times[spaced(times, [0] * len(times), 0.2)]
    assert {0.0, 2.0} <= set(chosen.tolist())
    assert any(np.isclose(chosen, 0.95)) and np.isclose(chosen[-1], times[-1])
    assert _runs(np.array([False, True, True, False, True])) == [(1, 3), (4, 5)]


def test_segments_of_a_world_that_comes_again_are_numbered_in_their_order() -> None:
    """The third segment was found in the world of the first one; the smoother takes segments in the order of time."""
    odometry = tracker()
    for frame in with_samples(frames(14)):
        odometry.track(frame)
    for k, record in enumerate(odometry.graph.log.frames):
        record.segment = min(k // 4, 2)
    odometry.graph.worlds.update({1: 1, 2: 0})
    nodes, worlds = odometry.inertial._nodes(-np.inf)
    assert worlds == [0, 1, 0] and len(nodes.depth) == len(nodes)
    assert (np.diff(nodes.segment) >= 0).all() and np.unique(nodes.segment).tolist() == [0, 1, 2]


def test_the_depth_of_a_node_is_that_of_the_keyframe_that_carries_it() -> None:
    odometry = tracker()
    for frame in with_samples(frames(16)):
        odometry.track(frame)
    graph, window = odometry.graph, odometry.window
    assert len(graph.archive) and len(window) > 1
    places = {frame.identifier: place for place, frame in enumerate(window.frames)}
    for anchor in [frame.anchor for frame in graph.log.frames if frame.anchor is not None]:
        if anchor in places:
            patches = window.patches[places[anchor] * graph.per_frame : (places[anchor] + 1) * graph.per_frame]
            with torch.inference_mode():
                patches[:, 2] = 1 / (2.0 + anchor)
        elif not np.allclose(depths := graph.archive[anchor].inverse_depth, 1 / (2.0 + anchor)):
            graph.archive.set_pose(anchor, graph.archive[anchor].pose_cw, np.full_like(depths, 1 / (2.0 + anchor)))
    nodes, _ = odometry.inertial._nodes(-np.inf)
    anchors = [frame.anchor for frame in graph.log.frames if frame.timestamp in set(nodes.times.tolist())]
    assert len(set(anchors)) > 2
    assert np.allclose(nodes.depth, 2.0 + np.array(anchors), rtol=1e-5)


def test_what_is_missing_at_the_end_is_spread_over_the_time() -> None:
    poses = np.tile(IDENTITY, (3, 1))
    goal = np.concatenate([[0.3, 0.0, 0.0], [0.0, 0.0, np.sin(0.2), np.cos(0.2)]])
    led = _led(poses, np.array([1.0, 2.0, 3.0]), 0.0, 4.0, IDENTITY, goal)
    np.testing.assert_allclose(led[:, 0], [0.075, 0.15, 0.225])
    np.testing.assert_allclose(2 * np.arcsin(led[:, 5]), [0.1, 0.2, 0.3])


@pytest.mark.long
def test_the_window_measures_samples_from_the_alignment_on_until_it_is_withdrawn() -> None:
    odometry, measured = tracker(), []
    for k, frame in enumerate(with_samples(frames(18))):
        if k == 9:
            align(odometry, odometry.window.frames[0].timestamp)
        if k == 15:
            odometry.inertial.estimator.state = ScaleState.INITIALISING
            odometry.inertial.estimator.worlds = {}
        assert odometry.track(frame).status in (Status.TRACKING, Status.INITIALISING)
        measured.append(bool(odometry.inertial.coupling.factors(odometry.window)))
    assert measured == [False] * 9 + [True] * 6 + [False] * 3
    assert any("velocity" in frame.states for frame in odometry.window.frames)
