"""Alignment of frames between those that the network measures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import dvo
from dvo.data.frame import Frame
from dvo.geometry import se3
from dvo.geometry.poses import se3_exp
from dvo.metrics import evaluate
from dvo.odometry.global_ba.final_adjustment import AdjustmentOptions, adjust_segment
from dvo.odometry.patch.tracker import JOBS_EVERY
from dvo.odometry.protocol import Estimate, Status
from dvo.odometry.window.frame_alignment import noise, solve_pose, solve_pose_plain
from dvo.synth.sequence import make_sequence

SETTINGS = {"loops": False, "estimate_readout": False, "network_motion": 1.2}
FEW = SETTINGS | {"patches": 16, "initial_updates": 6}  # where no accuracy is asked for
CAMERA = np.array([300.0, 310.0, 160.0, 120.0])


MIDDLE = 16  # frame whose changed pictures are tried


def film(count: int = 32, **options) -> tuple[list[Frame], object]:
    values = {"family": "room", "kind": "handheld", "speed": 0.6, "fps": 30.0, "height": 240, "width": 320} | options
    sequence = make_sequence(77, frames=count, **values)
    return list(sequence), sequence.groundtruth


@dataclass(frozen=True)
class Others:
    """What became of other pictures during a walk.

    Attributes:
        aligned: whether the frame in the middle is, and its pictures darker, brighter and blurred.
        estimates: of frames of another place after the walk.
        counts: aligned frames before and after these.
    """

    aligned: list[bool]
    estimates: list[Estimate]
    counts: tuple[int, int]


def walked(odometry, frames: list[Frame]) -> tuple[list[Estimate], Others]:
    """Track a walk and then a few frames of another place."""
    estimates = [odometry.track(frame) for frame in frames[:MIDDLE]]
    assert odometry.state.initialised
    middle = frames[MIDDLE]
    image = middle.image
    pictures = (image, (image * 0.8).astype(np.uint8), cv2.add(image, (20,) * 3), cv2.GaussianBlur(image, (0, 0), 2.0))
    with torch.inference_mode():
        camera, time = middle.camera.intrinsics, middle.timestamp
        limit, odometry.aligner.limit = odometry.aligner.limit, 5.0
        found = [odometry.aligner.align(picture, camera, None, time) is not None for picture in pictures]
        odometry.aligner.limit = limit
    estimates += [odometry.track(frame) for frame in frames[MIDDLE:]]
    before, lost = len(aligned(odometry)), []
    for number, view in enumerate(film(4, family="street")[0], len(frames)):
        lost.append(odometry.track(Frame(number, number / 30.0, view.image, frames[0].camera)))
    return estimates, Others(found, lost, (before, len(aligned(odometry))))


@pytest.fixture(scope="module")
def walk():
    """Odometry after a slow walk, its estimates, result, frames and the truth; and what became of other pictures."""
    frames, truth = film()
    odometry = dvo.load("small", **SETTINGS)
    estimates, others = walked(odometry, frames)
    return odometry, estimates, odometry.finish(), frames, truth, others


def aligned(odometry) -> list:
    """Frames of the archive in which patches are measured, but whose own are not."""
    edges = odometry.graph.archive.edges()
    sources, targets = set(edges.source.tolist()), set(edges.target.tolist())
    return [
        frame for frame in odometry.graph.archive if frame.identifier in targets - sources and frame.anchor is not None
    ]


@pytest.mark.long
def test_a_slow_camera_is_aligned(walk):
    odometry, estimates, result, frames, truth, _ = walk
    assert len(aligned(odometry)) > len(frames) // 3
    assert len(result.trajectory) == len(frames) and result.quality.verdict == "good"
    assert evaluate(result.trajectory, truth).ate_percent < 1
    tracked = [estimate for estimate in estimates if estimate.status is Status.TRACKING]
    assert all(0 < estimate.confidence <= 1 and np.isfinite(estimate.covariance).all() for estimate in tracked)
    assert all(np.linalg.eigvalsh(estimate.covariance).min() > 0 for estimate in tracked)


@pytest.mark.long
@pytest.mark.slow
def test_it_is_as_exact_as_with_the_network_at_every_frame(walk):
    _, _, result, frames, truth, _ = walk
    every = dvo.load("small", **SETTINGS | {"network_motion": 0})
    for frame in frames:
        every.track(frame)
    least = evaluate(every.finish().trajectory, truth).ate_percent
    assert not aligned(every)
    assert evaluate(result.trajectory, truth).ate_percent < 2 * least + 0.2


@pytest.mark.long
@pytest.mark.slow
def test_again_the_same_bytes(walk):
    odometry, _, result, frames, *_ = walk
    odometry.reset()
    walked(odometry, frames)
    assert odometry.finish().trajectory.poses_wc.tobytes() == result.trajectory.poses_wc.tobytes()


@pytest.mark.long
def test_a_fast_camera_is_measured_by_the_network():
    frames, _ = film(14, speed=8.0, fps=8.0, height=120, width=160)
    odometry = dvo.load("small", **FEW)
    for frame in frames:
        odometry.track(frame)
    assert odometry.state.initialised
    odometry.finish()
    assert len(aligned(odometry)) <= 2


@pytest.mark.long
def test_bare_surfaces_are_measured_by_the_network():
    """Edges alone tell no motion along themselves, however well the windows correlate."""
    frames, _ = film(24, texture=0.02)
    odometry = dvo.load("small", **FEW)
    for frame in frames:
        odometry.track(frame)
    assert odometry.state.initialised
    odometry.finish()
    assert len(aligned(odometry)) <= len(frames) // 4


@pytest.mark.long
def test_another_picture_is_not_aligned(walk):
    """A frame without a match is lost, as it is without the alignment."""
    others = walk[-1]
    assert others.aligned == [True, False, False, False]
    assert all(estimate.status is Status.LOST and estimate.pose_wc is None for estimate in others.estimates)
    assert others.counts[0] == others.counts[1] > 0


@pytest.mark.long
def test_their_measurements_take_part_in_the_final_adjustment(walk):
    """Moved away, the frames return, and keyframes stay where they were."""
    odometry, _, result, *_ = walk
    graph = odometry.graph.copy()
    attached = np.array([frame.identifier for frame in aligned(odometry)])
    before = graph.poses_cw(attached)
    noise = 2e-3 * torch.randn(len(attached), 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for identifier, pose in zip(attached.tolist(), se3.retract(before, noise), strict=True):
        graph.correct(identifier, pose.numpy())
    adjust_segment(graph, 0, replace(AdjustmentOptions(restart_frames=0), kernels=AdjustmentOptions().kernels[-1:]))
    away = se3.log(se3.relative(before, graph.poses_cw(attached))).abs()
    assert away.mean() < noise.abs().mean() / 5


@pytest.mark.long
def test_saved_and_read_again(walk, tmp_path):
    odometry, _, result, *_ = walk
    odometry.save(tmp_path / "map.dvo")
    again = dvo.load_map(tmp_path / "map.dvo")
    assert len(aligned(again)) == len(aligned(odometry))
    np.testing.assert_array_equal(again.current().trajectory.poses_wc, result.trajectory.poses_wc)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.floats(1.0, 12.0))
def test_the_noise_of_an_image_is_found(seed, deviation):
    y, x = np.mgrid[:120, :160]
    smooth = 120 + 30 * np.sin(x / 30) + 0.2 * y + 40 * (x > 80)  # an edge is no noise
    seen = smooth + np.random.default_rng(seed).normal(0, deviation, smooth.shape)
    found = noise(seen.round().clip(0, 255).astype(np.uint8))
    assert 0.85 * deviation < found < 1.15 * deviation + 0.2
    assert noise(smooth.round().astype(np.uint8)) < 0.5


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**31),
    st.integers(6, 120),
    st.floats(0, 0.4),
    st.lists(st.floats(-0.05, 0.05), min_size=6, max_size=6),
)
def test_the_kernel_equals_its_twin(seed, count, wrong, xi):
    random = np.random.default_rng(seed)
    points = random.uniform(-1, 1, (count, 3)) + [0, 0, 2.0]
    points[0, 2] = -1.0  # behind the camera
    rotation, translation = se3_exp(np.array(xi))
    seen = points @ rotation.T + translation
    measured = seen[:, :2] / seen[:, 2:] * CAMERA[:2] + CAMERA[2:]
    outliers = random.random(count) < wrong
    measured[outliers] += random.normal(0, 30, (int(outliers.sum()), 2))
    weights = random.uniform(0.05, 1, (count, 2))
    given = points, measured, weights, CAMERA, np.eye(4), (4.0, 1.0, 0.3)
    np.testing.assert_allclose(solve_pose(*given), solve_pose_plain(*given), atol=1e-7)


def test_the_pose_is_exact_with_a_third_of_wrong_positions():
    random = np.random.default_rng(3)
    points = random.uniform(-1, 1, (60, 3)) + [0, 0, 3.0]
    rotation, translation = se3_exp(np.array([0.02, -0.01, 0.03, 0.01, -0.02, 0.015]))
    seen = points @ rotation.T + translation
    measured = seen[:, :2] / seen[:, 2:] * CAMERA[:2] + CAMERA[2:]
    measured[:20] += random.uniform(20, 60, (20, 2))
    found = solve_pose(points, measured, np.ones((60, 2)), CAMERA, np.eye(4), (4.0, 1.0, 0.3, 0.3))
    assert np.abs(found[:3, 3] - translation).max() < 1e-4 and np.abs(found[:3, :3] - rotation).max() < 1e-4


def test_jobs_advance_beside_aligned_frames_too():
    frames, _ = film(40, speed=0.15)
    odometry, taken, due, longest = dvo.load("small", **FEW), [], 0, 0

    def steps():
        while True:
            taken.append(None)
            yield

    for frame in frames:
        maintenance = odometry.loops.maintenance
        if maintenance.job is None and odometry.state.initialised:
            maintenance.job = maintenance.in_steps("search", steps(), lambda _: None)
        age, busy = odometry.aligner.age, maintenance.job is not None
        odometry.track(frame)
        measured = odometry.aligner.age == 0
        due += busy * (measured + (age > 0 and age % JOBS_EVERY == 0))
        longest = max(longest, odometry.aligner.age)
    assert longest > JOBS_EVERY and len(taken) == due > 0
