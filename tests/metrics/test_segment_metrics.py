"""dvo.metrics.segment_metrics: each world aligned on its own, combined over frames, and not gained by cutting."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory
from dvo.metrics import evaluate
from dvo.metrics.segment_metrics import SEGMENT_POSES, evaluate_segments, match_worlds, most_worlds, rows_of
from tests.support.trajectories import cut, moved, segment


def walk(count: int = 120, seed: int = 0) -> Trajectory:
    """A smooth random camera path, 10 Hz."""
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal(0.1, 0.2, (count, 3)), axis=0)
    rotations = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.1, (count, 3)), axis=0))
    return Trajectory(np.arange(count) / 10, np.column_stack([positions, rotations.as_quat()]))


def shaken(trajectory: Trajectory, by: float, seed: int = 1) -> Trajectory:
    """With noise on the positions."""
    noise = np.random.default_rng(seed).normal(0, by, (len(trajectory), 3))
    return Trajectory(trajectory.timestamps, trajectory.poses_wc + np.column_stack([noise, np.zeros((len(noise), 4))]))


def test_one_segment_is_an_ordinary_trajectory():
    truth = walk()
    estimate = shaken(moved(rows_of(truth, np.arange(0, 120, 2)), 0.3, 1.0), 0.01)
    found = evaluate_segments([segment(estimate)], truth, rpe_gap=2)
    assert asdict(found.metrics) == asdict(evaluate(estimate, truth, rpe_gap=2))
    assert found.segments == (found.metrics,) and found.scored == (True,) and found.scored_share == 1.0


def test_each_segment_has_a_world_of_its_own():
    truth = walk()
    first, second = cut(truth, 50)
    found = evaluate_segments([segment(moved(first, 0.5, 1.0)), segment(moved(second, 4.0, -2.0))], truth)
    assert found.metrics.ate_rmse == pytest.approx(0, abs=1e-9)
    assert found.metrics.rpe_trans_rmse == pytest.approx(0, abs=1e-9)
    assert found.metrics.rpe_rot_deg_rmse == pytest.approx(0, abs=1e-5)
    assert [one.scale for one in found.segments] == pytest.approx([2.0, 0.25])
    assert (found.metrics.matched, found.metrics.completeness, found.worlds) == (120, 1.0, 2)
    assert found.metrics.path_length == pytest.approx(first.path_length + second.path_length)
    # one trajectory with a jump of world in it is wrong
    joined = Trajectory(
        truth.timestamps, np.concatenate([moved(first, 0.5, 1.0).poses_wc, moved(second, 4.0, -2.0).poses_wc])
    )
    assert evaluate(joined, truth).ate_percent > 5


def test_values_are_combined_by_frames():
    truth = walk()
    parts = cut(truth, 30)
    rough = [shaken(parts[0], 0.3), shaken(parts[1], 0.02, seed=2)]
    each = [evaluate(*pair) for pair in zip(rough, parts, strict=True)]
    found = evaluate_segments([segment(part) for part in rough], truth)
    squares = 30 * each[0].ate_rmse ** 2 + 90 * each[1].ate_rmse ** 2
    assert found.metrics.ate_rmse == pytest.approx(math.sqrt(squares / 120))
    assert found.metrics.ate_percent == pytest.approx(
        100 * found.metrics.ate_rmse / (parts[0].path_length + parts[1].path_length)
    )
    moves = 29 * each[0].rpe_trans_rmse ** 2 + 89 * each[1].rpe_trans_rmse ** 2
    assert found.metrics.rpe_trans_rmse == pytest.approx(math.sqrt(moves / 118))
    assert [one.ate_rmse for one in found.segments] == pytest.approx([one.ate_rmse for one in each])
    assert found.metrics.scale == pytest.approx(each[1].scale)


def test_joined_segments_share_one_alignment():
    truth = walk()
    first, dark, last = cut(truth, 40, 50)
    del dark
    own = [segment(first), segment(moved(last, 3.0, 1.0))]
    assert evaluate_segments(own, truth).metrics.ate_rmse == pytest.approx(0, abs=1e-9)
    joined = [own[0], replace(own[1], joined_to=0)]
    found = evaluate_segments(joined, truth)
    assert found.worlds == 1 and found.metrics.ate_percent > 2
    assert [one.scale for one in found.segments] == [found.metrics.scale] * 2
    right = [segment(moved(first, 3.0, 1.0)), segment(moved(last, 3.0, 1.0), joined_to=0)]
    found = evaluate_segments(right, truth, rpe_gap=5)
    assert found.metrics.ate_rmse == pytest.approx(0, abs=1e-9)
    assert found.metrics.completeness == pytest.approx(110 / 120)


@pytest.mark.parametrize("joined_to", [None, 0])
def test_relative_errors_do_not_cross_segments(joined_to):
    truth = walk()
    first, second = cut(truth, 60)
    parts = [segment(moved(first, 1.0, 0.0)), segment(moved(second, 1.0, 0.3), joined_to)]
    (*worlds,) = match_worlds(parts, truth)
    assert sum(int(world.pairs(4).sum()) for world in worlds) == 2 * (60 - 4)
    found = evaluate_segments(parts, truth, align="none", rpe_gap=4).metrics
    assert found.rpe_rot_deg_rmse == pytest.approx(0, abs=1e-5) and found.rpe_trans_rmse == pytest.approx(0, abs=1e-9)


def test_tiny_segments_are_listed_but_not_scored():
    truth = walk()
    rough = shaken(truth, 0.5)
    tiny = [segment(part) for part in cut(rough, *range(9, 120, 9))]
    found = evaluate_segments(tiny, truth)
    assert math.isnan(found.metrics.ate_rmse) and found.scored_share == 0.0
    assert found.metrics.completeness == 1.0 and len(found.segments) == len(tiny)
    assert "14 of 14 segments not scored (120 of 120 poses)" in found.metrics.reason
    one_good = [segment(part) for part in cut(rough, SEGMENT_POSES, *range(SEGMENT_POSES + 9, 120, 9))]
    found = evaluate_segments(one_good, truth)
    assert found.scored == (True, *[False] * (len(one_good) - 1))
    assert found.scored_share == pytest.approx(SEGMENT_POSES / 120)


def test_only_the_longest_segments_are_scored():
    truth = walk()
    parts = [segment(part) for part in cut(shaken(truth, 0.5), 12, 24, 90)]
    found = evaluate_segments(parts, truth, most=2)
    assert found.scored == (False, False, True, True)
    assert found.scored_share == pytest.approx(96 / 120) and found.worlds == 4


def test_standing_still_is_no_way_around_the_error():
    truth = walk()
    first, second = cut(truth, 60)
    still = Trajectory(second.timestamps, np.tile([1.0, 2, 3, 0, 0, 0, 1], (60, 1)))
    found = evaluate_segments([segment(first), segment(still)], truth)
    spread = ((second.positions - second.positions.mean(axis=0)) ** 2).sum()
    assert found.metrics.ate_rmse == pytest.approx(math.sqrt(spread / 120))


def test_a_frame_counts_once():
    truth = walk()
    found = evaluate_segments([segment(truth), segment(moved(truth, 2.0, 1.0))], truth)
    assert found.metrics.matched == 120 and found.metrics.completeness == 1.0


def test_poses_that_are_not_finite_are_left_out():
    truth = walk()
    first, second = cut(truth, 60)
    second.poses_wc[5] = np.nan
    found = evaluate_segments([segment(first), segment(second)], truth).metrics
    assert found.matched == 119 and found.ate_rmse == pytest.approx(0, abs=1e-9)


def test_without_segments_nothing_is_defined():
    found = evaluate_segments([], walk())
    assert math.isnan(found.metrics.ate_rmse) and found.segments == () and found.worlds == 0
    with pytest.raises(DvoError, match="alignment"):
        evaluate_segments([], walk(), "sim4")  # type: ignore[arg-type]


def test_number_of_scored_worlds():
    assert [most_worlds(*args) for args in ((0,), (99,), (120, 1), (1000, 2))] == [1, 1, 3, 13]
