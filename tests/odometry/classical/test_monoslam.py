"""MonoSLAM on pictures: accuracy, robustness, determinism."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.metrics import evaluate
from dvo.odometry.classical.monoslam import MonoSlam, MonoSlamConfig
from dvo.odometry.classical.monoslam.search import HALF, find_patch
from dvo.odometry.protocol import Estimate, Result, Status
from dvo.synth.sequence import make_sequence

SMALL = MonoSlamConfig(visible=35, capacity=50)


def run(frames: list[Frame], config: MonoSlamConfig = SMALL) -> tuple[list[Estimate], Result]:
    odometry = MonoSlam(config)
    return [odometry.track(frame) for frame in frames], odometry.finish()


@pytest.mark.long
def test_tracks_a_clean_scene(film, path):
    estimates, result = run(film(path()))
    metrics = evaluate(result.trajectory, path())
    assert metrics.completeness == 1 and result.frames_lost == 0 and result.info["maps_started"] == 1
    assert metrics.ate_percent < 3 and metrics.rotation_error_ratio < 0.2
    assert estimates[0].status is Status.INITIALISING and estimates[-1].status is Status.TRACKING
    assert len(result.map.points) > 15 and len(result.map.points) == len(result.map.colors)


@pytest.mark.slow
def test_tracks_a_rendered_room():
    sequence = make_sequence(5002, frames=60, family="room", kind="handheld")
    _, result = run(list(sequence))
    metrics = evaluate(result.trajectory, sequence.groundtruth)
    assert metrics.completeness == 1 and metrics.ate_percent < 4


@pytest.mark.long
def test_short_blackout_is_lost_and_found(film, path, dark):
    frames = dark(film(path(40)), 20, 23)
    estimates, result = run(frames)
    assert [(e.status, e.pose_wc) for e in estimates[20:23]] == [(Status.LOST, None)] * 3
    assert all(e.pose_wc is not None for e in estimates[24:])
    assert result.info["maps_started"] == 1 and evaluate(result.trajectory, path(40)).ate_percent < 5


@pytest.mark.long
def test_long_blackout_starts_a_second_map(film, path, dark):
    frames = dark(film(path(45)), 10, 30)
    estimates, result = run(frames)
    assert estimates[-1].pose_wc is not None and result.info["maps_started"] >= 2
    assert 20 <= result.frames_lost <= 23


def test_pure_rotation_turns_and_hardly_moves(film, path):
    turning = path(25, translate=0.0)
    _, result = run(film(turning))
    metrics = evaluate(result.trajectory, turning)
    assert metrics.completeness == 1 and metrics.rotation_error_ratio < 0.15
    assert np.linalg.norm(result.trajectory.positions, axis=1).max() < 0.3  # of the distance that points begin at


@pytest.mark.long
def test_units_come_from_the_stamps(film, path):
    """The same pictures at half the rate are a motion half as fast: the path is the same."""
    fast = path(30)
    slow = Trajectory(2 * fast.timestamps, fast.poses_wc)
    _, result = run(film(slow))
    assert evaluate(result.trajectory, slow).ate_percent < 5


def test_a_patch_is_found_to_a_part_of_a_pixel():
    x, y = np.meshgrid(np.arange(60.0), np.arange(50.0))

    def blob(cx, cy):
        return (255 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 18)).astype(np.uint8)

    template = blob(30, 25)[25 - HALF : 26 + HALF, 30 - HALF : 31 + HALF]
    match = find_patch(blob(33.3, 22.6), template, np.array([31.0, 24.0]), 4 * np.eye(2), 3.0, 20.0)
    assert match is not None and match[1] > 0.95 and match[0] == pytest.approx([33.3, 22.6], abs=0.15)
    far = find_patch(blob(45, 25), template, np.array([31.0, 24.0]), np.eye(2), 3.0, 20.0)
    assert far is None or np.linalg.norm(far[0] - [45, 25]) > 5  # outside of the ellipse
