"""Poses guessed from patches that are found in a whole feature map, and the order of the candidates."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.geometry import se3, so3
from dvo.map.archive import ArchivedKeyframe
from dvo.odometry.loops import guess as loop_guess
from dvo.odometry.loops.candidates import Candidate
from dvo.odometry.loops.guess import Guess, Pair, find_patches, guess_pose, order_pairs
from dvo.odometry.maintenance.background import all_steps

HEIGHT, WIDTH, CHANNELS, SIDE = 48, 64, 16, 3
CAMERA = np.array([50.0, 52.0, 31.0, 23.0], np.float32)


def feature_map(seed):
    return torch.randn(1, 1, CHANNELS, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))


def cut(maps, x, y):
    """Patches ``(M, C, p, p)`` around whole pixels."""
    r = SIDE // 2
    return torch.stack([maps[0, 0, :, v - r : v + r + 1, u - r : u + r + 1] for u, v in zip(x, y, strict=True)])


def keyframe(identifier, points, pose_cw, patches):
    """Archived keyframe that has points of the world as its patches; they need not lie in its image."""
    seen = se3.act(pose_cw, points).numpy()
    centres = CAMERA[:2] * seen[:, :2] / seen[:, 2:] + CAMERA[2:]
    depth, colors = (1 / seen[:, 2]).astype(np.float32), np.zeros((len(seen), 3), np.uint8)
    context = np.zeros((len(seen), 4), np.float16)
    return ArchivedKeyframe(
        identifier, float(identifier), CAMERA, pose_cw.numpy(), None, centres.astype(np.float32), depth, colors,
        patches.half().numpy(), context, np.zeros(1, np.uint8),
    )  # fmt: skip


def scene(seed, turn, shift, wrong=0.0, count=24):
    """Map of a later keyframe, three earlier ones that saw some of its pixels, and both poses."""
    rng = np.random.default_rng(seed)
    maps, new_cw = feature_map(seed), se3.exp(torch.tensor([*shift, *turn], dtype=torch.float64))
    frames, poses = [], []
    for k in range(3):
        x, y = rng.integers(2, WIDTH - 2, count), rng.integers(2, HEIGHT - 2, count)
        depth = torch.from_numpy(rng.uniform(2, 6, count))
        rays = np.stack([(x - CAMERA[2]) / CAMERA[0], (y - CAMERA[3]) / CAMERA[1], np.ones(count)], -1)
        points = se3.act(se3.inverse(new_cw), torch.from_numpy(rays.astype(float)) * depth[:, None])
        patches = cut(maps, x, y)
        lost = torch.from_numpy(rng.random(count) < wrong)
        patches[lost] = torch.randn(patches[lost].shape, generator=torch.Generator().manual_seed(seed + k))
        pose = se3.exp(torch.tensor([0.1 * k, 0, 0, 0, 0.05 * k, 0], dtype=torch.float64))
        frames.append(keyframe(k, points, pose, patches))
        poses.append(pose)
    return maps, frames, torch.stack(poses), new_cw


def test_patches_are_found_where_they_were_cut():
    maps = feature_map(0)
    x, y = np.array([1, 20, 62, 33]), np.array([1, 46, 30, 7])
    places, lead = find_patches(maps, cut(maps, x, y))
    assert np.array_equal(places.numpy(), np.stack([x, y], -1)) and (lead > 0.3).all()
    doubled = maps.clone()
    doubled[..., 20:23, 40:43] = maps[..., 0:3, 0:3]  # the first one is there twice now
    _, lead = find_patches(doubled, cut(maps, x, y))
    assert lead[0] == pytest.approx(0, abs=1e-6) and (lead[1:] > 0.3).all()


def test_brightness_does_not_count():
    """Features longer by a factor have the same directions."""
    maps = feature_map(0)
    x, y = np.array([10, 20]), np.array([10, 40])
    for factor in (0.1, 10.0):
        assert np.array_equal(find_patches(maps, factor * cut(maps, x, y))[0].numpy(), np.stack([x, y], -1))


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 1000),
    st.tuples(*[st.floats(-0.6, 0.6)] * 3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    st.floats(0.0, 0.6),
)
def test_the_pose_is_found_from_afar_and_among_wrong_patches(seed, turn, shift, wrong):
    maps, frames, poses, new_cw = scene(seed, turn, shift, wrong)
    if any((frame.inverse_depth < 0.05).any() for frame in frames):
        return  # points behind or beside an earlier camera are none of its patches
    guess = guess_pose(maps, CAMERA, frames, poses)
    assert guess is not None and guess.inliers >= 0.25 * 72
    error = se3.relative(new_cw, guess.pose_cw)
    assert error[:3].norm() < 0.15 and so3.angle(error[3:]) < 0.05
    again = guess_pose(maps, CAMERA, frames, poses)
    assert torch.equal(again.pose_cw, guess.pose_cw) and again.inliers == guess.inliers


def test_another_place_has_few_inliers():
    _, frames, poses, _ = scene(1, (0, 0.2, 0), (0.5, 0, 0))
    guess = guess_pose(feature_map(2), CAMERA, frames, poses)
    assert guess is None or guess.inliers < 10


def test_a_map_of_one_colour_gives_no_pose():
    """No patch is found more clearly in one place than in others."""
    _, frames, poses, _ = scene(1, (0, 0.2, 0), (0.5, 0, 0))
    assert guess_pose(torch.ones(1, 1, CHANNELS, HEIGHT, WIDTH), CAMERA, frames, poses) is None


@pytest.fixture
def pairs():
    """Candidates of three visits of a place, and one of another place."""
    _, frames, poses, new_cw = scene(3, (0, 0, 0), (0, 0, 0))
    moved = se3.relative(new_cw.expand(3, 7), torch.stack([new_cw] * 3))
    made = []
    for old, kind in ((40, "retrieval"), (10, "retrieval"), (70, "proximity"), (55, "retrieval")):
        group = tuple(replace(frame, identifier=old + k) for k, frame in enumerate(frames))
        later = tuple(replace(frame, identifier=100 + k) for k, frame in enumerate(frames))
        made.append(Pair(Candidate(old, 101, kind, poses[0]), group, later, poses, moved, new_cw, new_cw is None))
    return made


def ordered(monkeypatch, pairs, inliers, count=4):
    """Earlier keyframes in the order of their match, for numbers of inliers by keyframe."""
    guessed = torch.tensor([1.0, 2, 3, 0, 0, 0, 1], dtype=torch.float64)

    def guess(maps, intrinsics, frames, poses_cw):
        number = inliers.get(frames[0].identifier)
        return None if number is None else Guess(guessed, number)

    monkeypatch.setattr(loop_guess, "guess_pose", guess)
    found = all_steps(order_pairs(torch.zeros(1), pairs, 10, count))
    for pair in found:
        assert torch.equal(pair.candidate.pose_cw, guessed) == (inliers.get(pair.candidate.old, 0) >= 10)
    return [pair.candidate.old for pair in found]


def test_the_earliest_of_the_good_candidates_is_matched_first(monkeypatch, pairs):
    assert ordered(monkeypatch, pairs, {40: 50, 10: 40, 70: 20, 55: 24}) == [10, 40, 55, 70]
    assert ordered(monkeypatch, pairs, {40: 50, 10: 40, 70: 20, 55: 24}, count=2) == [10, 40]


def test_candidates_with_the_same_neighbours_are_matched_once(monkeypatch, pairs):
    twin = replace(pairs[1], candidate=replace(pairs[1].candidate, old=11))
    assert ordered(monkeypatch, [*pairs, twin], {40: 50, 10: 40, 70: 20, 55: 24}, count=5) == [10, 40, 55, 70]


def test_only_candidates_by_proximity_are_matched_without_a_guess(monkeypatch, pairs):
    assert ordered(monkeypatch, pairs, {40: 9, 10: 12, 55: None}) == [10, 70]
    assert ordered(monkeypatch, pairs, {}) == [70]


def test_the_groups_start_where_the_guess_has_the_later_keyframe(pairs):
    pair = pairs[0]
    pose = se3.exp(torch.tensor([0.3, 0.1, 0, 0, 0.2, 0], dtype=torch.float64))
    step = se3.exp(torch.tensor([0.0, 0, 0.1, 0, 0, 0], dtype=torch.float64))
    there = replace(pair, candidate=replace(pair.candidate, pose_cw=pose), moved=torch.stack([step, step * 0, step]))
    there.moved[1, 6] = 1
    assert torch.equal(there.start[:3], pair.old_cw) and torch.allclose(there.start[4], pose)
    assert torch.allclose(there.start[3], se3.compose(step, pose)) and there.later.identifier == 101


def test_a_pair_is_placed_in_another_unit(pairs):
    """Camera centres of the newer group and its points are scaled about the later keyframe."""
    pair = pairs[0]
    moved = pair.moved.clone()
    moved[2, 0] += 0.4
    pose = se3.exp(torch.tensor([0.3, 0.1, -0.2, 0.1, 0.2, 0.0], dtype=torch.float64))
    placed = replace(pair, moved=moved).placed(pose, 2.5)
    assert torch.equal(placed.start[: len(pair.old)], pair.old_cw)
    assert torch.allclose(placed.moved[:, :3], 2.5 * moved[:, :3]) and torch.equal(placed.moved[:, 3:], moved[:, 3:])
    for before, after in zip(pair.new, placed.new, strict=True):
        np.testing.assert_allclose(after.inverse_depth, before.inverse_depth / 2.5, rtol=1e-6)
    assert torch.equal(placed.present_cw, pose) and torch.equal(placed.candidate.pose_cw, pose) and placed.scale == 2.5
