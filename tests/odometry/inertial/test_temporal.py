"""Time offset, rotation and bias of a gyroscope against the orientations of a camera."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data.inertial import NOISE_PRESETS
from dvo.geometry.poses import rotation_vector, so3_exp
from dvo.odometry.inertial.temporal import align_imu, hand_eye, integrate_gyro, nearest_rotation
from tests.support.hand_motion import CAMERA_IMU, frames, hand_motion, samples

SECONDS = 12.0


def angle(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(rotation_vector(one.T @ other))))


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("is_stated", [False, True])
def test_offset_rotation_and_bias_with_their_deviations(seed: int, is_stated: bool) -> None:
    path, offset = hand_motion(seed), (0.0, -0.237, 0.08)[seed - 1]
    times, rotations = frames(path, SECONDS, seed=seed)
    imu = samples(path, SECONDS, noise=NOISE_PRESETS["euroc"], seed=seed)
    bias = np.array([0.2, -0.1, 0.05])
    stated = CAMERA_IMU @ so3_exp(np.radians([1.0, -2.0, 1.0])) if is_stated else None
    found = align_imu(times, rotations, imu.timestamps + offset, imu.gyro + bias, stated)
    assert found.reason == ""
    assert abs(found.time_offset - offset) < min(1e-3, 4 * found.sigma_offset)
    assert angle(found.rotation_camera_imu, CAMERA_IMU) < 0.3
    assert found.sigma_rotation.max() < 0.3 and found.sigma_offset < 1e-3
    assert np.abs(found.gyro_bias - bias).max() < 0.01
    assert found.is_offset_told and found.is_rotation_told and not found.mirrored


def test_deviations_are_those_of_many_runs() -> None:
    path = hand_motion(4)
    imu = samples(path, 8.0)
    errors, sigmas = [], []
    for seed in range(12):
        times, rotations = frames(path, 8.0, noise=0.1, seed=seed)
        noise = np.random.default_rng(seed).normal(0, 0.01, imu.gyro.shape)
        found = align_imu(times, rotations, imu.timestamps, imu.gyro + noise, CAMERA_IMU, max_offset=0.05)
        turn = np.degrees(rotation_vector(found.rotation_camera_imu @ CAMERA_IMU.T))
        errors.append([found.time_offset, *turn])
        sigmas.append([found.sigma_offset, *found.sigma_rotation])
    ratio = np.sqrt(np.mean(np.square(np.array(errors) / np.array(sigmas)), 0))
    assert (ratio > 0.4).all() and (ratio < 2.0).all()


def test_exact_measurements_give_the_exact_answer() -> None:
    path = hand_motion(5)
    times, rotations = frames(path, 6.0, noise=0.0)
    imu = samples(path, 6.0, rate=400.0)
    found = align_imu(times, rotations, imu.timestamps + 0.1, imu.gyro + 0.3)
    assert found.time_offset == pytest.approx(0.1, abs=2e-5)
    assert angle(found.rotation_camera_imu, CAMERA_IMU) < 0.01
    assert found.gyro_bias == pytest.approx(0.3, abs=1e-3)


def test_keyframes_far_apart_and_missing_samples() -> None:
    path = hand_motion(6)
    times, rotations = frames(path, 40.0, rate=1.3)
    imu = samples(path, 40.0)
    there = np.random.default_rng(0).random(len(imu)) > 0.1
    there &= (imu.timestamps < 20) | (imu.timestamps > 20.6)
    found = align_imu(times, rotations, imu.timestamps[there] - 0.05, imu.gyro[there])
    assert found.reason == ""
    assert found.time_offset == pytest.approx(-0.05, abs=2e-3)
    assert angle(found.rotation_camera_imu, CAMERA_IMU) < 0.3


def test_outliers_of_vision_do_no_harm() -> None:
    path = hand_motion(7)
    times, rotations = frames(path, SECONDS)
    rotations[60:75] = rotations[60:75] @ so3_exp(np.array([0.3, 0.2, -0.4]))
    imu = samples(path, SECONDS)
    found = align_imu(times, rotations, imu.timestamps, imu.gyro)
    assert abs(found.time_offset) < 1e-3 and angle(found.rotation_camera_imu, CAMERA_IMU) < 0.3


def test_rotation_about_one_axis_tells_the_offset_and_not_the_rotation() -> None:
    path = hand_motion(8, (0.0, 0.3, 0.0))
    times, rotations = frames(path, SECONDS)
    imu = samples(path, SECONDS)
    unknown = align_imu(times, rotations, imu.timestamps + 0.02, imu.gyro)
    assert "one axis" in unknown.reason and not unknown.is_rotation_told
    stated = align_imu(times, rotations, imu.timestamps + 0.02, imu.gyro, CAMERA_IMU)
    assert "one axis" in stated.reason and np.array_equal(stated.rotation_camera_imu, CAMERA_IMU)
    assert stated.is_offset_told and stated.time_offset == pytest.approx(0.02, abs=1e-3)


def test_what_does_not_tell_is_refused() -> None:
    path = hand_motion(9)
    times, rotations = frames(path, SECONDS)
    imu = samples(path, SECONDS)
    still = frames(hand_motion(9, (0.0, 0.0, 0.0)), SECONDS)[1]
    other = samples(hand_motion(10), SECONDS)
    cases = {
        "too little rotation": (still, imu.timestamps, imu.gyro),
        "do not agree": (rotations, other.timestamps, other.gyro),
        "do not cover": (rotations, imu.timestamps + 60, imu.gyro),
        "mirrored": (rotations, imu.timestamps, imu.gyro[:, [1, 0, 2]]),
        "too few": (rotations[:5], imu.timestamps, imu.gyro),
    }
    for words, (turns, stamps, gyro) in cases.items():
        found = align_imu(times[: len(turns)], turns, stamps, gyro, CAMERA_IMU)
        assert words in found.reason
        assert not found.is_offset_told and not found.is_rotation_told
        assert np.array_equal(found.rotation_camera_imu, CAMERA_IMU)
    far = align_imu(times, rotations, imu.timestamps + 0.3, imu.gyro, max_offset=0.2)
    assert far.reason and not far.is_offset_told


def test_a_wave_has_many_offsets() -> None:
    times = np.arange(300) / 30
    stamps = np.arange(2200) / 200 - 0.5
    turn = 0.3 * np.sin(2 * np.pi * 3 * times)
    rotations = so3_exp(np.stack([turn, 0 * turn, 0 * turn], -1))
    rate = 0.3 * 2 * np.pi * 3 * np.cos(2 * np.pi * 3 * stamps)
    found = align_imu(times, rotations, stamps, np.stack([rate, 0 * rate, 0 * rate], -1))
    assert "periodic" in found.reason and not found.is_offset_told


def test_bad_arguments_are_refused() -> None:
    times, rotations = frames(hand_motion(1), 2.0)
    imu = samples(hand_motion(1), 2.0)
    with pytest.raises(DvoError, match="do not match"):
        align_imu(times[1:], rotations, imu.timestamps, imu.gyro)
    with pytest.raises(DvoError, match="do not increase"):
        align_imu(times, rotations, imu.timestamps[::-1], imu.gyro)
    with pytest.raises(DvoError, match="no rotation to keep"):
        align_imu(times, rotations, imu.timestamps, imu.gyro, fixed=True)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.booleans())
def test_hand_eye_finds_rotations_and_reflections(seed: int, is_mirrored: bool) -> None:
    rng = np.random.default_rng(seed)
    rotation = so3_exp(rng.normal(0, 1.5, 3))
    vectors = rng.normal(0, 1, (20, 3))
    matrix = rotation @ np.diag([1, -1 if is_mirrored else 1, 1])
    found, _, mirrored = hand_eye(vectors @ matrix.T, vectors)
    assert np.allclose(found, matrix) and mirrored == is_mirrored
    assert np.linalg.det(nearest_rotation(vectors @ matrix.T, vectors)) > 0


def test_integration_is_that_of_single_steps() -> None:
    rng = np.random.default_rng(0)
    times, gyro, bias = np.cumsum(rng.uniform(0.004, 0.006, 50)), rng.normal(0, 1, (50, 3)), np.array([0.1, 0.2, -0.3])
    path, rotation = integrate_gyro(times, gyro, bias), np.eye(3)
    for k in range(49):
        rotation = rotation @ so3_exp((0.5 * (gyro[k] + gyro[k + 1]) - bias) * (times[k + 1] - times[k]))
    assert np.allclose(path.rotations[-1], rotation)
    assert np.allclose(path.at(times[-1:])[0][0], rotation)
    step = 1e-6
    moved = integrate_gyro(times, gyro, bias + np.array([step, 0, 0])).rotations[-1]
    change = rotation_vector(rotation.T @ moved) / step
    assert np.allclose(change, -(rotation.T @ path.sums[-1])[:, 0], atol=1e-3)
