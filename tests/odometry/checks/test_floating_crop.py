"""Corners of a camera whose principal point moves from image to image, and of one whose does not."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.kernels import VARIABLE
from dvo.odometry.checks.check_pairs import CheckPair
from dvo.odometry.checks.floating_crop import MIN_PAIRS, fitted_cost, shift_gain

K = np.array([260.0, 260, 159.5, 119.5])


def pair(seed, shift=(0.0, 0.0), noise=0.1, outliers=0.1, count=100):
    """Corners of a cloud before a camera that steps and turns, and the motion, a little wrong."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-1.2, 1.2, count), rng.uniform(-0.9, 0.9, count), np.ones(count)])
    points *= rng.uniform(2, 8, (count, 1))
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(rng.normal(0, 0.02, 3))[0]
    motion[:3, 3] = rng.normal(0, 0.15, 3)
    ends = []
    for T, offset in ((np.eye(4), (0.0, 0.0)), (motion, shift)):
        seen = points @ T[:3, :3].T + T[:3, 3]
        ends.append(seen[:, :2] / seen[:, 2:] * K[:2] + K[2:] + offset + rng.normal(0, noise, (count, 2)))
    wrong = rng.random(count) < outliers
    ends[1][wrong] += rng.uniform(-30, 30, (int(wrong.sum()), 2))
    told = motion.copy()
    told[:3, :3] = cv2.Rodrigues(rng.normal(0, 0.01, 3))[0] @ told[:3, :3]
    return CheckPair(0, 1, np.concatenate(ends, 1).astype(np.float32), K), told


def gain(shift, seeds=range(8), **options):
    pairs, motions = zip(*(pair(seed, shift, **options) for seed in seeds), strict=True)
    return shift_gain(pairs, motions)


@pytest.mark.long
def test_a_principal_point_that_stays_needs_no_shift():
    assert gain((0.0, 0.0)) < 0.1


@pytest.mark.parametrize("shift", [(8.0, 0.0), (0.0, -8.0), (5.0, 6.0)])
def test_a_shift_explains_what_a_motion_does_not(shift):
    assert gain(shift) > 0.3 > 3 * gain((0.0, 0.0))


def test_the_cost_is_that_of_the_true_motion_wherever_the_fit_begins():
    found, motion = pair(3, outliers=0.0)
    turned = motion.copy()
    turned[:3, :3] = cv2.Rodrigues(np.array([0.02, -0.03, 0.02]))[0] @ turned[:3, :3]
    near, far = (fitted_cost(found, start, False) for start in (motion, turned))
    assert near == pytest.approx(far, rel=1e-3) and near < 100 * 0.1**2


def test_a_translation_that_is_wrong_is_as_good_a_start():
    pairs, motions = zip(*(pair(seed, (5.0, 6.0)) for seed in range(8)), strict=True)
    across = [motion.copy() for motion in motions]
    for motion in across:
        motion[:3, 3] = np.linalg.svd(motion[None, :3, 3])[2][1]
    assert shift_gain(pairs, across) == pytest.approx(shift_gain(pairs, motions), abs=0.05)


def test_a_shift_below_the_noise_of_corners_is_none():
    assert gain((0.15, 0.0), noise=0.01, outliers=0.0) < 0.1


def test_too_few_pairs_or_corners_say_nothing():
    assert np.isnan(gain((8.0, 0.0), seeds=range(MIN_PAIRS - 1)))
    assert np.isnan(gain((8.0, 0.0), count=20))


@pytest.mark.parametrize("with_shift", [False, True])
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), turned=st.booleans(), still=st.booleans())
def test_a_kernel_fits_as_its_twin(with_shift, seed, turned, still):
    found, motion = pair(seed, (3.0, -2.0))
    motion = motion if turned else np.eye(4)
    motion[:3, 3] *= not still
    costs = []
    for choice in ("numba", "torch"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(VARIABLE, choice)
            costs.append(fitted_cost(found, motion, with_shift))
    assert costs[0] == pytest.approx(costs[1], rel=1e-3)
