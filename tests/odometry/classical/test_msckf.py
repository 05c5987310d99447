"""The inertial filter: its parts against plain computations, its consistency in a simulator, and a film."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dvo
from dvo.core.errors import DvoError
from dvo.data.inertial import NOISE_PRESETS, ImuNoise, InertialSamples
from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import pose_matrices, poses_from_matrices, so3_exp
from dvo.metrics import evaluate
from dvo.odometry.classical.msckf import Msckf, MsckfConfig
from dvo.odometry.classical.msckf.estimator import Estimator
from dvo.odometry.classical.msckf.features import Clones, Layout, Views, chi_square_bound, linearise, triangulate
from dvo.odometry.classical.msckf.motion import Motion, SampleBuffer, Stretch, propagate, rotation_vector
from dvo.odometry.protocol import Odometry, Status
from dvo.synth.sensors.imu import measure_imu
from tests.support.inertial_world import FOCAL, RATE, T_CAMERA_IMU, Hand, Straight, world

QUIET = ImuNoise(*[1e-12] * 6)
UP = np.array([0.0, 0, 1])
seeds = st.integers(0, 2**32 - 1)


def motion_of(rng, scale=1.0):
    return Motion(so3_exp(rng.normal(0, scale, 3)), rng.normal(0, scale, 3), rng.normal(0, scale, 3))


def stretch_of(rng, count=12):
    times = np.cumsum(rng.uniform(0.003, 0.008, count))
    return Stretch(times, rng.normal(0, 1, (count, 3)), rng.normal(0, 5, (count, 3)))


def moved(motion, change):
    return Motion(motion.R @ so3_exp(change[3:6]), motion.p + change[:3], motion.v + change[6:9])


def difference(one, two):
    return np.concatenate([two.p - one.p, rotation_vector(one.R.T @ two.R), two.v - one.v])


# --- propagation ------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_samples_without_noise_lead_along_the_path():
    body, times = Hand(3, 0.0, T=T_CAMERA_IMU), 1 + np.arange(401) / RATE
    imu = measure_imu(body, times)
    poses = pose_matrices(body.poses_wc(times[[0, -1]]))
    ends = pose_matrices(body.poses_wc(times[[0, 0, -1, -1]] + [-1e-4, 1e-4, -1e-4, 1e-4]))
    speeds = (ends[1::2, :3, 3] - ends[::2, :3, 3]) / 2e-4
    begin = Motion(poses[0, :3, :3], poses[0, :3, 3], speeds[0])
    end, _, _ = propagate(Stretch(times, imu.gyro, imu.accel), begin, np.zeros(6), QUIET)
    assert np.abs(difference(end, Motion(poses[1, :3, :3], poses[1, :3, 3], speeds[1]))).max() < 2e-3


@settings(max_examples=3, deadline=None)
@given(seeds)
def test_the_transition_is_the_derivative(seed):
    rng = np.random.default_rng(seed)
    stretch, motion, bias = stretch_of(rng), motion_of(rng), rng.normal(0, 0.1, 6)
    end, transition, _ = propagate(stretch, motion, bias, QUIET)
    for k in range(15):
        change = 1e-5 * np.eye(15)[k]
        other, _, _ = propagate(stretch, moved(motion, change), bias + change[9:], QUIET)
        assert np.allclose(difference(end, other) / 1e-5, transition[:9, k], atol=3e-4)


@settings(max_examples=6, deadline=None)
@given(seeds)
def test_heading_and_position_stay_unknown_with_first_estimates(seed):
    """The transition takes the unobservable directions of the first estimates to those of the prediction."""
    rng = np.random.default_rng(seed)
    first = motion_of(rng)
    now = moved(first, rng.normal(0, 0.05, 9))
    end, transition, _ = propagate(stretch_of(rng), now, rng.normal(0, 0.1, 6), QUIET, first=first)

    def directions(motion):
        turn = np.concatenate([np.cross(UP, motion.p), motion.R.T @ UP, np.cross(UP, motion.v), np.zeros(6)])
        return np.column_stack([turn, np.eye(15)[:, :3]])

    assert np.allclose(transition @ directions(first), directions(end), atol=1e-9)


def test_the_covariance_is_that_of_many_runs():
    rng, noise = np.random.default_rng(0), ImuNoise(0.02, 1e-12, 0.2, 1e-12)
    stretch, motion = stretch_of(rng, 6), motion_of(rng)
    end, _, covariance = propagate(stretch, motion, np.zeros(6), noise)
    errors = []
    for _ in range(300):
        # of the mean rate of each step, as the model has it: the samples themselves are averaged in pairs
        steps = np.diff(stretch.times)
        parts = [rng.normal(0, 1, (len(steps), 3)) * s / np.sqrt(steps)[:, None] for s in (noise.gyro, noise.accel)]
        noisy, at = [], motion
        for k in range(len(steps)):
            piece = Stretch(
                stretch.times[k : k + 2], stretch.gyro[k : k + 2] + parts[0][k], stretch.accel[k : k + 2] + parts[1][k]
            )
            at, _, _ = propagate(piece, at, np.zeros(6), QUIET)
        noisy.append(at)
        errors.append(difference(end, at))
    measured = np.cov(np.array(errors).T)
    ratio = np.linalg.eigvals(np.linalg.solve(covariance[:9, :9] + 1e-15 * np.eye(9), measured)).real
    assert ratio.min() > 0.6 and ratio.max() < 1.5


def test_a_buffer_interpolates_its_ends_and_holds_beyond_them():
    buffer = SampleBuffer()
    values = np.outer(np.arange(5.0), np.ones(3))
    buffer.add(InertialSamples(np.arange(5.0), values, 2 * values))
    buffer.add(InertialSamples(np.arange(5.0), values, values))  # known already
    assert len(buffer) == 5
    stretch = buffer.between(0.5, 5.5)
    assert stretch.times.tolist() == [0.5, 1, 2, 3, 4, 5.5]
    assert stretch.gyro[:, 0].tolist() == [0.5, 1, 2, 3, 4, 4] and stretch.accel[0, 0] == 1.0


# --- points -----------------------------------------------------------------------------------------------------------


def scene(rng, count=6, views=8, delay=0.0):
    """Clones, points before them, and exact observations."""
    motions = [motion_of(rng, 0.15) for _ in range(views)]
    clones = Clones(
        *(np.array([getattr(m, name) for m in motions]) for name in ("R", "p", "v")), rng.normal(0, 0.3, (views, 3))
    )
    R_bc, p_bc = so3_exp(rng.normal(0, 0.1, 3)), rng.normal(0, 0.05, 3)
    points = np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.uniform(3, 6, count)])
    point, clone = np.repeat(np.arange(count), views), np.tile(np.arange(views), count)
    delays = delay * rng.normal(size=len(point))
    return clones, R_bc, p_bc, points, observe(clones, R_bc, p_bc, points, point, clone, delays)


def observe(clones, R_bc, p_bc, points, point, clone, delays):
    R, p, _ = clones.shifted(clone, delays)
    body = np.einsum("kji,kj->ki", R, points[point] - p)
    local = (body - p_bc) @ R_bc
    return Views(point, clone, local[:, :2] / local[:, 2:], delays)


@pytest.mark.long
@settings(max_examples=10, deadline=None)
@given(seeds)
def test_points_are_found(seed):
    clones, R_bc, p_bc, points, views = scene(np.random.default_rng(seed), delay=0.01)
    R, p, _ = clones.shifted(views.clone, views.delay)
    found, good = triangulate(views, R @ R_bc, p + R @ p_bc)
    assert good.all() and np.allclose(found, points, atol=1e-4)


@pytest.mark.long
@settings(max_examples=10, deadline=None)
@given(seeds)
def test_residuals_without_points_are_linear_in_the_error(seed):
    """Poses, extrinsics and delay are off by a small error: the residual is the Jacobian times it."""
    rng = np.random.default_rng(seed)
    clones, R_bc, p_bc, points, views = scene(rng, delay=0.01)
    size = 7 + 6 * len(clones.p)
    layout = Layout(size, 7 + 6 * np.arange(len(clones.p)), 0, 6)
    change = 1e-5 * rng.normal(size=size)
    by = change[7:].reshape(-1, 6)
    true = Clones(clones.R @ so3_exp(by[:, 3:]), clones.p + by[:, :3], clones.v, clones.rate)
    seen = observe(true, R_bc @ so3_exp(change[3:6]), p_bc + change[:3], points, views.point, views.clone,
                   views.delay + change[6])  # fmt: skip
    seen = replace(seen, delay=views.delay)
    off = points + 1e-5 * rng.normal(size=points.shape)
    measured = linearise(seen, off, clones, clones, R_bc, p_bc, layout)
    assert np.abs(measured.residual).max() > 1e-7
    assert np.allclose(measured.residual, measured.jacobian @ change, atol=2e-9)


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_images_tell_neither_heading_nor_position(seed):
    rng = np.random.default_rng(seed)
    first, R_bc, p_bc, points, views = scene(rng)
    now = replace(first, p=first.p + rng.normal(0, 0.01, first.p.shape))
    layout = Layout(6 * len(first.p), 6 * np.arange(len(first.p)))
    J = linearise(views, points, now, first, R_bc, p_bc, layout).jacobian
    turn = np.concatenate([np.concatenate([np.cross(UP, p), R.T @ UP]) for R, p in zip(first.R, first.p, strict=True)])
    free = np.column_stack([turn, np.tile(np.eye(6)[:, :3], (len(first.p), 1))])
    assert np.abs(J @ free).max() < 1e-9 < 1e-2 < np.abs(J).max()


def test_the_bound_of_chi_square():
    for freedoms, known in ((1, 3.841), (5, 11.070), (30, 43.773)):
        assert chi_square_bound(freedoms) == pytest.approx(known, rel=0.03)


# --- the simulator ----------------------------------------------------------------------------------------------------


def simulate(scene, **options):
    """Estimator over a world; errors of position, orientation and velocity over their covariance, and the ATE."""
    estimator = Estimator(MsckfConfig(pixel=1.0, drift=1.0, **options), T_CAMERA_IMU, scene.noise, FOCAL)
    waiting, nees, pairs, align = [], [], [], None
    for k, (seen, samples) in enumerate(scene.frames):
        estimator.add(samples)
        waiting.append(seen)
        while waiting and estimator.is_ready(waiting[0].time):
            estimator.step(waiting.pop(0))
        if estimator.filter is None:
            continue
        state = estimator.predict(seen.time)
        R, p, v = scene.truth(scene.times[k])
        if align is None:  # the world of the start: its heading and position
            R0, p0, _ = scene.truth(estimator.start.time)
            D = estimator.start.motion.R @ R0.T
            align = so3_exp(np.arctan2(D[1, 0] - D[0, 1], D[0, 0] + D[1, 1]) * UP)
            shift = estimator.start.motion.p - align @ p0
        error = difference(state.motion, Motion(align @ R, align @ p + shift, align @ v))
        blocks = (slice(0, 3), slice(3, 6), slice(6, 9))
        nees.append([error[b] @ np.linalg.solve(state.P[b, b] + 1e-12 * np.eye(3), error[b]) for b in blocks])
        pairs.append((p, state.motion.p))
    if not pairs:
        return estimator, None, None
    truth, found = (np.array(side) for side in zip(*pairs, strict=True))
    rows = np.tile([0.0, 0, 0, 1], (len(truth), 1))
    times = np.arange(len(truth)) / 20
    metrics = evaluate(
        Trajectory(times, np.hstack([found, rows])), Trajectory(times, np.hstack([truth, rows])), align="se3"
    )
    return estimator, np.array(nees[20:]).mean(0), metrics


@pytest.mark.long
@pytest.mark.parametrize(
    ("most", "options"),
    [
        (1.5, {"rest": 1.2}),
        (1.5, {"offset": 0.015, "readout": 0.02}),
        (4.0, {"rest": 1.2, "noise": NOISE_PRESETS["phone"]}),
    ],
)
def test_it_is_consistent(most, options):
    """Expected are 3 for each of position, orientation and velocity; over seeds the mean is within wide bounds."""
    runs = [simulate(world(seed, 6.0, **options)) for seed in (0, 2)]
    nees = np.mean([found for _, found, _ in runs], 0)
    assert (nees > 0.4).all() and (nees < 9).all(), nees
    for estimator, _, metrics in runs:
        assert metrics.ate_percent < most and abs(estimator.filter.offset - options.get("offset", 0.0)) < 2e-3
        assert estimator.rejected < 0.15 * estimator.updates


def test_standing_still_it_stays():
    estimator, _, _ = simulate(world(1, 6.0, rest=100.0))
    f = estimator.filter
    assert estimator.rests > 40 and np.linalg.norm(f.motion.p) < 0.01 and np.linalg.norm(f.motion.v) < 0.01
    assert len(f.clones) < 4 and np.sqrt(f.P[9:12, 9:12].diagonal()).max() < 3e-4


@pytest.mark.long
def test_constant_velocity_starts_nothing():
    estimator, _, _ = simulate(world(4, 2.8, motion=Straight()))
    assert estimator.filter is None and estimator.reason == "too little motion"


def test_darkness_is_crossed_by_the_samples():
    found = world(2, 6.0, rest=1.2)
    empty = [
        (replace(o, ids=o.ids[:0], xy=o.xy[:0], delay=o.delay[:0]) if 4 < o.time < 5.5 else o, s)
        for o, s in found.frames
    ]
    estimator, nees, metrics = simulate(replace(found, frames=empty))
    assert (nees < 12).all() and metrics.ate_percent < 2 and metrics.completeness == 1


# --- images -----------------------------------------------------------------------------------------------------------


class Before(Hand):
    """A hand before a wall: the camera looks along z, and y points down."""

    def poses_wc(self, times):
        poses = super().poses_wc(times)
        back = so3_exp(np.array([np.pi / 2, 0, 0]))
        turned = pose_matrices(poses)
        turned[:, :3] = back @ turned[:, :3]
        return poses_from_matrices(turned)


def filmed(film, seconds, rest, seed=5):
    """Frames of a walk with the samples of a sensor at the camera, and the truth."""
    path = Before(seed, rest, speed=0.35, turn=0.2)
    times, stamps = np.arange(int(20 * seconds)) / 20, np.arange(int(RATE * seconds)) / RATE
    noise = ImuNoise()
    imu = measure_imu(path, stamps, noise=noise, seed=seed, gravity=np.array([0, 9.81, 0]))
    samples = InertialSamples(stamps, imu.gyro, imu.accel, np.array([0.0, 0, 0, 0, 0, 0, 1]), noise)
    truth = Trajectory(times, path.poses_wc(times))
    grain = np.random.default_rng(seed)
    frames = [
        replace(frame, image=np.clip(frame.image + grain.integers(-2, 3, frame.image.shape), 0, 255).astype(np.uint8))
        for frame in film(truth)
    ]
    return [frames[0], *(
        replace(frame, inertial=samples.between(before.timestamp, frame.timestamp))
        for before, frame in zip(frames[:-1], frames[1:], strict=True)
    )], truth  # fmt: skip


@pytest.mark.long
def test_a_film_in_metres_with_z_up(film, dark):
    frames, truth = filmed(film, 5.5, rest=1.3)
    odometry = dvo.load("msckf", corners=120)
    assert isinstance(odometry, Odometry) and isinstance(odometry, Msckf)
    estimates = [odometry.track(frame) for frame in dark(frames, 60, 64)]
    result = odometry.finish()
    assert estimates[5].status is Status.INITIALISING and estimates[5].pose_wc is None
    assert estimates[5].scale_state == "initialising" and estimates[5].reason == "standing still"
    assert [e.status for e in estimates[60:64]] == [Status.INERTIAL] * 4 and estimates[60].reason == "black image"
    assert set(truth.timestamps[60:64]) <= set(result.inertial) and result.frames_tracked < len(frames)
    spread = [np.trace(e.inertial.covariance[:3, :3]) for e in estimates[60:64]]
    assert all(np.diff(spread) > 0) and estimates[63].reference < estimates[60].timestamp
    last = estimates[-1]
    assert last.status is Status.TRACKING and last.scale_state in ("aligned", "refined") and result.metric
    assert result.frames_lost == 0 and len(result.segments) == 1 and len(result.map.points) > 50
    metrics = evaluate(result.trajectory, truth, align="se3")
    assert metrics.ate_percent < 2
    down = -last.matrix[:3, :3].T @ UP  # gravity in the camera
    assert np.allclose(down, pose_matrices(truth.poses_wc[-1])[:3, :3].T @ [0, 1, 0], atol=0.01)
    assert last.covariance.shape == (6, 6) and last.reference < last.timestamp
    assert np.linalg.eigvalsh(last.covariance).min() > 0 and last.inertial.covariance.shape == (9, 9)
    assert np.linalg.norm(last.inertial.gyro_bias) < 0.01


def test_without_samples_or_calibration_it_is_refused(film, path):
    frames = film(path(3))
    odometry = Msckf()
    odometry.track(frames[0])
    with pytest.raises(DvoError, match="no inertial samples"):
        odometry.track(frames[1])
    odometry = Msckf()
    with pytest.raises(DvoError, match="not known"):
        odometry.track(replace(frames[0], inertial=InertialSamples(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)))))
