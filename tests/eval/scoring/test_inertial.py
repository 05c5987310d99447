"""Errors of metric poses, on runs made by hand from the truth."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import compose_poses, pose_from, quaternion_to_matrix, so3_exp
from dvo.odometry.protocol import Estimate, Segment, Status
from eval.execution.streamed import Streamed, StreamLog
from eval.scoring.inertial import InertialErrors, inertial_errors
from eval.suites.inertial import InertialTruth

RATE, COUNT = 20.0, 600
TIMES = np.arange(COUNT) / RATE


def truth_of(stretches: tuple[tuple[float, float], ...] = ()) -> tuple[Trajectory, InertialTruth]:
    """A walk on a curve with a turning gaze; the sensor is at the camera."""
    position = np.stack([2 * np.sin(0.5 * TIMES), 1.5 * np.cos(0.7 * TIMES), 0.3 * np.sin(1.1 * TIMES)], -1)
    angles = np.stack([0.2 * np.sin(TIMES), 0.3 * np.cos(0.6 * TIMES), 0.4 * np.sin(0.4 * TIMES)], -1)
    reference = Trajectory(TIMES, pose_from(so3_exp(angles), position))
    velocity = np.gradient(position, 1 / RATE, axis=0)
    biases = np.full((COUNT, 3), 0.01), np.full((COUNT, 3), 0.1)
    mount = np.array([0, 0, 0, 0, 0, 0, 1.0])
    return reference, InertialTruth(TIMES, velocity, *biases, mount, 0.01, np.array(stretches, float).reshape(-1, 2))


def streamed_of(poses: np.ndarray, truth: InertialTruth, state: str = "refined") -> Streamed:
    return Streamed(
        TIMES, poses, np.full(COUNT, "tracking"), np.zeros(COUNT, int), np.full(COUNT, state, dtype="<U12"),
        truth.velocity_w.copy(), truth.gyro_bias.copy(), truth.accel_bias.copy(), np.full(COUNT, 0.01),
        np.full(COUNT, 0.01), np.tile(1e-4 * np.eye(9), (COUNT, 1, 1)),
    )  # fmt: skip


def errors_of(streamed: Streamed, reference: Trajectory, truth: InertialTruth, **dark) -> InertialErrors:
    rows = np.isfinite(streamed.poses_wc[:, 0])
    track = Trajectory(streamed.timestamps[rows], streamed.poses_wc[rows])
    return inertial_errors(streamed, (Segment(track, 0.0, TIMES[-1]),), reference, truth, **dark)


def scaled(poses: np.ndarray, factor: float | np.ndarray) -> np.ndarray:
    out = poses.copy()
    out[:, :3] *= np.broadcast_to(factor, (len(poses),))[:, None]
    return out


def tilted(poses: np.ndarray, degrees: float) -> np.ndarray:
    turn = pose_from(so3_exp(np.array([math.radians(degrees), 0, 0])), np.zeros(3))
    return compose_poses(np.broadcast_to(turn, poses.shape), poses)


@settings(max_examples=8, deadline=None)
@given(yaw=st.floats(-3, 3), east=st.floats(-20, 20), north=st.floats(-20, 20))
def test_a_perfect_run_has_no_error_wherever_its_world_lies(yaw: float, east: float, north: float) -> None:
    reference, truth = truth_of()
    turn = so3_exp(np.array([0, 0, yaw]))
    moved = compose_poses(np.broadcast_to(pose_from(turn, np.array([east, north, 3])), (COUNT, 7)), reference.poses_wc)
    run = replace(streamed_of(moved, truth), velocity_w=truth.velocity_w @ turn.T)
    found = errors_of(run, reference, truth, dark=[(15.0, 17.0)], unseen=[15.0, 16.0, 17.0])
    for name in ("scale_10s", "gravity_deg", "nees_position", "nees_orientation", "nees_velocity", "dark_cm"):
        assert getattr(found, name) == pytest.approx(0, abs=1e-4), name
    assert found.align_s == 0 and found.coverage == 1 and found.wrong_alignments == 0
    assert found.gyro_bias_error == found.accel_bias_error == found.offset_error_ms == 0
    assert found.dark_tracked == 41


def test_nees_is_one_for_errors_of_the_stated_covariance() -> None:
    reference, truth = truth_of()
    rng = np.random.default_rng(2)
    factor = np.linalg.cholesky(np.diag([4e-4] * 3 + [1e-4] * 3 + [9e-4] * 3) + 5e-5)
    errors = rng.normal(size=(COUNT, 9)) @ factor.T
    errors[0] = 0  # the pose at the alignment is the reference
    rotation = quaternion_to_matrix(reference.poses_wc[:, 3:])
    poses = pose_from(rotation @ so3_exp(-errors[:, 3:6]), reference.positions - errors[:, :3])
    run = replace(
        streamed_of(poses, truth), velocity_w=truth.velocity_w - errors[:, 6:],
        covariance=np.tile(factor @ factor.T, (COUNT, 1, 1)),
    )  # fmt: skip
    found = errors_of(run, reference, truth)
    for name in ("nees_position", "nees_orientation", "nees_velocity"):
        assert getattr(found, name) == pytest.approx(1, abs=0.2), name
    sure = errors_of(replace(run, covariance=run.covariance / 4), reference, truth)
    assert sure.nees_position == pytest.approx(4 * found.nees_position)
    doubt = np.where(np.abs(TIMES - 15) < 5, "initialising", "aligned")
    assert errors_of(replace(run, scale_state=doubt), reference, truth).nees_position == found.nees_position


def test_a_segment_in_the_same_world_has_no_origin_of_its_own() -> None:
    reference, truth = truth_of()
    poses, late = reference.poses_wc.copy(), TIMES >= 15
    poses[late, 0] += 0.1
    run = replace(streamed_of(poses, truth), segment=late.astype(int))
    parts = [Segment(Trajectory(TIMES[mine], poses[mine]), 0.0, 30.0) for mine in (~late, late)]
    apart = inertial_errors(run, tuple(parts), reference, truth)
    joined = inertial_errors(run, (parts[0], replace(parts[1], joined_to=0)), reference, truth)
    assert apart.nees_position < 1e-3
    assert joined.nees_position == pytest.approx(0.5 * 0.1**2 / 1e-4 / 3, rel=0.05)


def test_time_to_alignment_and_scale() -> None:
    reference, truth = truth_of()
    run = streamed_of(scaled(reference.poses_wc, np.where(TIMES < 6, 3.0, 1.02)), truth)
    state = np.where(TIMES < 6, "initialising", "aligned")
    found = errors_of(replace(run, scale_state=state), reference, truth)
    assert found.align_s == pytest.approx(6, abs=0.4) and found.scale_10s == pytest.approx(2, abs=0.1)
    assert found.wrong_alignments == 0
    late = errors_of(streamed_of(scaled(reference.poses_wc, np.where(TIMES < 29, 1.0, 1.2)), truth), reference, truth)
    assert math.isinf(late.align_s)
    reference, truth = truth_of(((0.0, 5.0),))
    assert errors_of(replace(run, scale_state=state), reference, truth).align_s == pytest.approx(1, abs=0.4)


@pytest.mark.parametrize(("factor", "degrees", "wrong"), [(1.05, 2, 0), (1.2, 0, 1), (0.8, 0, 1), (1.0, 8, 1)])
def test_wrong_alignments_are_counted(factor: float, degrees: float, wrong: int) -> None:
    reference, truth = truth_of()
    poses = np.where(TIMES[:, None] < 5, reference.poses_wc, tilted(scaled(reference.poses_wc, factor), degrees))
    state = np.where(TIMES < 5, "initialising", np.where(TIMES < 9, "aligned", "initialising"))
    run = replace(streamed_of(poses, truth), scale_state=state)
    assert errors_of(run, reference, truth).wrong_alignments == wrong
    both = replace(run, scale_state=np.where((TIMES > 20) & (TIMES < 27), "aligned", state))
    assert errors_of(both, reference, truth).wrong_alignments == 2 * wrong


def test_displacements_across_an_alignment_do_not_judge_it() -> None:
    reference, truth = truth_of()
    poses = reference.poses_wc.copy()
    poses[TIMES < 12.5, 0] += 10
    state = np.where((TIMES >= 12.5) & (TIMES < 12.9), "aligned", "initialising")
    assert errors_of(replace(streamed_of(poses, truth), scale_state=state), reference, truth).wrong_alignments == 0


def test_a_few_centimetres_between_rests_tell_no_scale() -> None:
    reference, truth = truth_of()
    poses, rest = reference.poses_wc.copy(), (TIMES > 10) & (TIMES < 20)
    poses[rest] = poses[np.flatnonzero(rest)[0]]
    after = rest & (TIMES > 15)
    poses[after, 0] += np.minimum(0.25 * (TIMES[after] - 15), 0.05)
    reference, found = Trajectory(TIMES, poses), poses.copy()
    found[after, 0] += 0.2 * np.minimum(0.25 * (TIMES[after] - 15), 0.05)
    state = np.where((TIMES > 10.6) & (TIMES < 19.4), "aligned", "initialising")
    assert errors_of(replace(streamed_of(found, truth), scale_state=state), reference, truth).wrong_alignments == 0


def test_gravity_is_that_of_systems_that_align() -> None:
    reference, truth = truth_of()
    run = streamed_of(tilted(reference.poses_wc, 2.0), truth)
    assert errors_of(run, reference, truth).gravity_deg == pytest.approx(2, abs=1e-3)
    waiting = replace(run, scale_state=np.full(COUNT, "initialising"))
    assert math.isnan(errors_of(waiting, reference, truth).gravity_deg)
    silent = errors_of(replace(run, scale_state=np.full(COUNT, "none")), reference, truth)
    assert silent.gravity_deg == pytest.approx(2, abs=1e-3) and math.isnan(silent.wrong_alignments)


def test_errors_in_the_dark() -> None:
    reference, truth = truth_of()
    dark = {"dark": [(10.0, 12.0)], "unseen": TIMES[(TIMES >= 10) & (TIMES <= 12)].tolist()}
    poses = reference.poses_wc.copy()
    poses[240, :3] += [0.06, 0.08, 0]  # the last dark frame
    status = np.where((TIMES >= 10) & (TIMES <= 12), "inertial", "tracking")
    run = replace(streamed_of(poses, truth), status=status)
    found = errors_of(run, reference, truth, **dark)
    way = np.linalg.norm(np.diff(reference.positions[199:241], axis=0), axis=1).sum()
    assert found.dark_cm == pytest.approx(10) and found.dark_percent == pytest.approx(100 * 0.1 / way)
    assert found.dark_sigmas == pytest.approx(0.1 / math.sqrt(3e-4)) and found.dark_tracked == 0
    status[205] = "tracking"
    assert errors_of(replace(run, status=status), reference, truth, **dark).dark_tracked == 1
    for change in ({"segment": np.where(TIMES > 11, 1, 0)}, {"poses_wc": np.where(TIMES[:, None] > 11, np.nan, poses)}):
        assert math.isinf(errors_of(replace(run, **change), reference, truth, **dark).dark_cm)


def test_frames_without_a_pose_lower_the_coverage() -> None:
    reference, truth = truth_of()
    poses = np.where(TIMES[:, None] < 3, np.nan, reference.poses_wc)
    assert errors_of(streamed_of(poses, truth), reference, truth).coverage == pytest.approx(0.9)
    assert inertial_errors(None, (), reference, truth).coverage != 1


def test_what_a_system_does_not_tell_is_empty(tmp_path: Path) -> None:
    reference, truth = truth_of()
    log = StreamLog()
    for time, pose in zip(TIMES, reference.poses_wc, strict=True):
        log.take(Estimate(float(time), pose if time > 1 else None, Status.TRACKING if time > 1 else Status.LOST))
    log.streamed().write(tmp_path)
    read = Streamed.read(tmp_path)
    assert read is not None and Streamed.read(tmp_path / "elsewhere") is None
    np.testing.assert_array_equal(read.poses_wc, log.streamed().poses_wc)
    found = errors_of(read, reference, truth)
    assert found.align_s == pytest.approx(0, abs=1.5) and found.gravity_deg == pytest.approx(0, abs=1e-4)
    for name in ("nees_position", "gyro_bias_error", "offset_error_ms", "wrong_alignments", "dark_cm", "dark_tracked"):
        assert math.isnan(getattr(found, name)), name
