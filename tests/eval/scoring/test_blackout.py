"""Sequences that go dark for a while."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvo.data.trajectory import Trajectory
from dvo.metrics import transform
from dvo.odometry.protocol import Segment
from eval.scoring.blackout import blackout_errors, dark_spans, is_dark


def curve(count: int = 120, rate: float = 20.0) -> Trajectory:
    """A winding walk that turns."""
    s = np.linspace(0, 6, count)
    positions = np.column_stack([3 * np.sin(s), 0.3 * np.sin(3 * s), 2 * s])
    quaternions = Rotation.from_euler("yxz", np.column_stack([0.5 * s, 0.1 * np.sin(s), 0.1 * s])).as_quat()
    return Trajectory(np.arange(count) / rate, np.column_stack([positions, quaternions]))


def whole(trajectory: Trajectory, joined_to: int | None = None) -> Segment:
    """A segment of all its rows."""
    return Segment(trajectory, float(trajectory.timestamps[0]), float(trajectory.timestamps[-1]), joined_to)


def test_dark_images_and_spans():
    dark = np.random.default_rng(0).normal(6, 3, (48, 64, 3)).clip(0, 255).astype(np.uint8)
    assert is_dark(dark) and not is_dark(dark + 60)
    dim = np.zeros((48, 64, 3), np.uint8)
    dim[:, ::8] = 60
    assert not is_dark(dim)  # little light, but something to see
    stamps = np.arange(30) / 10
    flags = np.zeros(30, bool)
    flags[[0, 1, 2, 3, 4, 5, 8, 12, 13, 14, 15, 16, 17]] = True
    assert dark_spans(stamps, flags) == [(1.2, 1.7)]  # not the start, not the flicker


def test_blackout_errors_of_three_kinds_of_system():
    truth = curve(100)
    spans = [(float(truth.timestamps[40]), float(truth.timestamps[59]))]
    seen = np.r_[0:40, 60:100]

    def kept(rows) -> Trajectory:
        return Trajectory(truth.timestamps[rows], truth.poses_wc[rows])

    back = transform(kept(seen), 0.3, Rotation.from_rotvec([0, 1, 0]).as_matrix(), np.ones(3))
    errors = blackout_errors([whole(back)], truth, spans, "sim3")
    assert errors.blackouts == 1 and errors.segment_ate_percent < 1e-6
    assert errors.recovery_s == pytest.approx(0.05)  # the first lit frame

    late = blackout_errors([whole(kept(np.r_[0:40, 70:100]))], truth, spans, "sim3")
    assert late.recovery_s == pytest.approx(0.55)

    after = transform(kept(np.arange(60, 100)), 2.0, Rotation.from_rotvec([0, 2, 0]).as_matrix(), np.array([90, 0, 0]))
    anew = Trajectory(truth.timestamps[seen], np.concatenate([truth.poses_wc[:40], after.poses_wc]))
    errors = blackout_errors([whole(anew)], truth, spans, "sim3")
    assert errors.segment_ate_percent < 1e-6 and errors.recovery_s == np.inf  # tracks again, in a world of its own

    gone = blackout_errors([whole(kept(np.arange(40)))], truth, spans, "sim3")
    assert gone.segment_ate_percent == np.inf and gone.recovery_s == np.inf
    assert np.isnan(blackout_errors([whole(truth)], truth, [], "sim3").recovery_s)
