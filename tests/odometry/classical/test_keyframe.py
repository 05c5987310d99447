"""The keyframe system: its closed-form pieces on exact points, and the whole on small scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dvo.data.frame import Frame
from dvo.metrics import evaluate
from dvo.odometry.classical import two_view
from dvo.odometry.classical.keyframe.adjust import adjust, neighbourhood
from dvo.odometry.classical.keyframe.config import KeyframeConfig
from dvo.odometry.classical.keyframe.initialise import (
    fit_homography,
    fundamental,
    homography_share,
    start_from_two_views,
)
from dvo.odometry.classical.keyframe.map import Keyframe, Map
from dvo.odometry.classical.keyframe.pose import pixel_jacobian, refine_pose
from dvo.odometry.classical.keyframe.relocalise import describe, match, thumbnail
from dvo.odometry.classical.keyframe.system import KeyframeOdometry
from dvo.odometry.protocol import Estimate, Result, Status

INTRINSICS = np.array([300.0, 310.0, 160.0, 120.0])


def view(rotvec: tuple[float, ...], position: tuple[float, ...]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = -T[:3, :3] @ np.array(position)
    return T


def cloud(seed: int, planar: bool = False, count: int = 200) -> np.ndarray:
    points = np.random.default_rng(seed).uniform([-2, -1.5, 3], [2, 1.5, 8], (count, 3))
    if planar:
        points[:, 2] = 4 + 0.3 * points[:, 0] - 0.2 * points[:, 1]
    return points


def pair(seed: int, planar: bool, noise: float = 0.2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels in two views half a metre apart, with noise, and the pose of the second."""
    rng = np.random.default_rng([seed, 9])
    T = view(tuple(rng.uniform(-0.08, 0.08, 3)), (0.5, 0.1, 0.15))
    first, second = (
        two_view.project(cloud(seed, planar), pose, INTRINSICS)[0] + rng.normal(0, noise, (200, 2))
        for pose in (np.eye(4), T)
    )
    return first, second, T


# --- the start --------------------------------------------------------------------------------------------------------


@settings(max_examples=15)
@given(seed=st.integers(0, 1000))
def test_homography_wins_on_a_plane_and_only_there(seed):
    for planar in (True, False):
        first, second, T = pair(seed, planar)
        H = fit_homography(first, second, 1.0, 0)
        share = homography_share(H, fundamental(T, INTRINSICS), first, second, 1.0)
        assert share > 0.48 if planar else share < 0.35


def test_share_of_perfect_models_by_hand():
    """Every pair fits both: each direction gives 5.99, so the share is one half; without a homography it is 0."""
    first, second, T = pair(1, planar=True, noise=0)
    H = fit_homography(first, second, 1.0, 0)
    F = fundamental(T, INTRINSICS)
    lines = np.column_stack([first, np.ones(200)]) @ F.T
    assert np.abs((lines * np.column_stack([second, np.ones(200)])).sum(1)).max() < 1e-9
    assert homography_share(H, F, first, second, 1.0) == pytest.approx(0.5, abs=1e-4)
    assert homography_share(None, F, first, second, 1.0) == 0


@settings(max_examples=10)
@given(seed=st.integers(0, 1000), planar=st.booleans())
def test_start_finds_motion_and_points(seed, planar):
    first, second, T = pair(seed, planar)
    start = start_from_two_views(first, second, INTRINSICS, threshold=1.0, reprojection=2.0, planar=0.45, seed=seed)
    if start is None:  # of a plane there may be two explanations; then none is taken
        assert planar
        return
    assert start.planar == planar
    turn = Rotation.from_matrix(start.T_21[:3, :3] @ T[:3, :3].T).magnitude()
    direction = start.T_21[:3, 3] @ T[:3, 3] / np.linalg.norm(T[:3, 3])
    assert np.degrees(turn) < 0.5 and np.degrees(np.arccos(min(direction, 1))) < 5
    good = ~np.isnan(start.points[:, 0])
    ratio = cloud(seed, planar)[good, 2] / start.points[good, 2]
    assert good.mean() > 0.9 and np.abs(ratio / np.median(ratio) - 1).mean() < 0.05
    assert np.median(ratio) == pytest.approx(np.linalg.norm(T[:3, 3]), rel=0.1)


def test_a_turn_starts_nothing():
    rng = np.random.default_rng(0)
    T = view((0.05, 0.1, 0.0), (0, 0, 0))
    first, second = (
        two_view.project(cloud(3), pose, INTRINSICS)[0] + rng.normal(0, 0.1, (200, 2)) for pose in (np.eye(4), T)
    )
    start = start_from_two_views(first, second, INTRINSICS, threshold=1.0, reprojection=2.0, planar=0.45, seed=0)
    assert start is None or start.parallax < 2


# --- pose, map, adjustment --------------------------------------------------------------------------------------------


def test_jacobian_of_the_pose():
    local = cloud(0, count=5)
    J = pixel_jacobian(*local.T, INTRINSICS)
    for axis in range(6):
        step = 1e-6 * np.eye(6)[axis]
        ends = [local @ Rotation.from_rotvec(s * step[3:]).as_matrix().T + s * step[:3] for s in (1, -1)]
        plus, minus = (two_view.project(end, np.eye(4), INTRINSICS)[0] for end in ends)
        np.testing.assert_allclose(J[:, :, axis], (plus - minus) / 2e-6, rtol=1e-5, atol=1e-4)


@settings(max_examples=15)
@given(seed=st.integers(0, 1000))
def test_pose_from_a_prediction_with_outliers(seed):
    rng = np.random.default_rng(seed)
    T = view(tuple(rng.uniform(-0.1, 0.1, 3)), (0.3, -0.1, 0.5))
    uv = two_view.project(cloud(seed), T, INTRINSICS)[0]
    uv[:60] += rng.uniform(15, 40, (60, 2))
    guess = view(tuple(rng.uniform(-0.03, 0.03, 3)), (0.1, 0, 0.1)) @ T
    found, inliers = refine_pose(cloud(seed), uv, INTRINSICS, guess, threshold=2.0, iterations=20)
    np.testing.assert_allclose(found, T, atol=2e-3)
    assert inliers[60:].all() and not inliers[:60].any()


def world_of(points: np.ndarray, poses: list[np.ndarray], positions: bool = True) -> Map:
    world = Map()
    ids = world.add(np.zeros((len(points), 3), np.uint8))
    if positions:
        world.xyz[ids] = points
    for k, T in enumerate(poses):
        uv = two_view.project(points, T, INTRINSICS)[0].astype(np.float32)
        world.keyframes.append(Keyframe(5 * k, T.copy(), ids, uv, np.zeros((240, 320), np.uint8)))
    return world


def arc(count: int) -> list[np.ndarray]:
    return [view((0, 0.02 * k, 0), (0.25 * k, 0.02 * k**2, 0.05 * k)) for k in range(count)]


def test_triangulation_from_three_keyframes():
    points = cloud(4)
    points[:3, 2] = 400  # too far: nearly parallel rays
    world = world_of(points, arc(3), positions=False)
    world.keyframes[1].uv[10] += 30
    assert world.triangulate(world.keyframes[-1], INTRINSICS, angle=1.0, threshold=2.0) == 200 - 3 - 1
    found = world.known(np.arange(200))
    assert not found[:3].any() and not found[10] and found.sum() == 196
    np.testing.assert_allclose(world.xyz[found], points[found], atol=1e-3)


def test_adjustment_finds_poses_and_points_again():
    points, poses = cloud(5), arc(6)
    world = world_of(points, poses)
    rng = np.random.default_rng(0)
    world.xyz += rng.normal(0, 0.01, world.xyz.shape)
    for keyframe in world.keyframes[2:]:
        keyframe.T_cw = view(tuple(rng.normal(0, 0.002, 3)), tuple(rng.normal(0, 0.01, 3))) @ keyframe.T_cw
    adjust(world, world.keyframes[2:], world.keyframes[:2], INTRINSICS, 20, threshold=10.0)
    for keyframe, T in zip(world.keyframes, poses, strict=True):
        np.testing.assert_allclose(keyframe.T_cw, T, atol=1e-4)
    np.testing.assert_allclose(world.xyz, points, atol=1e-3)


def test_neighbourhood_is_the_newest_and_those_that_share():
    world = world_of(cloud(6), arc(7))
    world.keyframes[3].forget(np.arange(200) < 199)
    free, held = neighbourhood(world, world.keyframes[-1], adjusted=4, anchors=2)
    frames = [[k.frame for k in part] for part in (free, held)]
    assert frames == [[0, 5, 10, 30], [20, 25]]
    three = world_of(cloud(6), arc(3))
    free, held = neighbourhood(three, three.keyframes[-1], adjusted=4, anchors=2)
    assert len(held) == 1 and held[0].frame == 0
    five = world_of(cloud(6), arc(5))
    free, held = neighbourhood(five, five.keyframes[-1], adjusted=8, anchors=2)
    assert [k.frame for k in held] == [0, 5] and [k.frame for k in free] == [10, 15, 20]


def test_bad_observations_and_unsupported_points_go():
    world = world_of(cloud(7), arc(3))
    world.keyframes[1].uv[0] += 9  # two good views are left
    for keyframe in world.keyframes[1:]:
        keyframe.uv[1] += 9  # one is left
    world.cull_observations(world.keyframes, INTRINSICS, threshold=2.0)
    assert world.known(np.arange(3)).tolist() == [True, False, True]
    assert [len(k.ids) for k in world.keyframes] == [200, 198, 199]


def test_redundant_keyframe():
    world = world_of(cloud(8), arc(6))
    assert world.redundant(0.9, spared=2) is world.keyframes[1]
    assert world.redundant(0.9, spared=5) is None
    assert world_of(cloud(8), arc(3)).redundant(0.9, spared=1) is None  # nothing is seen four times


def test_descriptors_find_the_shifted_corner():
    image = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
    uv = np.array([[120.0, 90], [200, 150], [3, 3]])
    rows, before = describe(image, uv, 0)
    moved, after = describe(np.roll(image, (4, 7), axis=(0, 1)), uv[::-1] + [7, 4], 0)
    assert rows.tolist() == [0, 1]  # the third is too near to the border
    pairs = match(before, after)
    np.testing.assert_array_equal((uv[::-1])[moved[pairs[:, 1]]], uv[rows[pairs[:, 0]]])
    assert len(pairs) == 2 and thumbnail(np.zeros((240, 320), np.uint8)) is None


# --- the whole --------------------------------------------------------------------------------------------------------


def run(frames: list[Frame], **settings) -> tuple[list[Estimate], Result]:
    odometry = KeyframeOdometry(KeyframeConfig(corners=300, **settings))
    return [odometry.track(frame) for frame in frames], odometry.finish()


def test_tracks_a_clean_scene(film, path):
    estimates, result = run(film(path()))
    metrics = evaluate(result.trajectory, path())
    assert metrics.completeness == 1 and result.info["keyframes"] > 3
    assert metrics.ate_percent < 0.5 and metrics.rotation_error_ratio < 0.15
    assert estimates[-1].status is Status.TRACKING and estimates[-1].confidence > 0.8
    depths = result.map.points[:, 2] * metrics.scale
    near, far = np.abs(depths - 2.5) < 0.15, np.abs(depths - 5) < 0.3
    assert len(depths) > 100 and (near | far).mean() > 0.9 and near.sum() >= 5  # the near board is small


def test_relocalises_without_a_prediction(film, path):
    """An image from long before is found in the map by its descriptors; corners are not followed that far."""
    frames = film(path(40))
    none, first = np.zeros_like(frames[0].image), frames[10]
    frames += [replace(frames[-1], timestamp=(40 + k) / 20, image=none) for k in range(3)]
    estimates, result = run([*frames, replace(first, timestamp=43 / 20)], levels=1)
    assert [e.status for e in estimates[-4:]] == [Status.LOST] * 3 + [Status.TRACKING]
    assert result.info["relocalised"] == result.info["maps_started"] == 1
    poses = dict(zip(result.trajectory.timestamps.tolist(), result.trajectory.poses_wc, strict=True))
    np.testing.assert_allclose(estimates[-1].pose_wc, poses[first.timestamp], atol=0.01)
    assert np.linalg.norm(poses[first.timestamp][:3] - poses[39 / 20][:3]) > 0.1


def test_short_blackout_is_lost_and_found(film, path, dark):
    estimates, result = run(dark(film(path(40))[:28], 18, 20))
    assert [(e.status, e.pose_wc) for e in estimates[18:20]] == [(Status.LOST, None)] * 2
    assert all(e.status is Status.TRACKING for e in estimates[20:])
    assert result.info["maps_started"] == 1 and result.frames_lost == 2
    metrics = evaluate(result.trajectory, path(40))
    assert metrics.matched == 26 and metrics.ate_percent < 1


def test_starts_anew_when_it_cannot_be_found(film, path, dark):
    moving = path(40)
    estimates, result = run(dark(film(moving), 14, 26))
    assert estimates[-1].status is Status.TRACKING and np.isfinite(result.trajectory.poses_wc).all()
    assert not set(moving.timestamps[14:23]) & set(result.trajectory.timestamps)
    assert result.frames_lost == 40 - len(result.trajectory) >= 9


def test_culled_keyframes_leave_their_frames_in_place(film, path, monkeypatch):
    """One is removed with the last frame, so that nothing else follows from it."""
    inserted, last = [], None

    def redundant(world, part, spared):
        inserted.append(world.keyframes[-1].frame)
        return world.keyframes[1] if inserted[-1] == last else None

    monkeypatch.setattr(Map, "redundant", redundant)
    frames = film(path(40))[:20]
    run(frames)
    frames = frames[: inserted[-1] + 1]
    _, whole = run(frames)
    last = inserted[-1]
    _, culled = run(frames)
    assert (whole.info["culled"], culled.info["culled"]) == (0, 1) and len(culled.trajectory) > 10
    np.testing.assert_allclose(culled.trajectory.poses_wc, whole.trajectory.poses_wc, atol=1e-9)
