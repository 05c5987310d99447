"""Errors of runs in segments: by evo, combined over frames, and not gained by cutting."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvo.data.trajectory import Trajectory
from dvo.metrics.segment_metrics import evaluate_segments, rows_of
from eval.scoring.errors import align_segments, all_errors
from eval.scoring.metrics import Aligned, absolute_rmse, align_pair, metrics_of, path_errors
from eval.scoring.protocols import kitti_errors, per_frame_scale, relative_pose_auc
from eval.suites.suite import Suite
from tests.support.trajectories import cut, moved, segment

pytest.importorskip("evo", reason="evo is in the extra 'eval'")
SUITE = Suite("s", "l", (), rpe_gap=2)


def walk(count: int = 120, step: float = 0.1) -> Trajectory:
    """A winding walk that turns, 10 Hz."""
    s = np.arange(count) * step
    positions = np.column_stack([3 * np.sin(s), 0.3 * np.sin(3 * s), 2 * s])
    quaternions = Rotation.from_euler("yxz", np.column_stack([0.5 * s, 0.1 * np.sin(s), 0.1 * s])).as_quat()
    return Trajectory(np.arange(count) / 10, np.column_stack([positions, quaternions]))


def noisy(trajectory: Trajectory, by: float = 0.1, seed: int = 3) -> Trajectory:
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(rng.normal(0, 0.02, (len(trajectory), 3)))
    quaternions = (Rotation.from_quat(trajectory.poses_wc[:, 3:]) * turns).as_quat()
    positions = trajectory.positions + rng.normal(0, by, (len(trajectory), 3))
    return Trajectory(trajectory.timestamps, np.column_stack([positions, quaternions]))


def drifting(trajectory: Trajectory, rate: float = 0.01) -> Trajectory:
    """The scale grows with time, the common error of one camera."""
    factor = np.exp(rate * np.arange(len(trajectory)))[1:, None]
    steps = np.diff(trajectory.positions, axis=0) * factor
    positions = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return Trajectory(trajectory.timestamps, np.column_stack([positions, trajectory.poses_wc[:, 3:]]))


def test_one_segment_is_scored_as_a_trajectory():
    truth = walk()
    estimate = noisy(moved(rows_of(truth, np.r_[0:50, 60:120]), 0.3, 1.0))
    found = all_errors([segment(estimate)], truth, SUITE, [], most=1)
    pair = align_pair(estimate, truth, "sim3", rpe_gap=2)
    assert isinstance(pair, Aligned)
    assert found.metrics == metrics_of(pair) and found.path == path_errors(pair)
    assert found.pose_auc == relative_pose_auc(estimate, truth, 2)
    assert found.rotation == absolute_rmse(pair, angle=True)
    rescaled = align_pair(per_frame_scale(estimate, truth), truth)
    assert isinstance(rescaled, Aligned) and found.per_frame_scale == absolute_rmse(rescaled)
    assert (found.worlds, found.scored) == (1, 1.0)


def test_the_error_without_that_of_the_scale_stands_beside_it():
    """Under SE(3); under Sim(3) the error itself is without it."""
    truth, suite = walk(), replace(SUITE, alignment="se3")
    exact = moved(truth, 0.5, 1.0)
    found = all_errors([segment(exact)], truth, suite, [], most=1)
    assert found.metrics is not None and found.metrics.ate_rmse > 1
    assert found.scale_error == pytest.approx(50) and found.shape < 1e-9
    estimate = noisy(exact)
    found = all_errors([segment(estimate)], truth, suite, [], most=1)
    assert found.shape == pytest.approx(all_errors([segment(estimate)], truth, SUITE, [], most=1).metrics.ate_rmse)
    assert math.isnan(all_errors([segment(estimate)], truth, SUITE, [], most=1).shape)


def test_no_segments_give_no_errors():
    found = all_errors([], walk(), SUITE, [], most=1)
    assert found.metrics is not None and math.isnan(found.metrics.ate_rmse) and found.metrics.matched == 0
    assert found.worlds == 0 and math.isnan(found.scored) and found.pose_auc[10.0] == 0


def test_segments_in_worlds_of_their_own_are_right():
    truth = walk()
    first, second = cut(truth, 50)
    parts = [segment(moved(first, 0.5, 1.0)), segment(moved(second, 4.0, -2.0))]
    found = all_errors(parts, truth, SUITE, [], most=2)
    assert found.metrics is not None and found.metrics.ate_rmse < 1e-9 and found.metrics.rpe_rot_deg_rmse < 1e-5
    assert found.rotation < 1e-5 and found.per_frame_scale < 1e-9 and found.path.trans_percent < 1e-6
    assert (found.worlds, found.scored, found.metrics.completeness) == (2, 1.0, 1.0)
    # Two frames in two worlds are no pair: of 118 pairs of frames two apart, two are missed.
    assert found.pose_auc[10.0] == pytest.approx(116 / 118, abs=1e-4)
    joined = all_errors([parts[0], segment(moved(second, 4.0, -2.0), joined_to=0)], truth, SUITE, [], most=2)
    assert joined.metrics is not None and joined.metrics.ate_percent > 2 and joined.worlds == 1


@pytest.mark.parametrize("joined_to", [None, 0])
def test_evo_agrees_with_dvo(joined_to):
    truth = walk()
    first, dark, second = cut(noisy(truth), 50, 60)
    del dark
    parts = [segment(first), segment(second if joined_to == 0 else moved(second, 2.0, 1.0), joined_to)]
    ours = evaluate_segments(parts, truth, rpe_gap=2).metrics
    pieces = align_segments(parts, truth, rpe_gap=2)
    evos = metrics_of(*pieces.scored, unscored=pieces.unscored)
    for name in ("ate_rmse", "ate_percent", "rpe_trans", "rpe_trans_rmse", "rpe_rot_deg", "rpe_rot_deg_rmse", "scale"):
        assert getattr(evos, name) == pytest.approx(getattr(ours, name), rel=1e-6), name
    assert evos.path_length == pytest.approx(ours.path_length) and len(pieces.scored) == 2
    assert evos.path_length == pytest.approx(sum(part.path_length for part in (cut(truth, 50, 60)[k] for k in (0, 2))))


def test_rotations_of_short_segments_count():
    truth = walk()
    rough, fine = cut(noisy(truth), 112)[1], cut(truth, 112)[0]
    found = all_errors([segment(fine), segment(rough)], truth, SUITE, [], most=5)
    assert found.metrics is not None and found.metrics.ate_rmse < 1e-9
    assert found.metrics.rpe_rot_deg_rmse > 0.1 and found.scored == pytest.approx(112 / 120)
    assert "1 of 2 segments not scored (8 of 120 poses)" in (found.metrics.reason or "")


def test_many_tiny_segments_do_not_hide_an_error():
    truth = walk()
    rough = drifting(truth)
    whole = all_errors([segment(rough)], truth, SUITE, [], most=2)
    assert whole.metrics is not None and whole.metrics.ate_percent > 2
    tiny = [segment(part) for part in cut(rough, *range(5, 120, 5))]
    found = all_errors(tiny, truth, SUITE, [], most=2)
    assert found.metrics is not None and math.isnan(found.metrics.ate_rmse) and found.scored == 0
    just = [segment(part) for part in cut(rough, *range(10, 120, 10))]  # each long enough, but too many
    assert all_errors(just, truth, SUITE, []).metrics.ate_percent < 0.2 * whole.metrics.ate_percent  # type: ignore[union-attr]
    found = all_errors(just, truth, SUITE, [], most=2)
    assert found.worlds == 12 and found.scored == pytest.approx(20 / 120)
    assert found.pose_auc[10.0] < 0.85 < whole.pose_auc[10.0]


def test_kitti_segments_lie_in_one_segment():
    s = np.arange(400.0)
    truth = Trajectory(s / 10, np.column_stack([s, 0 * s, 0.1 * np.sin(s), 0 * s, 0 * s, 0 * s, 1 + 0 * s]))
    first, second = cut(truth, 250)
    whole = kitti_errors(truth, truth)
    assert whole.longest_m == 300
    parts = [(first, 1.0), (moved(second, 0.5, 1.0), 2.0)]
    found = kitti_errors(parts, truth)
    assert found.t_rel == pytest.approx(0, abs=1e-6) and found.longest_m == 200
    errors = all_errors([segment(first), segment(parts[1][0])], truth, SUITE, [], most=5)
    assert errors.kitti.t_rel == pytest.approx(0, abs=1e-4) and errors.kitti.longest_m == 200
