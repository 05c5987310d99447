"""Corners followed between images, and their distance from the epipolar lines of two poses."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dvo.geometry import se3
from dvo.odometry.checks.check_pairs import (
    DISPLACEMENTS,
    GAPS,
    MAX_PAIRS,
    MIN_CORNERS,
    CheckPair,
    CheckPairs,
    epipolar_distances,
    followed,
    median_displacement,
    off_turn,
    parallax,
    relief,
    turn_parallax,
)

K = np.array([200.0, 190.0, 80.0, 60.0])


@pytest.fixture(scope="module")
def wall():
    rng = np.random.default_rng(0)
    grey = sum(
        share * cv2.resize(rng.uniform(0, 255, (n, 4 * n)), (640, 160), interpolation=cv2.INTER_CUBIC)
        for n, share in ((8, 0.4), (40, 0.6))
    )
    return cv2.cvtColor(grey.clip(0, 255).astype(np.uint8), cv2.COLOR_GRAY2RGB)


def film(wall, count, step):
    return [wall[20:140, round(k * step) % 460 :][:, :160] for k in range(count)]


def pairs_of(images, mask=None):
    return checks_of(images, mask).pairs


def checks_of(images, mask=None):
    checks = CheckPairs()
    for number, image in enumerate(images):
        checks.see(number, image, K, mask)
    return checks


def test_corners_move_as_the_picture_does(wall):
    a, b = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in film(wall, 2, 7))
    points = followed(a, b)
    assert len(points) > 3 * MIN_CORNERS
    np.testing.assert_allclose(np.median(points[:, 2:] - points[:, :2], axis=0), [-7, 0], atol=0.05)
    half = np.zeros(a.shape, bool)
    half[:, 80:] = True
    assert (followed(a, b, half)[:, 0] >= 79).all()


def test_no_corner_stands_still_with_the_rim_of_the_mask(wall):
    a, b = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in film(wall, 2, 7))
    bonnet = np.ones(a.shape, bool)
    for x in range(0, a.shape[1], 16):  # a rim with many corners
        bonnet[70 + x % 32 :, x : x + 16] = False
    faint = [np.where(bonnet, 100 + image // 8, 20).astype(np.uint8) for image in (a, b)]
    points = followed(*faint, bonnet)
    assert len(points) >= MIN_CORNERS
    far = np.abs(points[:, 2:] - points[:, :2] - [-7, 0]).max(1)
    assert (far < 1).mean() > 0.9


def test_the_gap_follows_the_motion(wall):
    """Fast motion has pairs of neighbours, slow motion those that are further apart; a still camera has none."""
    fast, slow, still = (pairs_of(film(wall, 60, step)) for step in (12, 0.6, 0))
    assert max(p.second - p.first for p in fast[3:]) <= 2 < min(p.second - p.first for p in slow)
    assert len(fast) > len(slow) > 3 and not still
    for pair in slow:
        assert np.median(np.linalg.norm(pair.points[:, 2:] - pair.points[:, :2], axis=1)) >= DISPLACEMENTS[0]
        assert pair.second - pair.first <= GAPS[1]


def test_frames_through_which_corners_hardly_move_are_kept(wall):
    checks = checks_of(film(wall, 80, 0.02))
    assert not checks.pairs and len(checks.still) == 2
    (first, middle), (start, last) = checks.still
    assert first == 0 and middle == start and GAPS[1] <= middle <= 2 * GAPS[1] and start < last < 80
    assert not checks_of(film(wall, 60, 0.6)).still


def test_what_cannot_be_followed_gives_no_pair():
    rng = np.random.default_rng(0)
    noise, grey = (
        (rng.integers(0, 255, (120, 160, 3), np.uint8) for _ in range(12)),
        np.full((120, 160, 3), 90, np.uint8),
    )
    for images in (noise, [grey] * 50):
        checks = checks_of(images)
        assert not checks.pairs and not checks.still


def test_a_long_sequence_keeps_a_bounded_number(wall, monkeypatch):
    monkeypatch.setattr("dvo.odometry.checks.check_pairs.MAX_PAIRS", 8)
    pairs = pairs_of(film(wall, 250, 3))
    assert MAX_PAIRS > 8 >= len(pairs) >= 4 and pairs[0].first < 20 and pairs[-1].second > 180
    still = checks_of(film(wall, 900, 0)).still
    assert 8 >= len(still) >= 3 and still[0][0] == 0 and still[-1][1] > 600


@given(st.lists(st.floats(-0.15, 0.15), min_size=12, max_size=12), st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_projections_of_points_lie_on_the_epipolar_lines(motions, seed):
    """With the poses that they were seen from; without translation too."""
    rng = np.random.default_rng(seed)
    poses = [se3.exp(torch.tensor(motions[k : k + 6], dtype=torch.float64)) for k in (0, 6)]
    points = torch.from_numpy(rng.uniform([-1, -1, 4], [1, 1, 8], (40, 3)))

    def seen(pose):
        x, y, z = se3.act(pose, points).numpy().T
        return np.column_stack([K[0] * x / z + K[2], K[1] * y / z + K[3]])

    for a, b in (poses, (poses[0], poses[0])):
        pair = CheckPair(0, 1, np.hstack([seen(a), seen(b)]), K)
        assert epipolar_distances(pair, a.numpy(), b.numpy()).max() < 1e-3
        aside = CheckPair(0, 1, np.hstack([seen(a), seen(b) + rng.normal(0, 1, (40, 2))]), K)
        assert epipolar_distances(aside, a.numpy(), b.numpy()).max() < 6


def test_corners_across_the_lines_of_a_motion_to_the_side():
    """The distance is that of both images together: half of the square of 9 pixels each."""
    first, second = (np.array([x, 0, 0, 0, 0, 0, 1.0]) for x in (0.0, 0.5))
    points = np.random.default_rng(0).uniform(20, 100, (30, 2))
    square = np.array([200.0, 200.0, 80.0, 60.0])
    pair = CheckPair(0, 1, np.hstack([points, points + [15, 9]]), square)
    np.testing.assert_allclose(epipolar_distances(pair, first, second), 9 / np.sqrt(2))


@example(turn=0.15, zoom=1.05, longer=4.0)  # far above the least displacement
@given(turn=st.floats(-0.15, 0.15), zoom=st.floats(0.95, 1.05), longer=st.floats(4.0, 8.0))
@settings(max_examples=20, deadline=None)
def test_a_turn_and_a_zoom_on_a_tripod_leave_no_relief(turn, zoom, longer):
    """Poses that explain it by a shift in front of a wall, as with a guessed focal length."""
    rng = np.random.default_rng(0)
    first = rng.uniform([10, 10], [150, 110], (60, 2))
    rays = np.column_stack([(first - K[2:]) / K[:2] / longer, np.ones(60)])
    rays = rays @ cv2.Rodrigues(np.array([0.0, turn / longer, 0.0]))[0].T
    second = zoom * longer * rays[:, :2] / rays[:, 2:] * K[:2] + K[2:]
    points = np.column_stack([first, second + rng.normal(0, 0.03, (60, 2))]).astype(np.float32)
    points[:12, 2:] += rng.uniform(-30, 30, (12, 2))  # what moves before it
    still, moved = np.array([0.0, 0, 0, 0, 0, 0, 1]), np.array([0.1, 0, 0, 0, 0, 0, 1])
    found = relief(CheckPair(0, 4, points, K), still, moved)
    is_seen = median_displacement(points) >= DISPLACEMENTS[0]
    assert found < 0.03 if is_seen else np.isnan(found)


def test_a_scene_has_relief():
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -0.6, 2], [1, 0.6, 6], (80, 3))
    first, second = (x[:, :2] / x[:, 2:] * K[:2] + K[2:] for x in (points, points + [0.3, 0, 0]))
    pair = CheckPair(0, 4, np.column_stack([first, second]).astype(np.float32), K)
    still, moved = np.array([0.0, 0, 0, 0, 0, 0, 1]), np.array([0.3, 0, 0, 0, 0, 0, 1])
    assert relief(pair, still, moved) > 0.1
    assert np.isnan(relief(CheckPair(0, 4, np.tile(first, 2).astype(np.float32), K), still, still))


@given(
    turn=st.tuples(st.floats(0.05, 0.3), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)), longer=st.floats(0.75, 1.35),
)  # fmt: skip
@settings(max_examples=20, deadline=None)
def test_a_turn_with_another_focal_length_is_one(turn, longer):
    """Some corners are on what moves before the camera."""
    rng = np.random.default_rng(0)
    first = rng.uniform([10, 10], [150, 110], (80, 2))
    rays = np.column_stack([(first - K[2:]) / K[:2] / longer, np.ones(80)])
    rays = rays @ cv2.Rodrigues(np.array([turn[1], turn[0], turn[2]]))[0].T
    second = longer * rays[:, :2] / rays[:, 2:] * K[:2] + K[2:]
    points = np.column_stack([first, second + rng.normal(0, 0.03, (80, 2))])
    points[:12, 2:] += rng.uniform(-30, 30, (12, 2))
    pair = CheckPair(0, 4, points, K)
    assert np.median(off_turn(pair)) < 0.1
    still, moved = np.array([0.0, 0, 0, 0, 0, 0, 1]), np.array([0.1, 0, 0, 0, 0, 0, 1])
    moved[3:] = se3.exp(0.75 * torch.tensor([0.0, 0, 0, turn[1], turn[0], turn[2]], dtype=torch.float64))[3:].numpy()
    assert 0 < turn_parallax([(pair, still, moved)]) < 1  # a part of the turn is taken for a motion to the side


def test_a_scene_is_no_turn():
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -0.6, 2], [1, 0.6, 6], (80, 3))
    first, second = (x[:, :2] / x[:, 2:] * K[:2] + K[2:] for x in (points, points + [0.3, 0, 0]))
    pair = CheckPair(0, 4, np.column_stack([first, second]).astype(np.float32), K)
    still, moved = np.array([0.0, 0, 0, 0, 0, 0, 1]), np.array([0.3, 0, 0, 0, 0, 0, 1])
    moved_by = median_displacement(pair.points)
    assert np.median(off_turn(pair)) > 0.1 * moved_by and np.isnan(turn_parallax([(pair, still, moved)]))
    assert np.median(parallax(pair, still, moved)) == pytest.approx(moved_by, rel=1e-3)
