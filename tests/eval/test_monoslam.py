"""MonoSLAM on pictures: accuracy, robustness, determinism."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.metrics import evaluate
from dvo.odometry.protocol import Estimate, Odometry, Result, Status
from dvo.synth.sequence import make_sequence
from eval.baselines.monoslam import MonoSlam, MonoSlamConfig
from eval.baselines.monoslam.search import HALF, find_patch

SMALL = MonoSlamConfig(visible=35, capacity=50)


def run(frames: list[Frame], config: MonoSlamConfig = SMALL) -> tuple[list[Estimate], Result]:
    odometry = MonoSlam(config)
    return [odometry.track(frame) for frame in frames], odometry.finish()


def test_tracks_a_clean_scene(film, path):
    estimates, result = run(film(path()))
    metrics = evaluate(result.trajectory, path())
    assert metrics.completeness == 1 and result.frames_lost == 0 and result.info["maps_started"] == 1
    assert metrics.ate_percent < 3 and metrics.rotation_error_ratio < 0.2
    assert estimates[0].status is Status.INITIALISING and estimates[-1].status is Status.TRACKING
    assert len(result.map.points) > 15 and len(result.map.points) == len(result.map.colors)


def test_tracks_a_rendered_room():
    sequence = make_sequence(5002, frames=60, family="room", kind="handheld")
    _, result = run(list(sequence))
    metrics = evaluate(result.trajectory, sequence.groundtruth)
    assert metrics.completeness == 1 and metrics.ate_percent < 4


def test_same_frames_same_bytes(film, path):
    frames = film(path(12))
    first, second = (run(frames)[1].trajectory.poses_wc.tobytes() for _ in range(2))
    assert first == second


def test_short_blackout_is_lost_and_found(film, path):
    frames = [replace(f, image=np.zeros_like(f.image)) if 20 <= f.index < 23 else f for f in film(path(40))]
    estimates, result = run(frames)
    assert [e.status for e in estimates[20:23]] == [Status.LOST] * 3
    assert all(e.pose_wc is not None for e in estimates[24:])
    assert result.info["maps_started"] == 1 and evaluate(result.trajectory, path(40)).ate_percent < 5


def test_long_blackout_starts_a_second_map(film, path):
    frames = [replace(f, image=np.zeros_like(f.image)) if 10 <= f.index < 30 else f for f in film(path(45))]
    estimates, result = run(frames)
    assert estimates[-1].pose_wc is not None and result.info["maps_started"] >= 2
    assert 20 <= result.frames_lost <= 23


def test_pure_rotation_turns_and_hardly_moves(film, path):
    turning = path(25, translate=0.0)
    _, result = run(film(turning))
    metrics = evaluate(result.trajectory, turning)
    assert metrics.completeness == 1 and metrics.rotation_error_ratio < 0.15
    assert np.linalg.norm(result.trajectory.positions, axis=1).max() < 0.3  # of the distance that points begin at


@pytest.mark.parametrize("value", [0, 128, 255])
def test_no_texture_is_lost_not_a_crash(film, path, value):
    frames = [replace(f, image=np.full_like(f.image, value)) for f in film(path(6))]
    estimates, result = run(frames)
    assert all(e.status is Status.LOST for e in estimates[1:]) and result.frames_lost == 5
    assert np.isfinite(result.trajectory.poses_wc).all()


def test_none_and_one_frame(film, path):
    assert isinstance(MonoSlam(), Odometry)
    assert len(MonoSlam().finish().trajectory) == 0
    _, result = run(film(path(2))[:1])
    assert result.trajectory.poses_wc.tolist() == [[0, 0, 0, 0, 0, 0, 1]]


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
