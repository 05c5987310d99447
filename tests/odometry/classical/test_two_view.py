"""The geometry of the classical baseline, on exact points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dvo.odometry.classical import two_view

INTRINSICS = np.array([300.0, 310.0, 160.0, 120.0])


def pose(rotvec: np.ndarray, centre: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = -T[:3, :3] @ centre
    return T


def cloud(seed: int = 0, count: int = 120) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-2, -1.5, 3], [2, 1.5, 9], (count, 3))


small = st.lists(st.floats(-0.15, 0.15), min_size=3, max_size=3).map(np.array)


@settings(max_examples=25)
@given(rotvec=small, seed=st.integers(0, 50))
def test_rotation_between_is_exact_for_a_turn(rotvec, seed):
    points = cloud(seed)
    T = pose(rotvec, np.zeros(3))
    first, second = (two_view.project(points, view, INTRINSICS)[0] for view in (np.eye(4), T))
    found = two_view.rotation_between(first, second, INTRINSICS)
    np.testing.assert_allclose(found, T[:3, :3], atol=1e-9)


def views(rotvec: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels in two views 0.4 apart, and the pose of the second."""
    centre = np.random.default_rng(seed).normal(size=3)
    T = pose(rotvec, 0.4 * centre / np.linalg.norm(centre))
    first, second = (two_view.project(cloud(seed), view, INTRINSICS)[0] for view in (np.eye(4), T))
    return first, second, T


def pose_errors(found: np.ndarray, T: np.ndarray) -> tuple[float, float]:
    """Degrees of rotation and of the translation's direction."""
    turn = Rotation.from_matrix(found[:3, :3] @ T[:3, :3].T).magnitude()
    sine = np.linalg.norm(np.cross(found[:3, 3], T[:3, 3])) / np.linalg.norm(T[:3, 3])
    return np.degrees(turn), np.degrees(np.arctan2(sine, found[:3, 3] @ T[:3, 3]))


@settings(max_examples=20)
@given(rotvec=small, seed=st.integers(0, 50))
def test_relative_pose_of_exact_pairs_is_exact(rotvec, seed):
    first, second, T = views(rotvec, seed)
    found = two_view.relative_pose(first, second, INTRINSICS, threshold=1.0, seed=3)
    assert found is not None and found.inliers.mean() > 0.95 and found.parallax > 3
    assert max(pose_errors(found.T_21, T)) < 1e-3


@settings(max_examples=15)
@given(rotvec=small, seed=st.integers(0, 50))
def test_relative_pose_with_outliers(rotvec, seed):
    """Some outliers lie along their epipolar line and cannot be told from inliers."""
    first, second, T = views(rotvec, seed)
    second[:20] += np.random.default_rng(seed).uniform(20, 60, (20, 2))
    found = two_view.relative_pose(first, second, INTRINSICS, threshold=1.0, seed=3)
    assert found is not None and found.inliers[20:].mean() > 0.9 and found.inliers[:20].mean() < 0.3
    turn, direction = pose_errors(found.T_21, T)
    assert turn < 0.1 and direction < 2


def test_parallax_of_a_turn_is_small():
    T = pose(np.array([0.02, 0.1, 0]), np.zeros(3))
    noise = np.random.default_rng(0).normal(0, 0.05, (120, 2))
    first, second = (two_view.project(cloud(), view, INTRINSICS)[0] for view in (np.eye(4), T))
    found = two_view.relative_pose(first, second + noise, INTRINSICS, threshold=1.0, seed=0)
    assert found is None or found.parallax < 2


def test_points_from_many_rays():
    points = cloud(count=10)
    normal = np.zeros((10, 3, 4))
    for centre in ([0, 0, 0], [0.5, 0, 0], [0.5, 0.3, 1.0]):
        normal += two_view.ray_terms(points - np.array(centre), np.array(centre, float), np.ones(10))
    np.testing.assert_allclose(two_view.solve_points(normal), points, atol=1e-9)


def test_parallel_rays_give_nan_not_a_point():
    directions = np.tile([0.1, 0.2, 1.0], (2, 1))
    normal = two_view.ray_terms(directions, np.zeros(3), np.ones(2)) * 2
    assert np.isnan(two_view.solve_points(normal)).all()


def test_step_length():
    points = cloud()
    T = pose(np.array([0.05, -0.02, 0.01]), np.array([0.3, 0.0, 0.4]))
    length = np.linalg.norm(T[:3, 3])
    unit = T.copy()
    unit[:3, 3] /= length
    seen = two_view.rays(two_view.project(points, T, INTRINSICS)[0], INTRINSICS)
    lengths = two_view.step_length(points, seen, unit)
    assert len(lengths) > 60
    np.testing.assert_allclose(lengths, length, rtol=1e-6)


def test_pose_from_points_with_outliers():
    points = cloud()
    T = pose(np.array([0.1, -0.2, 0.05]), np.array([0.5, 0.1, 0.6]))
    uv = two_view.project(points, T, INTRINSICS)[0]
    uv[:30] += 40
    found = two_view.pose_from_points(points, uv, INTRINSICS, threshold=2.0, seed=0)
    assert found is not None
    np.testing.assert_allclose(found[0], T, atol=1e-5)
    assert found[1].tolist() == [False] * 30 + [True] * 90


def test_too_few_points_give_nothing():
    assert two_view.pose_from_points(cloud()[:5], np.zeros((5, 2)), INTRINSICS, 2.0, 0) is None
    assert two_view.relative_pose(np.zeros((5, 2)), np.zeros((5, 2)), INTRINSICS, 1.0, 0) is None


def test_points_behind_the_camera_have_no_pixel():
    pixels, depth = two_view.project(np.array([[0, 0, -1.0], [0, 0, 2.0]]), np.eye(4), INTRINSICS)
    assert np.isnan(pixels[0]).all() and depth.tolist() == [-1, 2]
    assert pixels[1] == pytest.approx(INTRINSICS[2:])
