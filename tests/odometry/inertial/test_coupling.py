"""Samples between the keyframes of a window: what they hold, from when on, and with what weight."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from dvo.ba.blocks import POSES, VELOCITY, pose_block
from dvo.ba.layer.step import gauss_newton
from dvo.ba.options import BADamping, BAOptions
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import Problem, State
from dvo.ba.solve import solve
from dvo.core.kernels import CHOICES, VARIABLE
from dvo.geometry import se3
from dvo.geometry.poses import pose_from
from dvo.map.window import Keyframe, Window
from dvo.odometry.inertial.coupling import InertialCoupling
from dvo.odometry.inertial.estimator import InertialEstimator, Similarity
from dvo.odometry.inertial.options import InertialOptions
from tests.support.visual_inertial import CAMERA_IMU, LEVER, SCALE, Recording, record
from tests.support.window_problem import window_problem

VARIANCE, FREE, KEYFRAMES, SPACING = 0.0074, 5, 8, 4  # keyframes 0.2 s apart


@pytest.fixture(scope="module")
def aligned() -> tuple[Recording, InertialEstimator]:
    recording = record(3)
    estimator = InertialEstimator(InertialOptions())
    estimator.add(recording.samples.between(-np.inf, 10.5))
    for time in (8.0, 9.0, 10.0):
        estimator.update(recording.nodes(time - 8.0, time), [0])
    assert estimator.aligned
    return recording, estimator


def coupled(recording: Recording, estimator: InertialEstimator) -> InertialCoupling:
    known = Similarity(SCALE, estimator.worlds[0].rotation, np.zeros(3)) if estimator.worlds else None
    return InertialCoupling(estimator, lambda: known, VARIANCE, FREE)


def window_at(recording: Recording, last: float) -> Window:
    """Keyframes with true poses, in the world of the images."""
    newest = int(np.searchsorted(recording.times, last))
    chosen = newest - SPACING * np.arange(KEYFRAMES)[::-1]
    rotation, position = recording.body[0][chosen], recording.body[1][chosen]
    camera = position + rotation @ LEVER
    poses_wc = pose_from(recording.turn @ rotation @ CAMERA_IMU.T, camera @ recording.turn.T / SCALE)
    window, none = Window.empty(1, 1, 1, torch.device("cpu")), torch.zeros(0)
    for number, (time, pose) in enumerate(zip(recording.times[chosen], poses_wc, strict=True)):
        frame = Keyframe(number, float(time), number, none, none, none, torch.ones(4))
        window.append(frame, se3.inverse(torch.from_numpy(pose)).float(), torch.ones(1, 3, 1, 1))
    return window


def solved(window: Window, coupling: InertialCoupling, fixed: int) -> tuple[np.ndarray, dict[str, torch.Tensor]]:
    """Centres of the cameras after a solution of the samples alone, and all values."""
    factors, blocks = coupling.factors(window), coupling.blocks(window)
    state = State({**blocks, POSES: pose_block(window.poses_cw.double()[None], fixed)})
    values = gauss_newton(Problem(state, factors), 4, BADamping(pose=1e-9, relative=0.0)).state.values()
    return se3.inverse(values[POSES][0]).numpy()[:, :3], values


def test_without_an_alignment_nothing_is_measured(aligned) -> None:
    recording, estimator = aligned
    window = window_at(recording, 9.9)
    assert coupled(recording, estimator).factors(window) and coupled(recording, estimator).blocks(window)
    unknown = InertialCoupling(estimator, lambda: None, VARIANCE, FREE)
    assert unknown.factors(window) == () and unknown.blocks(window) == {}
    waiting = InertialEstimator(InertialOptions())
    waiting.add(recording.samples)
    assert coupled(recording, waiting).factors(window) == () and coupled(recording, waiting).blocks(window) == {}
    window.frames[0] = replace(window.frames[0], guest=True)  # of a map, with a unit of its own
    assert coupled(recording, estimator).factors(window) == ()


def test_samples_that_hold_no_velocity_are_no_measurement(aligned) -> None:
    recording, estimator = aligned
    vague = copy(estimator)
    vague.solution = replace(estimator.solution, covariance=100 * estimator.solution.covariance)
    assert coupled(recording, vague).factors(window_at(recording, 9.9)) == ()


@pytest.mark.parametrize("last", [9.9, 10.3])  # before the newest node of the estimate, and after it
def test_the_unit_of_a_window_is_held(aligned, last: float) -> None:
    recording, estimator = aligned
    window = window_at(recording, last)
    true = se3.inverse(window.poses_cw.double()).numpy()
    wrong = true.copy()
    wrong[-4:, :3] = true[-5, :3] + 1.2 * (true[-4:, :3] - true[-5, :3])
    window.poses_cw = se3.inverse(torch.from_numpy(wrong)).float()
    centres, values = solved(window, coupled(recording, estimator), fixed=KEYFRAMES - 4)
    before, after = (np.linalg.norm(x[-4:, :3] - true[-4:, :3], axis=1) for x in (wrong, centres))
    assert after[-1] < before[-1] / 3
    speed = recording.body[2][np.searchsorted(recording.times, window.frames[-1].timestamp - 1e-6)]
    found = values[VELOCITY][0, -1].numpy()
    assert np.linalg.norm(found - recording.turn @ speed / SCALE) < 0.05 * np.linalg.norm(speed) / SCALE + 0.05


def test_residuals_of_the_truth_are_as_large_as_the_noise(aligned) -> None:
    recording, estimator = aligned
    found = []
    for last in np.arange(8.6, 10.3, 0.2):
        window, coupling = window_at(recording, float(last)), coupled(recording, estimator)
        centres, values = solved(window, coupling, fixed=KEYFRAMES)
        motion = coupling.factors(window)[0]
        residual = motion.linearise(values).residual[0].numpy() / np.sqrt(VARIANCE)
        found.append((residual**2).mean())
    assert 0.1 < np.mean(found) < 3.0  # the velocities and biases have been fitted to them


def test_a_keyframe_without_samples_ends_the_chain(aligned) -> None:
    recording, estimator = aligned
    late = window_at(recording, 11.0)  # samples end at 10.5 s
    motion = coupled(recording, estimator).factors(late)[0]
    assert len(motion.ii) == 1 and int(motion.jj[-1]) == KEYFRAMES - FREE + 1
    assert coupled(recording, estimator).factors(window_at(recording, 12.5)) == ()


def test_kernels_and_twins_agree_with_samples(aligned, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, estimator = aligned
    window, coupling = window_at(recording, 9.9), coupled(recording, estimator)
    _, patches, intrinsics, targets, weights, ii, jj, kk = window_problem(2, frames=KEYFRAMES)
    found = []
    for choice in CHOICES:
        monkeypatch.setenv(VARIABLE, choice)
        problem = PatchProblem(
            window.poses_cw[None], patches, intrinsics, targets, weights, ii, jj, kk,
            factors=coupling.factors(window), blocks=coupling.blocks(window),
        )  # fmt: skip
        with torch.inference_mode():
            found.append(solve(problem, BAOptions(fixed=KEYFRAMES - FREE, iterations=2)))
    one, other = found
    assert one.poses_cw.dtype == torch.float32 and one.blocks[VELOCITY].dtype == torch.float64
    assert not torch.equal(one.poses_cw, window.poses_cw[None])
    torch.testing.assert_close(one.poses_cw, other.poses_cw, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(one.patches, other.patches, atol=1e-3, rtol=1e-3)
