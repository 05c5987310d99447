"""The direct system: alignment, stereo and depth filter on exact data, and the whole on small scenes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dvo.data.frame import Frame
from dvo.metrics import evaluate
from dvo.odometry.classical.direct.align import Reference, align, residuals
from dvo.odometry.classical.direct.depth import DepthConfig, DepthMap, fuse
from dvo.odometry.classical.direct.image import inside, pyramid, sample
from dvo.odometry.classical.direct.start import TwoViewStart, spread
from dvo.odometry.classical.direct.stereo import Matches, StereoConfig, search_lines
from dvo.odometry.classical.direct.system import DirectConfig, DirectOdometry
from dvo.odometry.protocol import Estimate, Result, Status

INTRINSICS = np.array([250.0, 250.0, 159.5, 119.5])


def texture(seed: int = 0) -> np.ndarray:
    """Smooth random image ``(240, 320)`` float32 from about 0 to 255, with structure of all sizes."""
    rng = np.random.default_rng(seed)
    image = np.zeros((240, 320), np.float32)
    for width in (2.0, 6.0, 18.0):
        smooth = cv2.GaussianBlur(rng.normal(size=image.shape).astype(np.float32), (0, 0), width)
        image += 25 * smooth / smooth.std()
    return 128 + image


def plane_seen_from(image: np.ndarray, T: np.ndarray, depth: float) -> np.ndarray:
    """Image that a second camera at ``T_21`` has of a plane at ``depth`` that looks like ``image`` from the first."""
    K = np.array([[250.0, 0, 159.5], [0, 250, 119.5], [0, 0, 1]])
    H = K @ (T[:3, :3] + np.outer(T[:3, 3], [0, 0, 1]) / depth) @ np.linalg.inv(K)
    return cv2.warpPerspective(image, H, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def motion(rotvec: tuple[float, ...], shift: tuple[float, ...]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), shift
    return T


# --- images -----------------------------------------------------------------------------------------------------------


@settings(max_examples=20)
@given(u=st.floats(0, 30), v=st.floats(0, 20))
def test_sampling_a_plane_of_intensity_is_exact(u, v):
    rows, columns = np.indices((22, 32), np.float32)
    values = np.dstack([3 * columns - 2 * rows, rows]).astype(np.float32)
    got = sample(values, np.array([u]), np.array([v]))[0]
    np.testing.assert_allclose(got, [3 * u - 2 * v, v], atol=1e-4)


def test_pyramid_keeps_rays_and_gradients():
    rows, columns = np.indices((240, 320), np.float32)
    levels = pyramid(0.5 * columns + 0.25 * rows, INTRINSICS, 4)
    assert [level.grey.shape for level in levels] == [(240, 320), (120, 160), (60, 80), (30, 40)]
    for k, level in enumerate(levels):
        np.testing.assert_allclose(level.packed[5, 5, 1:], [0.5 * 2**k, 0.25 * 2**k], rtol=1e-5)
        fx, _, cx, _ = level.intrinsics
        assert (-0.5 - cx) / fx == pytest.approx((-0.5 - 159.5) / 250)  # the image's edge
    assert not inside(np.array([np.nan]), np.array([1.0]), (5, 5)).any()


# --- alignment --------------------------------------------------------------------------------------------------------


def some_reference(seed: int, count: int = 50) -> Reference:
    rng = np.random.default_rng(seed)
    rays = np.column_stack([rng.uniform(-0.4, 0.4, (count, 2)), np.ones(count)]).astype(np.float32)
    d = rng.uniform(0.2, 1.0, count).astype(np.float32)
    return Reference(rays, d, np.full(count, 0.01, np.float32), rng.uniform(20, 200, count).astype(np.float32))


@settings(max_examples=15)
@given(seed=st.integers(0, 1000))
def test_jacobian_against_differences(seed):
    """On an image whose intensity is a plane, so that interpolation and gradient are exact."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices((240, 320), np.float32)
    level = pyramid(float(rng.uniform(0.2, 0.5)) * columns + float(rng.uniform(-0.5, -0.1)) * rows, INTRINSICS, 1)[0]
    reference = some_reference(seed)
    T = motion(tuple(rng.uniform(-0.05, 0.05, 3)), tuple(rng.uniform(-0.1, 0.1, 3)))
    _, J, variance, seen = residuals(reference, level, T, 1.1, 3.0, 5.0)
    assert seen.sum() > 30

    def at(step: np.ndarray, d: float = 0.0) -> np.ndarray:
        moved = motion(tuple(step[3:6]), tuple(step[:3])) @ T
        shifted = replace(reference, inverse_depth=reference.inverse_depth + np.float32(d))
        return residuals(shifted, level, moved, 1.1 + step[6], 3.0 + step[7], 5.0)[0]

    for axis in range(8):
        step = 2e-3 * np.eye(8)[axis]
        numeric = (at(step) - at(-step)) / 4e-3
        np.testing.assert_allclose(J[seen, axis], numeric[seen], rtol=0.01, atol=0.3)
    by_depth = (at(np.zeros(8), 2e-3) - at(np.zeros(8), -2e-3)) / 4e-3
    np.testing.assert_allclose(variance[seen], 2 * 25 + by_depth[seen] ** 2 * 0.01, rtol=0.02, atol=0.05)


@settings(max_examples=6)
@given(seed=st.integers(0, 100))
def test_alignment_finds_motion_and_brightness(seed):
    rng = np.random.default_rng(seed)
    T = motion(tuple(rng.uniform(-0.02, 0.02, 3)), tuple(rng.uniform(-0.08, 0.08, 3)))
    image = texture(seed)
    key, other = (pyramid(i, INTRINSICS, 4) for i in (image, 0.8 * plane_seen_from(image, T, 2.0) + 10))
    depth = DepthMap(key[0], DepthConfig(strength=3))
    depth.begin(np.full((240, 320), 0.5, np.float32), np.full((240, 320), 1e-5, np.float32))
    found = align(depth.references(key), other, np.eye(4), noise=4, huber=1.345, iterations=(10, 15, 20, 20))
    # On a plane straight ahead a small shift and a small turn look alike.
    np.testing.assert_allclose(found.T[:3, :3], T[:3, :3], atol=2e-3)
    np.testing.assert_allclose(found.T[:3, 3], T[:3, 3], atol=5e-3)
    assert found.gain == pytest.approx(0.8, abs=0.02) and found.offset == pytest.approx(10, abs=3)
    assert found.agreement > 0.9 and found.overlap > 0.7


# --- stereo and depth -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [(0.1, 0, 0), (0.02, -0.1, 0.02), (0.05, 0.05, -0.2)])
def test_stereo_measures_a_plane(shift):
    T = motion((0.01, -0.005, 0.02), shift)
    image = texture(3)
    key, other = (pyramid(i, INTRINSICS, 1)[0] for i in (image, 1.1 * plane_seen_from(image, T, 2.0) - 5))
    v, u = np.nonzero(DepthMap(key, DepthConfig(pixels=3000)).candidates)
    uv = np.column_stack([u, v]).astype(np.float32)
    rng = np.random.default_rng(0)
    prior = np.abs(0.5 + rng.normal(0, 0.08, len(uv))).astype(np.float32)
    found = search_lines(key, other, T, uv, prior, np.full(len(uv), 0.01, np.float32), 1.1, -5.0, StereoConfig())
    assert found.found.mean() > 0.3 and found.failed.mean() < 0.05
    error = found.inverse_depth[found.found] - 0.5
    assert np.median(np.abs(error)) < 0.01
    normalised = np.abs(error) / np.sqrt(found.variance[found.found])
    assert (normalised < 3).mean() > 0.95


def test_stereo_without_baseline_measures_nothing():
    key = pyramid(texture(3), INTRINSICS, 1)[0]
    uv = np.array([[100.0, 100], [150, 120]], np.float32)
    prior = np.full(2, 0.5, np.float32), np.full(2, 0.01, np.float32)
    assert not search_lines(key, key, motion((0.01, 0, 0), (0, 0, 0)), uv, *prior, 1, 0, StereoConfig()).found.any()


def test_fusion_by_hand():
    mean, variance = fuse(np.array([1.0]), np.array([3.0]), np.array([2.0]), np.array([1.0]))
    assert mean[0] == pytest.approx(1.75) and variance[0] == pytest.approx(0.75)


def flat_map(value: float = 0.5, variance: float = 0.01, **settings: float) -> DepthMap:
    depth = DepthMap(pyramid(texture(5), INTRINSICS, 1)[0], DepthConfig(growth=1.0, **settings))  # type: ignore[arg-type]
    depth.begin(np.full((240, 320), value, np.float32), np.full((240, 320), variance, np.float32))
    return depth


def test_filter_fuses_counts_failures_and_begins_anew():
    depth = flat_map(failures=2)
    at = tuple(rows[:4] for rows in depth.pixels()[1])
    d, var = np.array([0.6, 2.0, 0.5, 0.5], np.float32), np.full(4, 0.01, np.float32)
    found, failed = np.array([True, True, False, False]), np.array([False, False, True, False])
    depth.update(at, Matches(d, var, found, failed))
    np.testing.assert_allclose(depth.mean[at], [0.55, 0.5, 0.5, 0.5], rtol=1e-5)
    np.testing.assert_allclose(depth.variance[at], [0.005, 0.01, 0.01, 0.01], rtol=1e-5)
    assert depth.failures[at].tolist() == [-1, 1, 1, 0]
    depth.update(at, Matches(d, var, found, failed))
    assert depth.valid[at].tolist() == [True, False, False, True]


def test_smoothing_averages_what_agrees():
    depth = flat_map()
    crowd = cv2.boxFilter(depth.candidates.astype(np.float32), -1, (5, 5), normalize=False) * depth.candidates
    v, u = np.unravel_index(int(crowd.argmax()), crowd.shape)
    depth.mean[v, u] = 0.52
    odd = depth.candidates & (np.hypot(*(np.indices((240, 320)) - [[[v]], [[u]]])) == 1)
    depth.mean[odd] = 3.0  # direct neighbours on another surface
    mean, variance, count = depth.smoothed()
    assert 0.5 < mean[v, u] < 0.52 and variance[v, u] == pytest.approx(0.01, rel=1e-4)
    square = depth.candidates[v - 2 : v + 3, u - 2 : u + 3]
    assert count[v, u] == square.sum() - 1 - odd.sum()


@settings(max_examples=8)
@given(forward=st.floats(-0.5, 0.5), depth_of_plane=st.floats(1.5, 4))
def test_carrying_to_the_next_keyframe(forward, depth_of_plane):
    old = flat_map(1 / depth_of_plane, 1e-4)
    T = motion((0, 0, 0), (0, 0, -forward))
    key = pyramid(plane_seen_from(old.key.grey, T, depth_of_plane), INTRINSICS, 1)[0]
    new = old.carried(T, key, 1.0, 0.0)
    z = depth_of_plane - forward
    assert new.measured.sum() > 0.3 * old.measured.sum()
    tight = new.variance < 1.2 * (1e-4 * (depth_of_plane / z) ** 4 + (0.01 / z) ** 2)
    assert tight.sum() > 500
    np.testing.assert_allclose(new.mean[tight], 1 / z, rtol=1e-3)


def test_start_from_two_views(film, path):
    frames = film(path(40))
    grey = [cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY) for frame in frames]
    start = TwoViewStart(grey[0], 0)
    for image in grey[1:12]:
        assert start.follow(image, INTRINSICS) is not None
    assert not start.worn and start.solve(INTRINSICS, 1000.0, 0) is None
    solved = start.solve(INTRINSICS, 5.0, 0)
    assert solved is not None
    _, uv, inverse_depth = solved
    assert np.median(inverse_depth) == pytest.approx(1, abs=0.02)
    near = np.quantile(inverse_depth, 0.99) / np.median(inverse_depth)
    assert near == pytest.approx(2, rel=0.1)  # wall at 5 m, board at 2.5 m
    mean, variance = spread(uv, inverse_depth, (240, 320))
    u, v = np.rint(uv[0]).astype(int)
    assert mean.shape == (240, 320) and abs(mean[v, u] - inverse_depth[0]) < 3 * np.sqrt(variance[v, u])


# --- the whole --------------------------------------------------------------------------------------------------------


def run(frames: list[Frame], seed: int = 0) -> tuple[list[Estimate], Result]:
    odometry = DirectOdometry(DirectConfig(pixels=19200), seed)
    return [odometry.track(frame) for frame in frames], odometry.finish()


@pytest.mark.long
def test_tracks_a_clean_scene(film, path):
    estimates, result = run(film(path()))
    metrics = evaluate(result.trajectory, path())
    assert metrics.completeness == 1 and result.info["keyframes"] > 2
    assert metrics.ate_percent < 2 and metrics.rotation_error_ratio < 0.1
    assert estimates[-1].status is Status.TRACKING and estimates[-1].confidence > 0.7
    depths = result.map.points[:, 2] * metrics.scale
    near, far = np.abs(depths - 2.5) < 0.3, np.abs(depths - 5) < 0.6
    assert len(depths) > 200 and (near | far).mean() > 0.8 and near.sum() > 10


@pytest.mark.long
def test_short_blackout_is_lost_and_found(film, path, dark):
    estimates, result = run(dark(film(path(40))[:28], 18, 20))
    assert [(e.status, e.pose_wc) for e in estimates[18:20]] == [(Status.LOST, None)] * 2
    assert all(e.status is Status.TRACKING for e in estimates[20:])
    assert result.info["maps_started"] == 1 and result.frames_lost == 2
    assert evaluate(result.trajectory, path(40)).ate_percent < 3


@pytest.mark.long
def test_long_blackout_starts_anew(film, path, dark):
    moving = path(40)
    estimates, result = run(dark(film(moving), 14, 25))
    assert result.info["maps_started"] == 2 and estimates[-1].status is Status.TRACKING
    assert not set(moving.timestamps[14:23]) & set(result.trajectory.timestamps)
    assert result.frames_lost == 40 - len(result.trajectory) >= 9
