"""Scale, vertical, time offset and biases of a visual trajectory with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dvo.data.inertial import InertialSamples
from dvo.geometry.poses import so3_exp
from dvo.odometry.inertial import smoother
from dvo.odometry.inertial.smoother import (
    OPPOSED,
    Similarities,
    Values,
    acceleration_sign,
    first_values,
    linear_start,
    smooth,
    upright,
)
from tests.support.visual_inertial import CAMERA_IMU, DEPTH, LEVER, OFFSET, SCALE, Recording, record


def solved(recording: Recording, end: float) -> smoother.Smoothed:
    return from_linear_start(recording.problem(0.1, end))


def from_linear_start(problem: smoother.Smoother) -> smoother.Smoothed:
    scale, gravity, problem.gyro_bias = linear_start(problem)
    worlds = Similarities(np.array([np.log(scale)]), upright(gravity)[None], np.zeros((1, 3)))
    return smooth(problem, first_values(problem, worlds))


@pytest.mark.parametrize(("grade", "seed"), [("euroc", 0), ("euroc", 1), ("phone", 2)])
def test_scale_vertical_and_offset_are_found(grade: str, seed: int) -> None:
    recording = record(seed, grade=grade)
    found = solved(recording, 12.0)
    error = float(np.exp(found.worlds.log_scale[0])) / SCALE - 1
    assert abs(error) < min(0.03, 4 * found.scale_sigma)
    up = (found.worlds.rotation[0] @ recording.turn)[2, 2]
    assert np.rad2deg(np.arccos(min(up, 1.0))) < 0.5
    assert abs(found.time_offset - OFFSET) < 1e-3


@pytest.mark.parametrize("grade", ["euroc", "phone"])
@pytest.mark.parametrize(
    ("options", "is_told"),
    [
        ({}, True),
        ({"walk": 2e-3, "unit": 2e-2}, True),
        ({"reach": 0.15, "arm": 0.3}, True),
        ({"reach": 0.0075}, False),
        ({"still": 30.0}, False),
        ({"still": 30.0, "turning": False}, False),
        ({"reach": 0.002, "arm": -0.05}, False),
        ({"reach": 0.0, "arm": -0.3}, False),
    ],
    ids=["hand", "drift", "arm", "slow", "pure rotation", "still", "wrist", "pivot"],
)
def test_sign_of_the_accelerations_is_told_or_not_sure(grade: str, options: dict[str, float], is_told: bool) -> None:
    """A wrong one never, also where the camera turns about a point that the sensor is on the other side of."""
    for seed in range(6):
        recording = record(100 + seed, grade=grade, **options)  # type: ignore[arg-type]
        for sign in (1, -1):
            problem = recording.with_samples(accel=sign * recording.samples.accel).problem(0.1, 13.9)
            found = sign * acceleration_sign(problem)
            assert found >= 0 and (found > -OPPOSED or not is_told)


def test_newest_state_is_within_its_covariance() -> None:
    squares = []
    for seed in range(4):
        recording = record(seed, seconds=8.0)
        found = solved(recording, 7.0)
        last = int(np.abs(recording.times - found.times[-1]).argmin())
        world = found.worlds.rotation[0] @ recording.turn
        error = found.velocity[-1] - world @ recording.body[2][last]
        squares.append(error @ np.linalg.solve(found.covariance[6:9, 6:9], error))
    assert 0.2 < np.mean(squares) / 3 < 5


@pytest.mark.long
@pytest.mark.parametrize("grade", ["euroc", "phone"])
def test_noise_of_the_images_is_found_beside_that_of_the_sensor(grade: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(smoother, "HASTE", 1e9)  # the noise here does not grow with the angular rate
    found = {}
    for factor in (0.5, 1.0):
        errors = []
        for seed in range(3):
            problem = record(30 + seed, grade=grade, walk=2e-3, unit=2e-2).problem(0.1, 12.0)
            problem.options = smoother.SmootherOptions(
                rotation_sigma=1e-3, position_sigma=1e-3, position_walk=0.0, rotation_factor=factor,
                position_factor=factor,
            )  # fmt: skip
            scale, gravity, problem.gyro_bias = linear_start(problem)
            worlds = Similarities(np.array([np.log(scale)]), upright(gravity)[None], np.zeros((1, 3)))
            errors.append(smooth(problem, first_values(problem, worlds)).visual_error)
        found[factor] = np.mean(errors, 0)
    rotation, position, scale = found[1.0]
    assert rotation == pytest.approx(1.0, abs=0.2) and scale == pytest.approx(1.0, abs=0.2)
    assert 0.7 < position < 1.5  # consecutive differences of positions with noise are not independent
    assert (found[0.5][:2] > 2.5 * found[1.0][:2]).all()


def test_jacobians_are_those_of_finite_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = record(3, seconds=4.0)
    problem = recording.problem(0.5, 2.0)
    worlds = Similarities(np.array([np.log(SCALE) + 0.1]), so3_exp(np.array([[0.1, -0.2, 0.3]])), np.zeros((1, 3)))
    values = first_values(problem, worlds)
    motion = problem.preintegrated(values)
    # Without the robust weights, the cost is a sum of squares, and the right side its gradient.
    problem.options = smoother.SmootherOptions(rotation_sigma=10.0, position_sigma=10.0)
    system, cost, _ = smoother._linearise(problem, values, motion)
    rng = np.random.default_rng(0)
    for _ in range(4):
        states = rng.normal(size=system.right.shape)
        shared = rng.normal(size=system.right_shared.shape)
        shared[0], shared[7], states[0, 3:6] = 0.0, 0.0, 0.0  # another offset asks for other samples; the rest is held
        step = 1e-6
        ahead, behind = (
            smoother._linearise(problem, smoother._moved(problem, values, s * states, s * shared), motion)[1]
            for s in (step, -step)
        )
        slope = -float((states * system.right).sum() + shared @ system.right_shared)
        assert (ahead - behind) / (2 * step) == pytest.approx(slope, rel=1e-3, abs=1e-4 * abs(cost))


def test_a_random_heading_of_the_world_changes_nothing() -> None:
    recording = record(4, seconds=5.0)
    problem = recording.problem(0.1, 4.0)
    scale, gravity, problem.gyro_bias = linear_start(problem)
    level = upright(gravity)
    costs = []
    for angle in (0.0, 1.3):
        rotation = so3_exp(np.array([0, 0, angle])) @ level
        start: Values = first_values(problem, Similarities(np.array([np.log(scale)]), rotation[None], np.zeros((1, 3))))
        costs.append(smooth(problem, start).cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-3)


def test_a_shift_that_goes_with_a_turn_is_told_by_the_gyroscope(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images confuse a turn with a shift sideways: the errors of both go together."""
    recording = record(5, seconds=8.0)
    camera = recording.body[0] @ CAMERA_IMU.T
    wrong = np.random.default_rng(0).normal(0, 2e-3, (len(camera), 3))
    place = recording.body[1] + recording.body[0] @ LEVER
    shifted = place + (camera @ (smoother.SHIFTED * DEPTH * np.cross([0.0, 0.0, 1.0], wrong))[..., None])[..., 0]
    seen = replace(
        recording, rotation=recording.turn @ camera @ so3_exp(wrong), position=shifted @ recording.turn.T / SCALE
    )
    found = solved(seen, 7.0)
    monkeypatch.setattr(smoother, "SHIFTED", 0.0)
    apart = solved(seen, 7.0)
    assert found.visual_error[1] < 0.1 * apart.visual_error[1]
    errors = [abs(float(np.exp(x.worlds.log_scale[0])) / SCALE - 1) for x in (found, apart)]
    assert errors[0] < errors[1]


def test_images_that_were_wrong_for_a_moment_are_no_noise_of_all_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every fifteenth pose is turned by three degrees: less than a tenth of the nodes."""
    recording, rng = record(5, seconds=8.0), np.random.default_rng(0)
    wrong = np.zeros((len(recording.times), 3))
    wrong[::15] = rng.choice([-1, 1], (len(wrong[::15]), 3)) * 0.03
    seen = replace(recording, rotation=recording.rotation @ so3_exp(wrong))
    found = solved(seen, 7.0)
    monkeypatch.setattr(smoother, "OUTLIER", np.inf)
    apart = solved(seen, 7.0)
    assert found.visual_error[0] < 5.0 < 100.0 < apart.visual_error[0]


def test_images_of_a_fast_turn_count_less(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors that grow with the square of the angular rate, and poses that are right where the camera is calm."""
    errors: dict[float, list[float]] = {smoother.HASTE: [], 1e9: []}
    for seed in range(4):
        recording, rng = record(20 + seed, seconds=8.0), np.random.default_rng(seed)
        s = recording.samples
        squares = np.interp(recording.times, s.timestamps, (s.gyro**2).sum(1))
        wrong = rng.normal(size=(len(squares), 3)) * 2e-3 * squares[:, None]
        recording = replace(recording, rotation=recording.rotation @ so3_exp(wrong))
        last = int(np.abs(recording.times - 7.0).argmin())
        for haste, found in errors.items():
            monkeypatch.setattr(smoother, "HASTE", haste)
            result = solved(recording, 7.0)
            world = result.worlds.rotation[0] @ recording.turn
            error = result.velocity[-1] - world @ recording.body[2][last]
            found.append(float(error @ np.linalg.solve(result.covariance[6:9, 6:9], error)) / 3)
    fast, even = (np.mean(found) for found in errors.values())
    assert fast < 0.7 * even


def test_the_noise_of_images_grows_with_the_square_of_the_angular_rate() -> None:
    problem = record(3, seconds=4.0).problem(0.5, 2.0)
    at_rest = replace(problem.samples, gyro=np.zeros_like(problem.samples.gyro))
    fast = replace(at_rest, gyro=at_rest.gyro + [0.0, 3 * smoother.HASTE, 0.0])
    assert np.allclose(replace(problem, samples=at_rest).haste, 1.0)
    assert np.allclose(replace(problem, samples=fast).haste, 10.0)


def test_the_unit_drifts_faster_where_the_camera_turns_and_sees_little_parallax() -> None:
    problem = record(3, seconds=4.0).problem(0.5, 2.0)
    times = problem.nodes.times
    rate, speed = 1.0, 1.0 / smoother.CARRIED * DEPTH / SCALE  # drifts twice as fast
    turning = replace(problem.samples, gyro=np.tile([0.0, rate, 0.0], (len(problem.samples), 1)))

    def drift(speed: float, *, samples: InertialSamples = turning, held: bool = False) -> np.ndarray:
        path = np.outer(times, [speed, 0.0, 0.0])
        moving = replace(problem, samples=samples, nodes=replace(problem.nodes, position=path), unit_held=held)
        return moving.unit_drift / moving.haste

    assert np.allclose(drift(speed), 2.0)
    assert np.allclose(drift(speed / 3), 10.0)
    assert np.allclose(drift(0.0), smoother.MOST_CARRIED)
    assert np.allclose(drift(0.0, held=True), 1.0)
    noise = np.random.default_rng(0).normal(0, 0.025, turning.gyro.shape)  # of a phone
    assert drift(0.0, samples=replace(turning, gyro=noise)).max() < 1.2


def test_the_noise_of_displacements_goes_by_the_depth_of_a_node_unless_samples_lead() -> None:
    problem = record(3, seconds=4.0).problem(0.5, 2.0)
    count = len(problem.nodes)
    segment = np.repeat([0, 1], [count - 3, 3])
    depth = np.where(segment == 1, 50.0, 2.0) + np.arange(count) / count
    problem.nodes = replace(problem.nodes, segment=segment, depth=depth)
    assert np.array_equal(problem.depth, depth[1:])
    problem.unit_held = True
    usual = [np.median(depth[segment == k]) for k in range(2)]
    assert np.array_equal(problem.depth, np.repeat(usual, [count - 3, 2]))


@pytest.mark.parametrize("grade", ["euroc", "phone"])
def test_a_unit_that_jumps_before_a_far_wall_is_told_by_the_samples(
    grade: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It doubles within a third of a second, where the scene is far away for the speed of the turn."""
    recording = record(7, seconds=8.0, grade=grade, walk=2e-3)
    steps = np.diff(recording.position, axis=0, prepend=recording.position[:1])
    grown = np.interp(recording.times, [6.0, 6.3], [1.0, 2.0])
    problem = replace(recording, position=np.cumsum(steps * grown[:, None], axis=0)).problem(0.5, 7.5)
    depth = problem.nodes.depth * np.where(problem.nodes.times > 5.8, 8.0, 1.0)
    problem.nodes = replace(problem.nodes, depth=depth)
    found = from_linear_start(problem)
    error = abs(found.log_scale[-1] - np.log(SCALE / 2))
    assert error < 0.05 and error < 3 * found.scale_sigma
    monkeypatch.setattr(smoother, "CARRIED", 1e9)
    assert abs(from_linear_start(problem).log_scale[-1] - np.log(SCALE / 2)) > 5 * error
