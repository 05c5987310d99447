"""Sequences that go dark for a while."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvo.data.trajectory import Trajectory
from dvo.metrics import transform
from dvo.odometry.protocol import Segment
from eval.scoring.blackout import blackout_errors, dark_spans, is_dark, without_view


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


def test_images_without_a_view():
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    black = rng.normal(6, 3, (48, 64, 3)).clip(0, 255).astype(np.uint8)
    white = 255 - black
    wall = black + 120  # grey without texture is a view: a camera may look at a wall
    scene = np.broadcast_to(np.linspace(30, 220, 64)[None, :, None], (48, 64, 3)).astype(np.uint8)
    dim = (scene / 8 + rng.normal(0, 4, scene.shape)).clip(0, 255).astype(np.uint8)
    found = [without_view(image) for image in (noise, black, white, wall, scene, dim)]
    assert found == [True, True, True, False, False, False]


def test_segments_are_judged_in_their_own_worlds():
    truth = curve(100)
    spans = [(float(truth.timestamps[40]), float(truth.timestamps[59]))]
    turn = Rotation.from_rotvec([0, 2, 0]).as_matrix()

    def part(start: int, stop: int, scale: float = 1.0) -> Trajectory:
        rows = Trajectory(truth.timestamps[start:stop], truth.poses_wc[start:stop])
        return transform(rows, scale, turn, np.array([90.0, 0, 0])) if scale != 1 else rows

    before, after = whole(part(0, 40)), whole(part(60, 100, 2.0))
    errors = blackout_errors([before, after], truth, spans, "sim3")
    assert errors.segment_ate_percent < 1e-6 and errors.recovery_s == np.inf  # another world is not found again

    back = whole(part(60, 100), joined_to=0)
    errors = blackout_errors([before, back], truth, spans, "sim3")
    assert errors.segment_ate_percent < 1e-6 and errors.recovery_s == pytest.approx(0.05)

    early = blackout_errors([whole(part(0, 45)), whole(part(45, 100, 2.0))], truth, spans, "sim3")
    assert early.segment_ate_percent < 1e-6  # wherever in the dark the segment begins

    lit = [whole(part(60, 72, 2.0)), whole(part(72, 100, 3.0))]
    errors = blackout_errors([before, *lit], truth, spans, "sim3")
    assert errors.segment_ate_percent < 1e-6  # the longer of the two has more than half

    tiny = [whole(part(start, start + 10, 2.0)) for start in (60, 70, 80, 90)]
    assert blackout_errors([before, *tiny], truth, spans, "sim3").segment_ate_percent == np.inf
    assert blackout_errors([], truth, spans, "sim3").segment_ate_percent == np.inf
