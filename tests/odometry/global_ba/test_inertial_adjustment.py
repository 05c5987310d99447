"""Adjustment of images and samples together: known motions, tilted and scaled starts, deviations of the scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvo.ba.patch_problem import PatchProblem
from dvo.data.inertial import InertialSamples
from dvo.geometry import se3
from dvo.geometry.poses import compose_poses, invert_poses, pose_from, so3_exp, split
from dvo.geometry.projection import reproject
from dvo.odometry.global_ba.inertial_adjustment import VISUAL, VisualInertialSolution, adjust_with_samples
from dvo.odometry.inertial.smoother import Similarities, Smoothed
from tests.support.inertial_motion import NOISE, Motion

STEP, FRAMES, PER_FRAME = 0.1, 24, 8
OFFSET, LEVER = 0.01, np.array([0.05, -0.02, 0.03])
TURN = so3_exp(np.array([0.3, -0.2, 0.5]))
CAMERA = np.array([60.0, 60.0, 40.0, 30.0])


class Steady(Motion):
    """A motion with turns, whose velocity is constant."""

    def position(self, t: np.ndarray) -> np.ndarray:
        return np.multiply.outer(t, np.array([0.4, 0.2, 0.1]))

    def velocity(self, t: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.array([0.4, 0.2, 0.1]), (*np.shape(t), 3)).copy()

    def samples(self, t: np.ndarray) -> InertialSamples:
        moved = super().samples(t)
        force = np.swapaxes(self.rotation(t), -1, -2) @ np.array([0.0, 0.0, 9.81])
        return InertialSamples(t, moved.gyro, force)


class Case:
    """A motion seen by patches at depths of 2 to 6 m, with its samples."""

    def __init__(self, motion: Motion, seed: int = 0) -> None:
        self.motion, self.times = motion, 0.5 + STEP * np.arange(FRAMES)
        self.samples = motion.samples(np.arange(0.0, 1.5 + STEP * FRAMES, 1 / 400))
        self.samples = replace(self.samples, timestamps=self.samples.timestamps + OFFSET)
        self.T_camera_imu = pose_from(TURN, LEVER)
        bodies = pose_from(motion.rotation(self.times), motion.position(self.times))
        self.poses_cw = torch.from_numpy(compose_poses(self.T_camera_imu, invert_poses(bodies)))
        g, count = torch.Generator().manual_seed(seed), FRAMES * PER_FRAME
        place = torch.rand(count, 2, 1, 1, generator=g, dtype=torch.float64) * torch.tensor([80.0, 60.0])[:, None, None]
        depth = 1 / (2 + 4 * torch.rand(count, 1, 1, 1, generator=g, dtype=torch.float64))
        kk = torch.arange(count).repeat_interleave(FRAMES)
        jj, ii = torch.arange(FRAMES).repeat(count), kk // PER_FRAME
        near = (ii != jj) & ((ii - jj).abs() <= 6)
        ii, jj, kk = ii[near], jj[near], kk[near]
        patches, camera = torch.cat([place, depth], 1), torch.from_numpy(CAMERA).expand(FRAMES, 4).contiguous()
        seen = reproject(self.poses_cw[None], patches[None], camera[None], ii, jj, kk)
        good = (seen.valid.view(-1) > 0)[:, None].expand(-1, 2).double()
        targets = torch.where(good > 0, seen.coords[0, :, 0, 0], 0.0)
        self.part = PatchProblem(
            self.poses_cw, patches, camera, targets, 0.5 * good, ii, jj, kk, identifiers=torch.arange(FRAMES) + 3
        )

    def start(self, scale: float, tilt: float) -> tuple[PatchProblem, Smoothed]:
        """A world that is larger by a factor, and tilted, with velocities to match."""
        turn = so3_exp(np.array([tilt, 0.0, 0.0]))
        rotation, position = split(se3.inverse(self.poses_cw).numpy())
        cameras = turn @ rotation, scale * position @ turn.T
        part = self.part.with_values(
            poses_cw=se3.inverse(torch.from_numpy(pose_from(*cameras))), inverse_depths=self.part.inverse_depths / scale
        )
        none, body = np.zeros((FRAMES, 3)), cameras[0] @ TURN
        velocity = scale * self.motion.velocity(self.times) @ turn.T
        smoothed = Smoothed(
            self.times, np.zeros(FRAMES, int), body, none, velocity, none, none,
            np.zeros(FRAMES), Similarities(np.zeros(1), np.eye(3)[None], np.zeros((1, 3))), OFFSET + 0.002, TURN,
            -TURN.T @ LEVER, 4.0, np.eye(23), 0.0, 1.0, np.ones(3),
        )  # fmt: skip
        return part, smoothed

    def adjusted(
        self, part: PatchProblem, start: Smoothed, variance: float = 0.01 / VISUAL, spacing: float = 0.2
    ) -> VisualInertialSolution | None:
        return adjust_with_samples(
            part, self.times, start, self.samples, NOISE, variance=variance, spacing=spacing
        )  # fmt: skip


@pytest.mark.parametrize(("scale", "tilt"), [(1.0, 0.0), (1.15, 0.03), (0.85, -0.03)])
def test_scale_vertical_and_states_are_found(scale: float, tilt: float) -> None:
    case = Case(Motion(1, 0.8))
    found = case.adjusted(*case.start(scale, tilt))
    assert found is not None
    poses_wc, true_wc = se3.inverse(found.poses_cw), se3.inverse(case.poses_cw)
    # Heading and place are those of the first camera of the start.
    turned = split(poses_wc.numpy())[0][0] @ split(true_wc.numpy())[0][0].T
    assert turned[2, 2] == pytest.approx(1, abs=1e-5)
    expected = (true_wc[:, :3] - true_wc[0, :3]).numpy() @ turned.T
    np.testing.assert_allclose((poses_wc[:, :3] - poses_wc[0, :3]).numpy(), expected, atol=6e-3)
    velocity = np.stack([case.motion.velocity(np.array(t)) for t in found.states.times])
    np.testing.assert_allclose(found.states.velocity, velocity @ turned.T, atol=2e-2)
    assert found.states.time_offset == pytest.approx(OFFSET, abs=5e-4)
    assert found.change == pytest.approx(-np.log(scale), abs=6e-3)
    assert found.inertial_error < 0.1
    assert found.identifiers.tolist() == list(range(3, 3 + FRAMES))
    # The states are those of the bodies of these cameras.
    at = np.searchsorted(case.times, found.states.times - 1e-9)
    rotation, position = split(poses_wc.numpy()[at])
    np.testing.assert_allclose(found.states.rotation, rotation @ TURN, atol=1e-12)
    np.testing.assert_allclose(found.states.position, position + rotation @ LEVER, atol=1e-9)


def test_the_deviation_of_the_scale_is_that_of_solutions_with_noise() -> None:
    case, changes, told = Case(Motion(2, 0.8)), [], []
    part, start = case.start(1.0, 0.0)
    exact, rng = case.samples, np.random.default_rng(0)
    for seed in range(12):
        g = torch.Generator().manual_seed(seed)
        noise = 0.1 / 0.5**0.5 * torch.randn(part.targets.shape, generator=g, dtype=torch.float64)
        gyro, accel = (density * 400**0.5 * rng.normal(size=exact.gyro.shape) for density in (1e-3, 1e-2))
        case.samples = replace(exact, gyro=exact.gyro + gyro, accel=exact.accel + accel)
        found = case.adjusted(part.with_values(targets=part.targets + noise), start)
        assert found is not None
        changes.append(found.change)
        told.append(found.scale_sigma)
    assert 0.4 < np.sqrt(np.mean(np.square(changes))) / np.mean(told) < 2.0


def test_a_constant_velocity_tells_no_scale() -> None:
    moved, steady = (Case(motion) for motion in (Motion(3, 0.8), Steady(3, 0.8)))
    known, unknown = (case.adjusted(*case.start(1.0, 0.0)) for case in (moved, steady))
    assert known is not None
    assert unknown is not None
    assert unknown.scale_sigma > 5 * known.scale_sigma


def test_samples_that_contradict_the_images_are_told() -> None:
    case = Case(Motion(4, 0.8))
    good = case.adjusted(*case.start(1.0, 0.0))
    case.samples = replace(case.samples, accel=case.samples.accel[:, [1, 0, 2]])
    bad = case.adjusted(*case.start(1.0, 0.0))
    assert good is not None
    assert bad is not None
    assert bad.inertial_error > 100 * good.inertial_error


def test_samples_that_end_early() -> None:
    case = Case(Motion(5, 0.8))
    case.samples = case.samples.between(0.0, 1.5)
    found = case.adjusted(*case.start(1.0, 0.0))
    assert found is not None
    assert found.states.times[-1] < 1.5
    assert torch.isfinite(found.poses_cw).all()
    case.samples = case.samples.between(0.0, 0.6)
    assert case.adjusted(*case.start(1.0, 0.0)) is None


def test_samples_with_gaps() -> None:
    case = Case(Motion(6, 0.8))
    whole = case.adjusted(*case.start(1.1, 0.02))
    times = case.samples.timestamps
    kept = ~((times > 1.2) & (times < 1.5)) & ~((times > 1.62) & (times < 1.95))  # one node stands alone between them
    case.samples = InertialSamples(times[kept], case.samples.gyro[kept], case.samples.accel[kept])
    found = case.adjusted(*case.start(1.1, 0.02))
    assert whole is not None
    assert found is not None
    assert found.change == pytest.approx(-np.log(1.1), abs=0.02)
    assert found.scale_sigma > whole.scale_sigma
    assert np.isfinite(found.states.velocity).all()
