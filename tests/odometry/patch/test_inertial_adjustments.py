"""Adjustments of images and samples beside tracking: map and window take a solution, and two have to agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from dvo.data.inertial import NOISE_PRESETS, InertialSamples
from dvo.geometry import se3
from dvo.geometry.poses import pose_from, rotation_vector, so3_exp, split
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions
from dvo.odometry.global_ba.inertial_adjustment import VisualInertialSolution
from dvo.odometry.inertial.estimator import Similarity
from dvo.odometry.inertial.smoother import GRAVITY, Similarities, Smoothed, VisualNodes
from dvo.odometry.patch.inertial import ADJUST_DELAY, ADJUST_EVERY, _Begun
from dvo.odometry.patch.inertial_adjustments import InertialAdjustment, MetricPath, apply_solution, metres_per_unit
from dvo.odometry.patch.state import Phase
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.odometry.protocol import ScaleState
from tests.support.archived_walk import archived_walk, pose_at
from tests.support.steady_samples import IDENTITY, UPRIGHT, align, with_samples
from tests.support.tiny_tracker import frames, tracker

KNOWN = Similarity(2.0, so3_exp(np.array([-1.2, 0.3, 0.4])), np.array([3.0, -1.0, 0.5]))
SIGMA = 0.01


def states_at(times: np.ndarray, poses_wc: np.ndarray, sigma: float = 0.1) -> Smoothed:
    """States of nodes at camera poses in metres, at rest."""
    rotation, position = split(poses_wc)
    count, zero = len(times), np.zeros((len(times), 3))
    worlds = Similarities(np.zeros(1), np.eye(3)[None], np.zeros((1, 3)))
    return Smoothed(
        times, np.zeros(count, int), rotation, position, zero, zero, zero, np.zeros(count), worlds, 0.0, np.eye(3),
        np.zeros(3), 1.0, sigma**2 * np.eye(19 + 8), 0.0, 0.0, np.zeros(3),
    )  # fmt: skip


def in_metres(graph: KeyframeGraph, known: Similarity, scale: float = 1.0, sigma: float = SIGMA):
    """All keyframes of a graph as the solution of an adjustment, larger than a known similarity says."""
    whole = graph.copy()
    whole.archive_window()
    identifiers = torch.tensor([keyframe.identifier for keyframe in whole.archive])
    rotation, position = split(se3.inverse(whole.poses_cw(identifiers.numpy())).numpy())
    poses_wc = pose_from(known.rotation @ rotation, scale * known.points(position))
    depths = np.stack([whole.archive[k].inverse_depth for k in identifiers.tolist()]) / (known.scale * scale)
    times = np.array([whole.archive[k].timestamp for k in identifiers.tolist()])
    return VisualInertialSolution(
        identifiers, se3.inverse(torch.from_numpy(poses_wc)), torch.from_numpy(depths.astype(np.float64)),
        states_at(times, poses_wc), 0.0, sigma, 0.5,
    )  # fmt: skip


def walk() -> KeyframeGraph:
    graph, _ = archived_walk(frames=14, dropped=(4, 5, 9), archived=False)
    for _ in range(5):
        graph.archive_oldest()
    return graph


def newest(graph: KeyframeGraph) -> np.ndarray:
    return se3.inverse(graph.window.poses_cw[-1].double()).numpy()


def test_without_a_known_similarity_the_newest_keyframe_keeps_pose_and_unit() -> None:
    graph = walk()
    before, depths = newest(graph), graph.window.patches[-8:, 2].clone()
    solution = in_metres(graph, KNOWN)
    assert metres_per_unit(graph, 0, solution) == pytest.approx(KNOWN.scale, rel=1e-5)
    applied = apply_solution(graph, 0, solution, None)
    assert applied is not None
    assert np.allclose(newest(graph), before, atol=1e-5) and torch.allclose(graph.window.patches[-8:, 2], depths)
    assert applied.similarity.scale == pytest.approx(KNOWN.scale, rel=1e-5)
    assert np.allclose(applied.similarity.rotation, KNOWN.rotation, atol=1e-5)
    assert np.allclose(applied.similarity.translation, KNOWN.translation, atol=1e-3)


def test_in_a_metric_world_the_newest_keyframe_keeps_place_and_heading_and_takes_tilt_and_scale() -> None:
    graph, tilt = walk(), so3_exp(np.array([0.1, -0.05, 0.0]))
    turned = Similarity(KNOWN.scale, so3_exp(np.array([0, 0, 0.7])) @ tilt @ KNOWN.rotation, np.array([9.0, 1.0, 4.0]))
    place = KNOWN.points(split(newest(graph))[1])
    shape = [solution_positions(in_metres(graph, turned, 1.1))]
    applied = apply_solution(graph, 0, in_metres(graph, turned, 1.1), KNOWN)
    assert applied is not None
    rotation, position = split(newest(graph))
    assert applied.similarity is KNOWN and np.allclose(KNOWN.points(position), place, atol=1e-4)
    assert np.allclose(applied.states.position[-1], place, atol=1e-4)
    assert np.allclose(applied.states.rotation[-1], KNOWN.rotation @ rotation, atol=1e-5)
    assert np.allclose(applied.states.rotation[-1][2], (tilt @ KNOWN.rotation @ split(newest(walk()))[0])[2], atol=1e-3)
    shape.append(solution_positions(in_metres(graph, KNOWN)))
    lengths = [np.linalg.norm(np.diff(positions, axis=0), axis=1) for positions in shape]
    assert np.allclose(*lengths, rtol=1e-3)


def solution_positions(solution: VisualInertialSolution) -> np.ndarray:
    return se3.inverse(solution.poses_cw)[:, :3].numpy()


def unsure(odometry: PatchOdometry) -> Callable[[int], tuple[Smoothed, VisualNodes | None]]:
    """In place of :meth:`InertialEstimator.to_be_adjusted`: an estimate that is not sure, of all nodes so far."""

    def start(world: int) -> tuple[Smoothed, VisualNodes | None]:
        nodes, _ = odometry.inertial._nodes(-np.inf)
        poses_wc = pose_from(nodes.rotation, nodes.position)
        return states_at(nodes.times, poses_wc), nodes

    return start


@pytest.mark.parametrize(("sigmas", "aligned"), [([0.01, 0.01], True), ([0.01, 0.2, 0.01], False), ([0.2] * 4, False)])
def test_two_solutions_in_a_row_align(monkeypatch: pytest.MonkeyPatch, sigmas: list[float], aligned: bool) -> None:
    odometry, left, begun = tracker(), list(sigmas), []
    odometry.inertial.estimator.to_be_adjusted = unsure(odometry)  # type: ignore[method-assign]
    odometry.inertial.estimator.update = lambda nodes, worlds: None  # type: ignore[method-assign]
    known = Similarity(2.0, UPRIGHT, np.zeros(3))

    def solve(self: InertialAdjustment) -> VisualInertialSolution | None:
        begun.append(max(frame.timestamp for frame in self.graph.archive))
        assert isinstance(self.graph, KeyframeGraph)
        return in_metres(self.graph, known, sigma=left.pop(0)) if left else None

    monkeypatch.setattr(InertialAdjustment, "solve", solve)
    # The unit of an untrained network drifts by more than two solutions may differ.
    monkeypatch.setattr("dvo.odometry.patch.inertial.metres_per_unit", lambda *_: 2.0)
    count = round(len(sigmas) * 10 * ADJUST_EVERY) + 2 * ADJUST_DELAY + 8
    states = []
    for frame in with_samples(frames(count)):
        if states and states[-1] is ScaleState.ALIGNED:
            break
        states.append(odometry.track(frame).scale_state)
    assert not left and np.diff(begun).min() >= ADJUST_EVERY - 1e-6
    assert (states[-1] is ScaleState.ALIGNED) == aligned
    if aligned:
        assert np.allclose(odometry.inertial.estimator.worlds[0].rotation[2], UPRIGHT[2], atol=0.1)
        assert odometry.inertial.estimator.information()["history"][-1]["event"] == "aligned"


def test_a_solution_of_another_world_is_not_taken() -> None:
    odometry = tracker()
    for frame in with_samples(frames(20)):
        odometry.track(frame)
    solution = in_metres(odometry.graph, KNOWN)
    tracking = odometry.inertial
    tracking.estimator._adjusted = np.log(2.0), SIGMA  # the one before
    before = odometry.window.poses_cw.clone()
    assert not tracking._apply(_Begun(1, 1, False), solution)
    assert not tracking._apply(_Begun(0, 0, True), solution)
    assert not tracking._apply(_Begun(0, 0, False), None)
    assert torch.equal(odometry.window.poses_cw, before)
    assert tracking._apply(_Begun(0, 0, False), replace(solution, scale_sigma=0.01))
    assert tracking.estimator.aligned


def recorded(scale: float, until: float) -> InertialSamples:
    """Samples of a sensor in the camera of the walk, whose unit is so many metres long, 200 a second."""
    times, step = np.arange(-0.2, until + 0.2, 0.005), 1e-3

    def moved(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rotation, position = split(se3.inverse(pose_at(torch.from_numpy(t))).numpy())
        return UPRIGHT @ rotation, scale * position @ UPRIGHT.T

    (rotation, position), before, after = moved(times), moved(times - step), moved(times + step)
    acceleration = (before[1] - 2 * position + after[1]) / step**2
    turned = rotation_vector(np.swapaxes(before[0], -1, -2) @ after[0]) / (2 * step)
    forces = np.einsum("nji,nj->ni", rotation, acceleration - GRAVITY)
    return InertialSamples(times, turned, forces, IDENTITY, NOISE_PRESETS["euroc"])


@pytest.mark.parametrize("since", [-np.inf, 1.95])
def test_the_adjustment_of_a_part_of_the_map_finds_its_motion_in_metres(since: float) -> None:
    """The unit of the visual poses drifts by half over the walk, and the start takes it as 1.8 m for 2 m."""
    graph, truth = archived_walk(frames=40, dropped=(7, 20))
    similarity = Similarity(1.8 / 1.25, UPRIGHT, np.zeros(3))
    times = truth.timestamps
    poses_wc = pose_from(UPRIGHT @ split(truth.poses_wc)[0], similarity.points(split(truth.poses_wc)[1]))
    start = replace(states_at(times, poses_wc), velocity=np.gradient(poses_wc[:, :3], times, axis=0))
    work = InertialAdjustment(
        graph, 0, start, MetricPath.constant(similarity), recorded(2.0, times[-1]), NOISE_PRESETS["euroc"], 1e-4, 0.2,
        AdjustmentOptions(), since=since,
    )  # fmt: skip
    found = work.solve()
    assert found is not None
    wanted = times >= since
    assert found.identifiers.tolist() == np.flatnonzero(wanted).tolist()
    positions, true = solution_positions(found), 2.0 * split(truth.poses_wc)[1][wanted]
    lengths = [np.linalg.norm(p[5:] - p[:-5], axis=1) for p in (positions, true)]
    assert np.allclose(*lengths, rtol=0.01) and found.scale_sigma < 0.02
    up = split(se3.inverse(found.poses_cw).numpy())[0][:, 2]
    assert np.allclose(up, (UPRIGHT @ split(truth.poses_wc)[0][wanted])[:, 2], atol=5e-3)


def test_a_solution_whose_keyframes_are_gone_is_not_taken() -> None:
    """As of a camera that stands still for long: the frames of the last seconds have been dropped meanwhile."""
    odometry = tracker()
    for frame in with_samples(frames(20)):
        odometry.track(frame)
    tracking, graph = odometry.inertial, odometry.graph
    whole = in_metres(graph, KNOWN)
    for gone in (np.array([10_000]), np.array([k.identifier for k in graph.archive if k.anchor is not None][:1])):
        solution = replace(
            whole, identifiers=torch.from_numpy(gone), poses_cw=whole.poses_cw[: len(gone)],
            depths=whole.depths[: len(gone)],
        )  # fmt: skip
        assert metres_per_unit(graph, 0, solution) is None and apply_solution(graph, 0, solution, KNOWN) is None
        before = odometry.window.poses_cw.clone()
        assert not tracking._apply(_Begun(0, 0, False), solution) and not tracking.estimator.aligned
        assert torch.equal(odometry.window.poses_cw, before)


@pytest.mark.parametrize("end", ["complete", "lost"])
def test_searches_go_on_where_no_adjustment_follows(end: str) -> None:
    odometry = tracker()
    for frame in with_samples(frames(12)):
        odometry.track(frame)
    odometry.loops.maintenance.awaited = True
    if end == "complete":
        odometry.finish()
    else:
        odometry.state.phase = Phase.INITIALISING
        odometry.track(with_samples(frames(13))[12])
    assert not odometry.loops.maintenance.awaited


def test_a_pose_whose_scale_is_unsure_is_not_called_aligned() -> None:
    odometry = tracker()
    for frame in with_samples(frames(12)):
        odometry.track(frame)
    estimator = odometry.inertial.estimator
    align(odometry, 1.1)
    assert estimator.scale_sigma == pytest.approx(1e-3 * np.sqrt(2), rel=0.01)
    solution = estimator.solution
    assert solution is not None
    covariance = solution.covariance.copy()
    covariance[-4, -4] = 0.15**2
    estimator._follow(replace(solution, covariance=covariance))
    told = odometry.track(with_samples(frames(13))[12])
    assert told.inertial is not None and told.inertial.scale_sigma == pytest.approx(0.15, rel=0.01)
    assert told.scale_state is ScaleState.INITIALISING and odometry.inertial.estimator.aligned
