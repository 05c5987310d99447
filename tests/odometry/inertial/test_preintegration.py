"""Preintegration against brute force, finite differences, Monte-Carlo runs and the integrators of other projects."""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data.inertial import InertialSamples
from dvo.geometry.poses import so3_exp
from dvo.odometry.inertial.preintegration import CONTEXT, GAP, Preintegration, integrated_turn, preintegrate, propagate
from dvo.synth.sensors.imu import rotation_vector
from tests.support.inertial_motion import DOWN, NOISE, Motion

NONE = np.zeros(3)


def brute_force(samples: InertialSamples, begin: float, end: float, rate: float = 1e4) -> tuple[np.ndarray, ...]:
    """Rotation, velocity, position by small midpoint steps of the interpolated samples."""
    count = round((end - begin) * rate)
    dt = (end - begin) / count
    middle = begin + (np.arange(count) + 0.5) * dt
    gyro, accel = (
        np.stack([np.interp(middle, samples.timestamps, c) for c in x.T], 1) for x in (samples.gyro, samples.accel)
    )
    r, v, p = np.eye(3), np.zeros(3), np.zeros(3)
    half, whole = so3_exp(gyro * dt / 2), so3_exp(gyro * dt)
    for k in range(count):
        a = r @ half[k] @ accel[k]
        p, v, r = p + v * dt + a * dt**2 / 2, v + a * dt, r @ whole[k]
    return r, v, p


def random_samples(seed: int, count: int = 60, rate: float = 200.0) -> InertialSamples:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.5, 1.5, count)) / rate
    return InertialSamples(times, rng.normal(0, 1, (count, 3)), rng.normal(0, 3, (count, 3)))


def turn_error(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(rotation_vector(np.swapaxes(a, -1, -2) @ b)).max())


@settings(deadline=None, max_examples=5)
@given(st.integers(0, 2**20), st.floats(0.0, 0.004))
def test_equals_a_brute_force_integration_at_10_khz_and_the_analytic_motion(seed: int, start: float) -> None:
    motion = Motion(seed)
    fine = motion.samples(np.arange(0, 0.6, 1e-4))
    times = 0.01 + start + np.array([0.0, 0.05, 0.13, 0.5])
    rotation, velocity, position = motion.truth(times)
    at_10_khz = [brute_force(fine, a, b) for a, b in zip(times[:-1], times[1:], strict=True)]
    for k, expected in enumerate(at_10_khz):
        assert turn_error(expected[0], rotation[k]) < 1e-6 and np.allclose(expected[1], velocity[k], atol=1e-5)
    got = preintegrate(motion.samples(np.arange(0, 0.6, 1 / 200)), times, NONE, NONE, NOISE)
    assert turn_error(got.rotation, np.stack([x[0] for x in at_10_khz])) < 5e-5
    assert np.allclose(got.velocity, np.stack([x[1] for x in at_10_khz]), atol=2e-3)
    assert np.allclose(got.position, np.stack([x[2] for x in at_10_khz]), atol=3e-4)
    assert np.allclose(got.duration, np.diff(times)) and np.allclose(got.longest, 0.005)


@pytest.mark.parametrize("speed", [1.0, 3.0])
def test_the_error_falls_with_the_square_of_the_time_between_samples(speed: float) -> None:
    motion, times = Motion(3, speed), np.array([0.1013, 0.6127])
    errors = []
    for rate in (100, 200, 400):
        got = preintegrate(motion.samples(np.arange(0, 1, 1 / rate)), times, NONE, NONE, NOISE)
        truth = motion.truth(times)
        errors.append(
            [turn_error(got.rotation, truth[0])] + [float(np.abs(a - b).max()) for a, b in
             ((got.velocity, truth[1]), (got.position, truth[2]))]
        )  # fmt: skip
    falls = np.array(errors[:-1]) / np.array(errors[1:])
    assert (falls > 2.5).all()


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**20))
def test_bias_jacobians_equal_finite_differences(seed: int) -> None:
    samples = random_samples(seed)
    times = samples.timestamps[0] + np.array([0.003, 0.052, 0.21])
    rng = np.random.default_rng(seed)
    gyro, accel = rng.normal(0, 0.1, 3), rng.normal(0, 0.3, 3)
    at = preintegrate(samples, times, gyro, accel, NOISE)
    step = 1e-5
    for axis in range(3):
        delta = np.eye(3)[axis] * step
        up, down = (preintegrate(samples, times, gyro + s * delta, accel, NOISE) for s in (1, -1))
        by = rotation_vector(np.swapaxes(at.rotation, -1, -2) @ up.rotation) / step
        assert np.allclose(at.rotation_by_gyro[..., axis], by, atol=3e-5)
        assert np.allclose(at.velocity_by_gyro[..., axis], (up.velocity - down.velocity) / (2 * step), atol=1e-7)
        assert np.allclose(at.position_by_gyro[..., axis], (up.position - down.position) / (2 * step), atol=1e-7)
        up, down = (preintegrate(samples, times, gyro, accel + s * delta, NOISE) for s in (1, -1))
        assert np.allclose(at.velocity_by_accel[..., axis], (up.velocity - down.velocity) / (2 * step), atol=1e-7)
        assert np.allclose(at.position_by_accel[..., axis], (up.position - down.position) / (2 * step), atol=1e-7)
    other = preintegrate(samples, times, gyro + 1e-3, accel - 1e-2, NOISE)
    rotation, velocity, position = at.corrected(gyro + 1e-3, accel - 1e-2)
    assert turn_error(rotation, other.rotation) < 1e-6
    assert np.allclose(velocity, other.velocity, atol=1e-5) and np.allclose(position, other.position, atol=1e-5)


@pytest.mark.long
def test_the_covariance_is_that_of_monte_carlo_runs() -> None:
    """3000 runs of 100 samples: every standard deviation within 8 %, every correlation within 0.08 (deviation of a
    sampled correlation: 0.02)."""
    motion, runs, rate = Motion(1), 3000, 200.0
    stamps = np.arange(0, 0.6, 1 / rate)
    clean, rng = motion.samples(stamps), np.random.default_rng(0)
    times = np.array([0.05, 0.55])
    plain = preintegrate(clean, times, NONE, NONE, NOISE)
    # one stream in which run follows run
    count, later = len(stamps), np.arange(runs)[:, None] * 0.6
    noise = rng.normal(size=(runs, count, 6)) * np.sqrt(rate) * np.repeat([NOISE.gyro, NOISE.accel], 3)
    long = InertialSamples(
        (stamps + later).ravel(),
        (clean.gyro + noise[..., :3]).reshape(-1, 3),
        (clean.accel + noise[..., 3:]).reshape(-1, 3),
    )
    got = preintegrate(long, (times + later).ravel(), NONE, NONE, NOISE)
    turn = rotation_vector(plain.rotation[0].T @ got.rotation[::2])
    errors = np.concatenate([turn, got.velocity[::2] - plain.velocity, got.position[::2] - plain.position], 1)
    sampled, told = errors.T @ errors / runs, plain.covariance[0]
    deviation = np.sqrt(np.diag(told))
    assert np.allclose(np.sqrt(np.diag(sampled)) / deviation, 1, atol=0.08)
    assert np.allclose(sampled / np.outer(deviation, deviation), told / np.outer(deviation, deviation), atol=0.1)
    assert np.linalg.eigvalsh(told).min() > 0


def test_the_covariance_follows_forsters_recursion() -> None:
    samples = random_samples(4, 400, 1000.0)
    begin, end = samples.timestamps[[0, -1]]
    got = preintegrate(samples, np.array([begin, end]), NONE, NONE, NOISE)
    r, covariance = np.eye(3), np.zeros((9, 9))
    for k in range(len(samples) - 1):
        dt = samples.timestamps[k + 1] - samples.timestamps[k]
        gyro, accel = (x[k : k + 2].mean(0) for x in (samples.gyro, samples.accel))
        hat = np.cross(np.eye(3), accel).T
        step = so3_exp(gyro * dt)
        a, b = np.eye(9), np.zeros((9, 6))
        a[:3, :3], a[3:6, :3], a[6:, :3], a[6:, 3:6] = step.T, -r @ hat * dt, -r @ hat * dt**2 / 2, np.eye(3) * dt
        b[:3, :3], b[3:6, 3:], b[6:, 3:] = np.eye(3) * dt, r * dt, r * dt**2 / 2
        q = np.repeat([NOISE.gyro**2, NOISE.accel**2], 3) / dt
        covariance, r = a @ covariance @ a.T + (b * q) @ b.T, r @ step
    scale = np.sqrt(np.diag(covariance))
    assert np.allclose(got.covariance[0] / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.01)


@given(st.floats(-3, 3), st.integers(0, 1000))
@settings(deadline=None, max_examples=10)
def test_a_yaw_of_the_world_changes_nothing(yaw: float, seed: int) -> None:
    motion = Motion(seed)
    times = np.array([0.1, 0.13, 0.31, 0.72])
    samples = motion.samples(np.arange(0, 0.8, 1 / 400))
    state = motion.rotation(times[:1])[0], motion.position(times[:1])[0], motion.velocity(times[:1])[0]
    turn = so3_exp(np.array([0, 0, yaw]))
    here = propagate(*state, samples, times, NONE, NONE, DOWN)
    there = propagate(turn @ state[0], turn @ state[1], turn @ state[2], samples, times, NONE, NONE, DOWN)
    assert np.allclose(turn @ here[0], there[0]) and np.allclose(here[2] @ turn.T, there[2])
    assert np.allclose(here[1] @ turn.T, there[1])


def test_dead_reckoning_follows_the_motion_and_agrees_with_the_intervals() -> None:
    motion, times = Motion(5), np.linspace(0.2, 3.1, 40)
    bias = np.array([0.02, -0.01, 0.03])
    samples = motion.samples(np.arange(0, 3.2, 1 / 500))
    samples = InertialSamples(samples.timestamps, samples.gyro + bias, samples.accel - bias)
    state = motion.rotation(times[:1])[0], motion.position(times[:1])[0], motion.velocity(times[:1])[0]
    rotation, position, velocity = propagate(*state, samples, times, bias, -bias, DOWN)
    assert np.abs(position - motion.position(times)).max() < 2e-3
    assert np.abs(velocity - motion.velocity(times)).max() < 2e-3
    assert turn_error(rotation, motion.rotation(times)) < 1e-4
    parts = preintegrate(samples, times, bias, -bias, NOISE)
    r, p, v = state
    for k, t in enumerate(parts.duration):
        p = p + v * t + DOWN * t**2 / 2 + r @ parts.position[k]
        v, r = v + DOWN * t + r @ parts.velocity[k], r @ parts.rotation[k]
    assert np.allclose(r, rotation[-1]) and np.allclose(p, position[-1]) and np.allclose(v, velocity[-1])


def test_intervals_integrated_together_equal_those_integrated_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = random_samples(7, 300)
    times = np.linspace(samples.timestamps[3], samples.timestamps[-4], 12)
    biases = np.random.default_rng(0).normal(0, 0.1, (2, 11, 3))
    together = preintegrate(samples, times, *biases, NOISE)
    monkeypatch.setattr("dvo.odometry.inertial.preintegration.MOST_STEPS", 50)
    in_parts = preintegrate(samples, times, *biases, NOISE)
    for k in range(11):
        alone = preintegrate(samples, times[k : k + 2], biases[0, k], biases[1, k], NOISE)
        for name, value in vars(alone).items():
            assert np.allclose(getattr(together, name)[k], value[0], rtol=1e-9, atol=1e-12), name
            assert np.allclose(getattr(in_parts, name)[k], value[0], rtol=1e-9, atol=1e-12), name


def test_the_kernel_equals_its_twin(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = random_samples(9, 400, 50.0)
    kept = np.abs(samples.timestamps - 3) > 0.2
    samples = InertialSamples(samples.timestamps[kept], 3 * samples.gyro[kept], samples.accel[kept])
    times = np.array([-1, 0.5, 0.51, 2.0, 3.3, 7.0])
    biases = np.random.default_rng(0).normal(0, 0.1, (2, 5, 3))
    found = preintegrate(samples, times, *biases, NOISE)
    monkeypatch.setenv("DVO_KERNELS", "torch")
    twin = preintegrate(samples, times, *biases, NOISE)
    for name, value in vars(twin).items():
        assert np.allclose(getattr(found, name), value, rtol=1e-9, atol=1e-12), name


def test_a_turn_alone_is_that_of_the_whole_integration() -> None:
    samples, bias = random_samples(5), np.array([0.1, -0.2, 0.05])
    times = samples.timestamps[0] + np.array([0.01, 0.2])
    turned = integrated_turn(samples, times, bias)
    np.testing.assert_allclose(turned, preintegrate(samples, times, bias, NONE, NOISE).rotation[0], atol=1e-12)
    assert integrated_turn(samples, times - 1.0, bias) is None


def test_samples_far_away_change_nothing() -> None:
    motion, times = Motion(4), np.array([10.0, 10.1, 10.3])
    whole = motion.samples(np.arange(0, 20, 1 / 200))
    near = whole.between(times[0] - CONTEXT, times[-1] + CONTEXT)
    for a, b in zip(vars(preintegrate(whole, times, NONE, NONE, NOISE)).values(),
                    vars(preintegrate(near, times, NONE, NONE, NOISE)).values(), strict=True):  # fmt: skip
        assert np.array_equal(a, b)
    assert not preintegrate(whole, times + 30, NONE, NONE, NOISE).covered.any()


def test_a_gap_inflates_the_covariance_by_what_the_signal_does_in_such_a_time() -> None:
    motion, stamps = Motion(2), np.arange(0, 4, 1 / 200)
    whole = motion.samples(stamps)
    times = np.array([1.0, 1.5, 2.0, 2.5])
    kept = (stamps < 1.6) | (stamps > 1.9)
    gappy = InertialSamples(stamps[kept], whole.gyro[kept], whole.accel[kept])
    full, got = (preintegrate(x, times, NONE, NONE, NOISE) for x in (whole, gappy))
    assert np.allclose(got.longest, [0.005, 0.305, 0.005], atol=0.006) and np.allclose(full.longest, 0.005)
    assert np.allclose(got.covariance[[0, 2]], full.covariance[[0, 2]])
    error = np.concatenate([rotation_vector(full.rotation[1].T @ got.rotation[1]),
                            got.velocity[1] - full.velocity[1], got.position[1] - full.position[1]])  # fmt: skip
    assert error @ np.linalg.solve(got.covariance[1], error) < 25  # of 9 numbers
    assert error @ np.linalg.solve(full.covariance[1], error) > 100


@pytest.mark.parametrize("kernels", ["", "torch"])
def test_an_interval_within_a_gap_does_not_tie_position_to_velocity(
    kernels: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One step without a sample, of which a single mean force would make a covariance that has no inverse."""
    if kernels:
        monkeypatch.setenv("DVO_KERNELS", kernels)
    stamps = np.arange(0, 4, 1 / 200)
    samples = Motion(2).samples(stamps[(stamps < 1.0) | (stamps > 1.15)])
    got = preintegrate(samples, np.array([0.9, 1.02, 1.07, 1.12, 1.4]), NONE, NONE, NOISE)
    assert got.covered.all()
    scale = np.sqrt(np.diagonal(got.covariance, axis1=1, axis2=2))[:, None]
    assert np.linalg.eigvalsh(got.covariance / (scale * np.swapaxes(scale, 1, 2))).min() > 1e-3
    given = np.linalg.solve(got.covariance[1, 3:6, 3:6], got.covariance[1, 3:6, 6:])  # position by velocity
    left = got.covariance[1, 6:, 6:] - got.covariance[1, 6:, 3:6] @ given
    assert np.allclose(np.diag(left), np.diag(got.covariance[1, 6:, 6:]) / 4, rtol=0.1)


def test_intervals_without_samples_are_infinitely_uncertain() -> None:
    samples = random_samples(0, 40)
    first, last = samples.timestamps[[0, -1]]
    got = preintegrate(samples, np.array([first - 1, first - 0.5, first + 0.05, last, last + 0.5]), NONE, NONE, NOISE)
    assert got.covered.tolist() == [False, False, True, False]
    assert np.isinf(np.diagonal(got.covariance[0])).all() and (got.rotation[0] == np.eye(3)).all()
    median = float(np.median(np.diff(samples.timestamps)))
    late = np.array([last - 0.05, last, last + 0.9 * GAP * median])
    held = preintegrate(samples, late, NONE, NONE, NOISE)
    assert held.covered.all() and held.covariance[1, 0, 0] > held.covariance[0, 0, 0]
    none = preintegrate(samples.between(0, 0), late, NONE, NONE, NOISE)
    assert not none.covered.any() and len(preintegrate(samples, late[:1], NONE, NONE, NOISE)) == 0


@pytest.mark.parametrize(
    ("change", "field"),
    [("times", "times"), ("samples", "samples.timestamps"), ("nan", "samples"), ("bias", "gyro_bias, accel_bias")],
)
def test_bad_input_is_refused(change: str, field: str) -> None:
    samples, times, bias = random_samples(0), np.array([0.01, 0.1]), NONE
    if change == "times":
        times = times[::-1]
    elif change == "samples":
        samples = InertialSamples(samples.timestamps[::-1], samples.gyro, samples.accel)
    elif change == "nan":
        samples = InertialSamples(samples.timestamps, samples.gyro * np.nan, samples.accel)
    else:
        bias = NONE + np.inf
    with pytest.raises(DvoError) as error:
        preintegrate(samples, times, bias, NONE, NOISE)
    assert error.value.field == field


def other_project(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except (ImportError, AttributeError) as error:
        pytest.skip(f"{name} is not installed: {error}")


def fine_interval() -> tuple[InertialSamples, Preintegration]:
    """Half a second at 20 kHz, which the integrators that hold a sample over its step need."""
    samples = Motion(8).samples(np.arange(0, 0.5 + 1e-9, 5e-5))
    gyro, accel = np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.2, -0.1])
    return samples, preintegrate(samples, samples.timestamps[[0, -1]], gyro, accel, NOISE)


def test_gtsam_integrates_the_same() -> None:
    gtsam = other_project("gtsam")
    samples, ours = fine_interval()
    parameters = gtsam.PreintegrationParams.MakeSharedU(9.81)
    parameters.setGyroscopeCovariance(np.eye(3) * NOISE.gyro**2)
    parameters.setAccelerometerCovariance(np.eye(3) * NOISE.accel**2)
    parameters.setIntegrationCovariance(np.zeros((3, 3)))
    bias = gtsam.imuBias.ConstantBias(ours.accel_bias[0], ours.gyro_bias[0])
    theirs = gtsam.PreintegratedImuMeasurements(parameters, bias)
    for gyro, accel, dt in zip(samples.gyro, samples.accel, np.diff(samples.timestamps), strict=False):
        theirs.integrateMeasurement(accel, gyro, dt)
    assert turn_error(theirs.deltaRij().matrix(), ours.rotation[0]) < 1e-4
    assert np.allclose(theirs.deltaVij(), ours.velocity[0], atol=1e-3)
    assert np.allclose(theirs.deltaPij(), ours.position[0], atol=1e-3)
    order = [0, 1, 2, 6, 7, 8, 3, 4, 5]  # theirs is (phi, p, v)
    to_right = np.eye(9)  # theirs is of the rotation vector
    to_right[:3, :3] = gtsam.Rot3.ExpmapDerivative(rotation_vector(ours.rotation[0]))
    covariance = to_right @ theirs.preintMeasCov()[np.ix_(order, order)] @ to_right.T
    scale = np.sqrt(np.diag(covariance))
    assert np.allclose(ours.covariance[0] / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.01)


def test_pypose_integrates_the_same() -> None:
    pypose = other_project("pypose")
    import torch

    samples, ours = fine_interval()
    theirs = pypose.module.IMUPreintegrator(gravity=0.0, prop_cov=False, reset=True).double()
    with torch.no_grad():
        state = theirs(
            dt=torch.tensor(np.diff(samples.timestamps))[None, :, None],
            gyro=torch.tensor(samples.gyro[:-1] - ours.gyro_bias)[None],
            acc=torch.tensor(samples.accel[:-1] - ours.accel_bias)[None],
        )
    assert turn_error(state["rot"][0, -1].matrix().numpy(), ours.rotation[0]) < 1e-4
    assert np.allclose(state["vel"][0, -1].numpy(), ours.velocity[0], atol=1e-3)
    assert np.allclose(state["pos"][0, -1].numpy(), ours.position[0], atol=1e-3)
