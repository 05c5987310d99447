"""Scale in metres: from measured depths, from distances, from the height over the ground."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.map.correction import rescale
from dvo.map.measurements import depth_factors
from dvo.metrics import evaluate
from dvo.odometry.depth.depth_factor import measured_share, to_measured
from dvo.odometry.depth.scale_options import ScaleOptions
from dvo.odometry.global_ba.final_adjustment import adjust_segment
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.scale.ground_plane import ground_height, plane_below
from dvo.odometry.scale.metric_scale import scale_of_distances, settle_scale
from tests.support.archived_walk import archived_walk


def scale_of(graph, truth):
    return evaluate(graph.log.trajectory(), truth).scale


@pytest.mark.parametrize("unit", [0.9, 2.5])
def test_measured_depths_decide_the_scale_of_the_final_adjustment(unit):
    """Far from the start, too: iterations alone would take the measured depths for outliers there."""
    graph, truth = archived_walk(unit=unit)
    adjust_segment(graph, 0)
    info = settle_scale(graph, [0], ScaleOptions(depth=True))["scale"]
    assert scale_of(graph, truth) == pytest.approx(1 / unit, rel=1e-3)
    assert evaluate(graph.log.trajectory(), truth).ate_percent < 0.05
    (entry,) = info["segments"]
    assert info["unit"] == "metres" and entry["source"] == info["source"] == "depth"
    assert graph.metric == {0: "depth"}


def test_depths_of_other_surfaces_have_no_influence():
    graph, truth = archived_walk(unit=2.0)
    for frame in list(graph.archive):
        measured = frame.measured.copy()
        measured[:2, 0] *= 3.0
        graph.archive.set_measured(frame.identifier, measured)
    adjust_segment(graph, 0)
    assert scale_of(graph, truth) == pytest.approx(0.5, rel=0.01)


def test_too_few_measured_depths_are_told():
    graph, _ = archived_walk(unit=2.0, frames=10)
    for frame in list(graph.archive):
        measured = frame.measured.copy()
        measured[(1 if frame.identifier else 2) :] = 0
        graph.archive.set_measured(frame.identifier, measured)
    info = settle_scale(graph, [0], ScaleOptions(depth=True))["scale"]
    assert info["unit"] == "arbitrary" and "too few" in info["segments"][0]["problem"] and not graph.metric


def test_a_graph_is_rescaled_with_its_dropped_keyframes_and_points():
    graph, _ = archived_walk(dropped=(5, 11))
    before, (points, _) = graph.log.trajectory(), graph.points()
    assert set(rescale(graph, 0, 3.0).values()) == {1 / 3}
    after = graph.log.trajectory()
    np.testing.assert_allclose(after.positions, 3 * before.positions, atol=1e-9)
    np.testing.assert_allclose(after.poses_wc[:, 3:], before.poses_wc[:, 3:], atol=1e-9)
    np.testing.assert_allclose(graph.points()[0], 3 * points, rtol=1e-4, atol=1e-4)


def test_known_distances_give_the_scale_and_several_its_deviation():
    graph, truth = archived_walk()
    adjust_segment(graph, 0)
    trajectory = graph.log.trajectory()

    def metres(first, last, factor=2.0):
        ends = np.interp([first, last], truth.timestamps, np.arange(len(truth)))
        a, b = truth.positions[np.round(ends).astype(int)]
        return (first, last, factor * float(np.linalg.norm(b - a)))

    one = scale_of_distances(trajectory, [metres(0.5, 3.0)])
    assert one.found and math.isnan(one.deviation) and one.observations == 1
    several = [metres(0.5, 3.0), metres(0.0, 1.5, 2.02), metres(1.0, 3.9, 1.99), metres(50.0, 60.0)]
    two = scale_of_distances(trajectory, several)
    assert two.observations == 3 and two.factor == pytest.approx(one.factor, rel=0.02)
    assert 0.001 < two.deviation < 0.02
    info = settle_scale(graph, [0], ScaleOptions(distances=(metres(0.5, 3.0),)))["scale"]
    assert scale_of(graph, truth) == pytest.approx(0.5, rel=1e-3) and info["source"] == "distance"
    after = graph.log.trajectory()
    moved = np.linalg.norm(after.positions[30] - after.positions[5])
    assert moved == pytest.approx(metres(0.5, 3.0)[2], rel=1e-6)


@pytest.mark.parametrize(("asked", "problem"), [((50.0, 60.0, 1.0), "cover 50 to 60"), ((0.0, 0.1, 1.0), "not move")])
def test_a_distance_that_cannot_be_used_is_told(asked, problem):
    graph, _ = archived_walk(frames=6)
    if problem == "not move":
        for frame in list(graph.archive):
            graph.correct(frame.identifier, np.array([0.0, 0, 0, 0, 0, 0, 1]))
    info = settle_scale(graph, [0], ScaleOptions(distances=(asked,)))["scale"]
    assert info["unit"] == "arbitrary" and problem in info["segments"][0]["problem"]


def floor(rng, height, tilt_deg=10.0, count=60, others=30, noise=0.01):
    """Points of a floor below a tilted camera, and of things that stand on it."""
    a = math.radians(tilt_deg)
    turn = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    plane = np.column_stack([rng.uniform(-3, 3, count), np.full(count, 1.0), rng.uniform(1, 6, count)])
    plane[:, 1] += noise * rng.standard_normal(count)
    above = np.column_stack([rng.uniform(-3, 3, others), rng.uniform(-1, 0.9, others), rng.uniform(1, 6, others)])
    return height * np.concatenate([plane, above]) @ turn.T


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.floats(0.1, 10), st.floats(-20, 20))
def test_the_ground_is_found_at_any_scale_and_tilt(seed, height, tilt):
    rng = np.random.default_rng(seed)
    found = plane_below(floor(rng, height, tilt), 30.0, rng)
    assert found == pytest.approx(height, rel=0.03)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_the_ground_is_found_where_it_is_smooth_and_measured_roughly(seed):
    """Heights of the points are wrong by 6 %, those of a road on kitti00_120 by about a tenth."""
    rng = np.random.default_rng(seed)
    found = plane_below(floor(rng, 1.65, 2.0, count=50, others=40, noise=0.06), 30.0, rng)
    assert found == pytest.approx(1.65, rel=0.08)


def test_points_near_the_horizon_are_no_ground():
    """The facades far ahead have most of the patches of a street, and lie below the camera as often as above it."""
    graph, _ = archived_walk(unit=0.0)
    height, frames = 0.7, list(graph.archive)
    for frame in frames:
        rng, centres = np.random.default_rng(frame.identifier), frame.centres.copy()
        fx, fy, cx, cy = frame.intrinsics.astype(float)
        centres[:, 1] = rng.integers(int(cy) + 8, 54, len(centres))
        depth = (centres[:, 1] - cy) / fy / height
        far = np.arange(len(centres)) % 4 > 0
        centres[far, 1] = cy + rng.uniform(0, 0.06, far.sum()) * fy
        depth[far] = rng.uniform(0.3, 0.5, far.sum()) * np.median(depth)
        graph.archive.add(frame.__class__(**{**frame.__dict__, "centres": centres}))
        level = np.array([-0.1 * frame.identifier, 0, 0, 0, 0, 0, 1.0])
        graph.correct(frame.identifier, level, depth.astype(np.float32))
    found = ground_height(list(graph.archive), graph.poses_cw(np.arange(len(frames))).numpy(), 30.0)
    assert found.keyframes == found.looked_at
    assert found.height == pytest.approx(height, rel=0.02)


def test_no_ground_without_a_plane_or_too_steep_or_with_points_below_it():
    rng = np.random.default_rng(0)
    assert plane_below(rng.uniform(-1, 1, (100, 3)) + [0, 0, 3], 30.0, rng) is None
    assert plane_below(floor(rng, 1.0)[:8], 30.0, rng) is None
    assert plane_below(floor(rng, 1.0, tilt_deg=45), 30.0, rng) is None
    table = floor(rng, 1.0, tilt_deg=0)
    deep = np.column_stack([rng.uniform(-3, 3, 40), rng.uniform(1.5, 4, 40), rng.uniform(1, 6, 40)])
    assert plane_below(np.concatenate([table, deep]), 30.0, rng) is None


def test_the_height_scales_a_walk_over_the_ground():
    """Every patch of the walk is put on a plane below the camera, which is level."""
    graph, _ = archived_walk(unit=0.0)
    height = 0.7
    frames = list(graph.archive)
    for frame in frames:
        centres = frame.centres.copy()
        centres[:, 1] = np.random.default_rng(frame.identifier).integers(36, 54, len(centres))
        depth = (centres[:, 1] - 30) / 40 / height
        graph.archive.add(frame.__class__(**{**frame.__dict__, "centres": centres}))
        level = np.array([-0.1 * frame.identifier, 0, 0, 0, 0, 0, 1.0])
        graph.correct(frame.identifier, level, depth.astype(np.float32))
    found = ground_height(list(graph.archive), graph.poses_cw(np.arange(len(frames))).numpy(), 30.0)
    assert found.height == pytest.approx(height, rel=0.01) and found.spread < 0.01
    before = graph.log.trajectory().path_length
    info = settle_scale(graph, [0], ScaleOptions(height=1.4))["scale"]
    assert graph.log.trajectory().path_length == pytest.approx(2 * before, rel=0.02)
    assert info["segments"][0]["factor"] == pytest.approx(2.0, rel=0.02)


def test_a_walk_without_a_ground_keeps_its_scale_and_says_so():
    graph, _ = archived_walk()
    before = graph.log.trajectory().poses_wc
    info = settle_scale(graph, [0], ScaleOptions(height=1.4))["scale"]
    assert "no ground plane" in info["segments"][0]["problem"]
    assert np.array_equal(graph.log.trajectory().poses_wc, before)


def test_without_a_source_nothing_is_told_and_several_are_refused():
    graph, _ = archived_walk(frames=6)
    assert settle_scale(graph, [0], ScaleOptions()) == {}
    with pytest.raises(DvoError, match="scale"):
        ScaleOptions(depth=True, height=1.0)
    with pytest.raises(DvoError, match="distances"):
        ScaleOptions(distances=((2.0, 1.0, 3.0),))
    with pytest.raises(DvoError, match="scale"):
        TrackerConfig(scale={"deep": True})
    assert TrackerConfig(scale={"distances": [[0.0, 1.0, 2.0]]}).scale.source == "distance"


def test_factors_of_measured_patches_alone():
    assert depth_factors(None) == () and depth_factors(torch.zeros(3, 2)) == ()
    measured = torch.tensor([[0.5, 2.0], [0.0, 0.0], [0.25, 4.0]])
    (factor,) = depth_factors(measured)
    assert factor.index.tolist() == [0, 2] and factor.value.tolist() == [[0.5, 0.25]]
    assert measured_share(measured) == pytest.approx(2 / 3)


def test_a_solution_far_from_the_measured_depths_is_scaled_to_them():
    poses = se3.exp(torch.randn(4, 6, generator=torch.Generator().manual_seed(0)))
    depths = torch.full((8,), 1.0)
    measured = torch.tensor([[0.25, 1.0]] * 6 + [[0.0, 0.0]] * 2)
    moved, scaled = to_measured(poses, depths, measured)
    torch.testing.assert_close(moved[:, :3], 4 * poses[:, :3])
    torch.testing.assert_close(scaled, depths / 4)
    near = torch.tensor([[0.99, 1.0]] * 8)
    assert to_measured(poses, depths, near)[0] is poses
