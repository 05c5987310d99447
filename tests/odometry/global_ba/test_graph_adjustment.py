"""Global adjustment of an archived graph: bounds, what is held and carried, and that it never makes things worse."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import dvo
from dvo.core.errors import DvoError
from dvo.geometry import se3, sim3
from dvo.map.map import Recording
from dvo.map.measurements import ArchivedEdges
from dvo.metrics import evaluate
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions
from dvo.odometry.global_ba.graph_adjustment import AdjustmentLimits, apply, prepare
from dvo.odometry.global_ba.rolling_shutter import Shutter
from dvo.odometry.maintenance.adjuster import Adjuster
from dvo.odometry.maintenance.background import Background
from tests.support.archived_walk import M, archived_walk

GLOBAL = Shutter(0.0, 60.0)
DROPPED = (7, 8, 20)
LIMITS = AdjustmentLimits(iterations=20)


def prepared(graph, limits=LIMITS, shutter=GLOBAL):
    return prepare(graph, 0, shutter, AdjustmentOptions(), limits)


def state(graph):
    """All poses and depths."""
    frames = list(graph.archive)
    depths = [f.inverse_depth for f in frames]
    return graph.poses_cw(np.array([f.identifier for f in frames])).numpy(), np.stack(depths)


def cost(graph):
    return prepared(graph, AdjustmentLimits(iterations=1)).solve().cost_before


def test_poses_and_depths_are_found_from_a_snapshot():
    graph, truth = archived_walk(wrong=0.1, dropped=DROPPED)
    before, rough = state(graph), evaluate(graph.log.trajectory(), truth).ate_percent
    solved = [prepared(graph).solve() for _ in range(2)]
    for mine, other in zip(before, state(graph), strict=True):
        assert np.array_equal(mine, other)  # nothing yet
    assert np.array_equal(solved[0].inverse_depths, solved[1].inverse_depths)
    assert torch.equal(solved[0].similarities, solved[1].similarities)
    assert solved[0].better and solved[0].cost_before == cost(graph)
    unit = apply(graph, 0, solved[0]).units
    assert list(solved[0].identifiers) == list(range(1, 40)) and list(unit) == [
        k for k in range(1, 40) if k not in DROPPED
    ]
    assert cost(graph) == pytest.approx(solved[0].cost, rel=1e-4)  # depths are rounded to float32
    assert evaluate(graph.log.trajectory(), truth).ate_percent < 0.1 < 1 < rough
    assert graph.archive[8].anchor == 7 and graph.archive[7].anchor == 6


@settings(max_examples=5, deadline=None)
@given(st.floats(0, 0.5), st.integers(1, 3), st.integers(5, 25))
def test_the_cost_never_increases(wrong, iterations, frames):
    graph, _ = archived_walk(frames=frames, wrong=wrong)
    before = cost(graph)
    limits = AdjustmentLimits(iterations=iterations)
    adjuster = Adjuster(graph, Shutter, AdjustmentOptions())
    adjuster.take(Background().start(prepared(graph, limits).solve).result(), 0, "loop", 0.0)
    assert cost(graph) <= before * (1 + 1e-6)
    (record,) = adjuster.records
    assert record.cost_before == before and record.accepted == (record.cost < before)


def test_a_solution_that_is_no_better_changes_nothing():
    graph, _ = archived_walk()
    before, found = state(graph), prepared(graph).solve()
    adjuster = Adjuster(graph, Shutter, AdjustmentOptions())
    worse = replace(found, cost=found.cost_before)
    assert not adjuster.take(worse, 0, "request", 1.5)
    for mine, other in zip(before, state(graph), strict=True):
        assert np.array_equal(mine, other)
    (entry,) = adjuster.information()["adjustments"]
    assert not entry["accepted"] and entry["begun"] == 1.5 and entry["keyframes"] == 39


@pytest.mark.parametrize("limits", [{"frames": 15}, {"edges": 15 * M * 10}])
def test_keyframes_beyond_the_bounds_are_held(limits):
    graph, _ = archived_walk(dropped=DROPPED)
    before = state(graph)
    found = prepared(graph, replace(LIMITS, **limits)).solve()
    assert found.better and 5 < len(found.identifiers) <= 25 and found.identifiers[-1] == 39
    if "edges" in limits:
        assert found.edges <= limits["edges"]
    else:
        assert len(found.identifiers) == 15
    apply(graph, 0, found)
    first = found.identifiers[0]
    for mine, other in zip(before, state(graph), strict=True):
        assert np.array_equal(mine[:first], other[:first])
        assert not np.isclose(mine[first:], other[first:], rtol=1e-6, atol=1e-9).all(-1).any()


def test_the_keyframes_of_a_map_are_held():
    graph, _ = archived_walk()
    graph.recordings.append(Recording(frame=20, keyframe=20, segment=0))
    before, found = state(graph), prepared(graph).solve()
    assert found.identifiers[0] == 20
    apply(graph, 0, found)
    for mine, other in zip(before, state(graph), strict=True):
        assert np.array_equal(mine[:20], other[:20])


def test_what_is_archived_later_and_the_window_move_along():
    graph, _ = archived_walk(archived=False)
    for _ in range(20):
        graph.archive_oldest()
    found = prepared(graph).solve()
    assert found.identifiers[-1] == 19
    for _ in range(3):
        graph.archive_oldest()
    graph.drop(1)  # 24, relative to 23 in the window

    def positions():
        archived = graph.poses_cw(np.array([19, 20, 21, 22]))
        return torch.cat([archived, graph.window.poses_cw.double()])

    def steps():
        poses = positions()
        return se3.relative(poses[:1].expand_as(poses[1:]), poses[1:])

    before, depths = steps(), graph.window.patches[:, 2].clone()
    dropped, later = graph.archive[24].pose_cw[:3].copy(), graph.archive[22].inverse_depth
    newest = se3.inverse(graph.window.poses_cw.double())
    moved = apply(graph, 0, found)
    unit, (carried,) = moved.units, moved.worlds
    scale = unit[19]
    assert carried.window and carried.world == 0 and carried.time == graph.archive[22].timestamp
    assert float(carried.change[7]) == pytest.approx(1 / scale)
    expected = se3.inverse(graph.window.poses_cw.double())
    assert torch.allclose(sim3.act_on_pose(carried.change, newest)[:, :3], expected[:, :3], atol=1e-5)
    assert abs(scale - 1) > 0.01 and unit[22] == pytest.approx(scale)
    assert torch.allclose(steps()[:, 3:], before[:, 3:], atol=1e-6)
    assert torch.allclose(steps()[:, :3], before[:, :3] / scale, atol=1e-5)
    assert torch.allclose(graph.window.patches[:, 2], depths * scale, rtol=1e-6)
    np.testing.assert_allclose(graph.archive[24].pose_cw[:3], dropped / scale, rtol=1e-6)
    np.testing.assert_allclose(graph.archive[22].inverse_depth, later * scale, rtol=1e-6)


def test_patches_that_were_released_meanwhile_stay_released():
    graph, _ = archived_walk()
    found, before = prepared(graph).solve(), graph.poses_cw(np.array([39]))
    graph.archive.config = replace(graph.archive.config, max_bytes=0)
    one = np.zeros(1, np.int32)
    graph.archive.add_edges(
        ArchivedEdges(one, one.astype(np.int16), one, np.zeros((1, 2), np.float32), np.ones((1, 2), np.float16))
    )
    apply(graph, 0, found)
    assert graph.archive.nbytes == 0 and not any(len(f.inverse_depth) for f in graph.archive)
    assert not torch.allclose(graph.poses_cw(np.array([39])), before, atol=1e-3)


def test_a_rolling_shutter_is_taken_into_account():
    graph, truth = archived_walk(readout=0.08)
    apply(graph, 0, prepared(graph, None).solve())
    plain = evaluate(graph.log.trajectory(), truth).ate_percent
    graph, _ = archived_walk(readout=0.08)
    found = prepared(graph, None, Shutter(0.08, 60.0)).solve()
    apply(graph, 0, found)
    assert found.better and evaluate(graph.log.trajectory(), truth).ate_percent < 0.5 * plain


def test_a_short_or_unknown_world_is_left_alone():
    graph, _ = archived_walk(frames=2)
    adjuster = Adjuster(graph, Shutter, AdjustmentOptions())
    for world in (0, 5):
        task = Background().start(prepare(graph, world, GLOBAL, AdjustmentOptions()).solve)
        assert not task.result().better
        assert not adjuster.take(task.result(), world, "request", 0.0)
    assert adjuster.information() == {}
    assert replace(adjuster, after_loop=True).information() == {"adjustments": []}


def test_a_request_before_the_first_frame_and_after_the_last_one():
    odometry = dvo.load("small", device="cpu")
    assert odometry.adjust() == ()
    odometry.finish()
    with pytest.raises(DvoError, match="finished"):
        odometry.adjust()
