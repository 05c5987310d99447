"""Inertial measurements of a path."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.geometry.poses import quaternion_to_matrix, rotation_vector, so3_exp, split
from dvo.synth import (
    ImuNoise,
    Scene,
    long_path,
    measure_imu,
    random_scene,
)
from dvo.synth.render.shot import Rest
from dvo.synth.sensors.imu import GRAVITY
from dvo.synth.textures.texture import texture_pool


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(4, "room", pool=texture_pool(5))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["handheld", "rotation", "fast", "loop"])
def test_exact_imu_integrates_back_to_the_path(scene: Scene, kind: str) -> None:
    path = long_path(scene, 5, kind, 3.0)
    rate = 500.0
    middles = (np.arange(750) + 0.5) / rate
    imu = measure_imu(path, middles)
    ends = path.poses_wc(np.array([0.0, 1e-4, 1.5]))
    rotation, position = split(ends[0])
    velocity = (split(path.poses_wc(np.array([1e-4])))[1][0] - split(path.poses_wc(np.array([-1e-4])))[1][0]) / 2e-4
    for omega, force in zip(imu.gyro, imu.accel, strict=True):
        half = rotation @ so3_exp(omega * 0.5 / rate)
        acceleration = half @ force + GRAVITY
        position = position + velocity / rate + 0.5 * acceleration / rate**2
        velocity = velocity + acceleration / rate
        rotation = rotation @ so3_exp(omega / rate)
    target, there = split(ends[2])
    length = np.linalg.norm(np.diff(path.poses_wc(np.linspace(0, 1.5, 150))[:, :3], axis=0), axis=1).sum()
    assert np.linalg.norm(rotation_vector(target.T @ rotation)) < 1e-4
    assert np.linalg.norm(position - there) < 1e-3 * max(length, 0.3)


def test_imu_noise_and_rest(scene: Scene) -> None:
    pose = long_path(scene, 3, "handheld", 3.0).poses_wc(np.array([0.5]))[0]
    times = np.arange(20_000) / 200
    exact = measure_imu(Rest(pose), times)
    assert np.abs(exact.gyro).max() < 1e-9
    assert np.allclose(exact.accel, -quaternion_to_matrix(pose[3:]).T @ GRAVITY, atol=1e-5)
    noise = ImuNoise()
    noisy = measure_imu(Rest(pose), times, noise=noise, seed=3)
    white = noisy.gyro - exact.gyro - noisy.gyro_bias
    assert white.std() == pytest.approx(noise.gyro * np.sqrt(200), rel=0.02)
    assert np.diff(noisy.accel_bias, axis=0).std() == pytest.approx(noise.accel_walk / np.sqrt(200), rel=0.02)
    assert np.array_equal(noisy.accel, measure_imu(Rest(pose), times, noise=noise, seed=3).accel)
    assert not np.array_equal(noisy.accel, measure_imu(Rest(pose), times, noise=noise, seed=4).accel)
    with pytest.raises(DvoError, match="times"):
        measure_imu(Rest(pose), np.array([0, 0.1, 0.3]))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3), st.floats(-8, 0))
def test_rotation_vectors_survive(direction: list[float], power: float) -> None:
    phi = np.array(direction) * 10**power
    assert np.allclose(rotation_vector(so3_exp(phi)), phi, rtol=1e-6, atol=1e-15)
