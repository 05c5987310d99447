"""The classical baseline and the null system, on a small exact scene and on a real clip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.metrics import evaluate
from dvo.odometry.classical.frame_log import FrameLog
from dvo.odometry.classical.klt_pnp import KltPnp, KltPnpConfig
from dvo.odometry.protocol import Estimate, Odometry, Result, Status
from eval.systems.null import NullMotion


def run(frames: list[Frame], odometry: Odometry | None = None) -> tuple[list[Estimate], Result]:
    odometry = odometry or KltPnp(KltPnpConfig(corners=300))
    return [odometry.track(frame) for frame in frames], odometry.finish()


def test_both_are_odometries():
    for odometry in (KltPnp(), NullMotion()):
        assert isinstance(odometry, Odometry)
        result = odometry.finish()
        assert len(result.trajectory) == result.frames_read == result.frames_lost == 0


def test_tracks_a_clean_scene(film, path):
    estimates, result = run(film(path()))
    metrics = evaluate(result.trajectory, path())
    assert metrics.completeness == 1 and result.frames_lost == 0
    assert metrics.ate_percent < 1.5 and metrics.rotation_error_ratio < 0.1
    assert estimates[-1].status is Status.TRACKING and estimates[-1].confidence > 0.8
    assert len(result.map.points) > 100 and len(result.map.points) == len(result.map.colors)
    depths = result.map.points[:, 2] * metrics.scale
    near, far = np.abs(depths - 2.5) < 0.3, np.abs(depths - 5) < 0.6
    assert (near | far).mean() > 0.8 and near.sum() > 10


def test_start_is_back_filled(film, path):
    """Standing still gives no parallax; the frames of the start get poses all the same."""
    moving = path()
    poses = np.concatenate([np.repeat(moving.poses_wc[:1], 6, axis=0), moving.poses_wc])
    slow = Trajectory(np.arange(len(poses)) / 20, poses)
    estimates, result = run(film(slow))
    assert estimates[5].status is Status.INITIALISING and estimates[5].pose_wc is None
    metrics = evaluate(result.trajectory, slow)
    assert metrics.completeness == 1 and metrics.ate_percent < 2
    steps = np.linalg.norm(np.diff(result.trajectory.positions[:6], axis=0), axis=1)
    assert steps.max() * metrics.scale < 0.01


@pytest.mark.long
def test_short_blackout_is_lost_and_found(film, path, dark):
    estimates, result = run(dark(film(path(60)), 25, 28))
    assert [(e.status, e.pose_wc) for e in estimates[25:28]] == [(Status.LOST, None)] * 3
    assert all(e.status is Status.TRACKING for e in estimates[28:])
    assert result.frames_lost == 3 and result.info["maps_started"] == 1
    metrics = evaluate(result.trajectory, path(60))
    assert metrics.matched == 57 and metrics.ate_percent < 2


@pytest.mark.long
def test_long_blackout_starts_a_second_map(film, path, dark):
    estimates, result = run(dark(film(path(80)), 30, 45))
    assert result.info["maps_started"] == 2
    assert estimates[-1].status is Status.TRACKING
    assert not set(path(80).timestamps[31:40]) & set(result.trajectory.timestamps)
    after = result.trajectory.timestamps > path(80).timestamps[50]
    second = Trajectory(result.trajectory.timestamps[after], result.trajectory.poses_wc[after])
    metrics = evaluate(second, path(80), rpe_gap=5)
    assert after.sum() >= 28 and metrics.ate_percent < 4 and metrics.rotation_error_ratio < 0.25


def test_a_log_gives_a_lost_frame_no_pose():
    log = FrameLog()
    log.set_pose(log.begin(0.5), np.eye(4))
    assert log.estimate(Status.TRACKING).pose_wc is not None and log.estimate(Status.LOST).pose_wc is None


def test_null_moves_straight_and_never_turns(film, path):
    _, result = run(film(path(20)), NullMotion())
    metrics = evaluate(result.trajectory, path(20))
    assert metrics.completeness == 1 and metrics.rotation_error_ratio == pytest.approx(1)
    assert np.ptp(np.diff(result.trajectory.positions, axis=0), axis=0).max() < 1e-9


@pytest.mark.slow
def test_kitti_under_five_percent(data_root: Path):
    from dvo.data.open import open_source

    source = open_source(data_root / "kitti00_120")
    assert source.groundtruth is not None
    _, result = run(list(source), KltPnp())
    metrics = evaluate(result.trajectory, source.groundtruth)
    assert metrics.completeness == 1
    assert metrics.ate_percent < 2
    assert metrics.rotation_error_ratio < 0.2
