"""Errors of relative poses, and the area under their recall."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.data.trajectory import Trajectory
from dvo.metrics import transform
from dvo.metrics.relative_pose import join_segments, recall_area, relative_pose_errors
from dvo.odometry.protocol import Segment


def walk(count: int = 30) -> Trajectory:
    """Winding, turning about y."""
    s = np.linspace(0, 3, count)
    poses = np.zeros((count, 7))
    poses[:, :3] = np.column_stack([np.sin(s), 0.2 * np.cos(2 * s), 2 * s])
    poses[:, 4], poses[:, 6] = np.sin(0.2 * s), np.cos(0.2 * s)
    return Trajectory(np.arange(count) / 10, poses)


def rotation(axis_angle: tuple[float, float, float]) -> np.ndarray:
    import cv2

    return cv2.Rodrigues(np.array(axis_angle, float))[0]


def part(trajectory: Trajectory, rows: slice, joined_to: int | None = None) -> Segment:
    times = trajectory.timestamps[rows]
    return Segment(Trajectory(times, trajectory.poses_wc[rows]), times[0], times[-1], joined_to)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.05, 20), st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-50, 50)] * 3), st.integers(1, 6))
def test_a_similarity_of_the_world_changes_nothing(scale, turn, shift, gap):
    truth = walk()
    moved = transform(truth, scale, rotation(turn), np.array(shift))
    errors = relative_pose_errors(moved, truth, gap)
    assert errors.shape == (30 - gap,) and errors.max() < 1e-4


def test_the_larger_of_rotation_and_direction_counts():
    times = np.arange(2.0)
    truth, estimate = (np.tile([0, 0, 0, 0, 0, 0, 1.0], (2, 1)) for _ in range(2))
    truth[1, 2] = 1.0
    estimate[1, [0, 2]] = np.sin(np.radians(3)), np.cos(np.radians(3))
    estimate[1, [4, 6]] = np.sin(np.radians(1)), np.cos(np.radians(1))  # two degrees about y

    def error(estimated: np.ndarray, true: np.ndarray) -> float:
        return float(relative_pose_errors(Trajectory(times, estimated), Trajectory(times, true))[0])

    assert error(estimate, truth) == pytest.approx(3)
    estimate[1, [4, 6]] = np.sin(np.radians(4)), np.cos(np.radians(4))
    assert error(estimate, truth) == pytest.approx(8)
    estimate[1, :3] = [0, 0, -1]  # the sign of a direction counts
    assert error(estimate, truth) == pytest.approx(180)
    estimate[1, :3] = 0
    assert error(estimate, truth) == pytest.approx(90)
    truth[1, :3] = 0  # no direction to find
    assert error(estimate, truth) == pytest.approx(8)


def test_missing_frames_and_pairs_in_two_worlds_have_an_infinite_error():
    truth = walk(20)
    rows, labels = join_segments([part(truth, slice(2, 10)), part(truth, slice(10, 20))], truth)
    errors = relative_pose_errors(rows, truth, 5, labels=labels)
    assert np.flatnonzero(np.isfinite(errors)).tolist() == [2, 3, 4, *range(10, 15)]
    rows, labels = join_segments([part(truth, slice(2, 10)), part(truth, slice(10, 20), joined_to=0)], truth)
    assert np.flatnonzero(np.isinf(relative_pose_errors(rows, truth, 5, labels=labels))).tolist() == [0, 1]
    rows, labels = join_segments([], truth)
    assert np.isinf(relative_pose_errors(rows, truth, 1, labels=labels)).all()
    assert len(relative_pose_errors(truth, truth, 20)) == 0


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0, 20) | st.just(np.inf), min_size=1, max_size=40), st.sampled_from([1.0, 2.0, 5.0, 10.0]))
def test_area_under_the_recall_curve(errors, limit):
    """Against the integral of the polygon on a fine grid, and against the area of the steps."""
    values = np.sort(np.array(errors))
    below = values[values < limit]
    found = recall_area(np.array(errors), [limit])[limit]
    x, y = np.r_[-1e-9, below], np.r_[0, np.arange(1, len(below) + 1) / len(values)]
    grid = (np.arange(20_000) + 0.5) / 20_000 * limit
    assert found == pytest.approx(np.interp(grid, x, y).mean(), abs=2e-3)
    steps = np.maximum(0, 1 - values / limit).mean()
    assert -1e-9 <= found - steps <= 0.5 / len(values) + 1e-9


def test_areas_of_known_curves():
    assert recall_area(np.zeros(4), [1.0, 10.0]) == {1.0: 1.0, 10.0: 1.0}
    assert recall_area(np.full(4, np.inf), [5.0]) == {5.0: 0.0}
    # SuperGlue's own code on [1, 3, 6] gives the polygon (0, 0), (1, 1/3), (3, 2/3), (5, 2/3): (1/6 + 1 + 4/3) / 5
    assert recall_area(np.array([3.0, 6.0, 1.0]), [5.0])[5.0] == pytest.approx(0.5)
    assert np.isnan(recall_area(np.zeros(0), [1.0])[1.0])
