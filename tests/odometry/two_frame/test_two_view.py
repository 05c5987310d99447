"""Two views: parallax, steps and agreement from exact flows of known motions."""

import numpy as np
import pytest
import torch

from dvo.geometry import se3, so3
from dvo.losses.two_frame import true_flow
from dvo.odometry.two_frame.two_view import parallax_of, returning_share

INTRINSICS = np.array([40.0, 42.0, 19.0, 14.0])


def views(translation, rotation=(0.02, -0.05, 0.03), seed=0):
    """Exact flow of a random scene, its depth and the motion."""
    rng = np.random.default_rng(seed)
    depth = torch.tensor(rng.uniform(1, 6, (1, 30, 40)))
    phi = torch.tensor([rotation], dtype=torch.float64)
    pose_ab = torch.cat([torch.tensor([translation], dtype=torch.float64), so3.exp(phi)], -1)
    flow, valid = true_flow(depth, pose_ab, torch.tensor(INTRINSICS)[None])
    assert valid.all()
    return flow[0].numpy(), depth[0].numpy(), pose_ab[0].numpy()


@pytest.mark.parametrize("translation", [(0.3, 0, 0), (0, 0, 0.2), (-0.05, 0.1, 0.1), (0.02, 0.0, -0.3)])
def test_a_step_is_told_in_units_of_the_depth(translation):
    flow, depth, pose_ab = views(translation)
    shorter = pose_ab * np.array([0.01, 0.01, 0.01, 1, 1, 1, 1])  # the length of the motion is not read
    parallax = parallax_of(flow, shorter, INTRINSICS)
    assert parallax.step(2.0) == pytest.approx(np.linalg.norm(translation) / np.median(depth), rel=0.15)
    assert parallax.agreement() == 1.0


def test_a_step_is_exact_before_a_wall():
    pose_ab = torch.cat(
        [torch.tensor([[0.1, -0.2, 0.3]]).double(), so3.exp(torch.tensor([[0.1, 0.0, 0.2]]).double())], -1
    )
    flow, _ = true_flow(torch.full((1, 30, 40), 2.5).double(), pose_ab, torch.tensor(INTRINSICS)[None])
    step = parallax_of(flow[0].numpy(), pose_ab[0].numpy(), INTRINSICS).step(2.0)
    assert step == pytest.approx(np.linalg.norm([0.1, 0.2, 0.3]) / 2.5, rel=1e-6)


def test_without_a_translation_there_is_no_step():
    flow, _, _ = views((0.0, 0, 0))
    guess = np.array([0.6, 0.0, 0.8, *so3.exp(torch.tensor([0.02, -0.05, 0.03]).double()).tolist()])
    assert parallax_of(flow, guess, INTRINSICS).step(2.0) == pytest.approx(0.0, abs=1e-6)
    still = np.zeros((2, 30, 40))
    assert parallax_of(still, se3.identity().double().numpy(), INTRINSICS).step(2.0) == 0.0


def test_the_opposite_direction_gives_a_step_of_the_same_length():
    flow, _, pose_ab = views((0.3, 0, 0))
    ahead, back = (parallax_of(flow, pose_ab * np.array([s, 1, 1, 1, 1, 1, 1]), INTRINSICS) for s in (1, -1))
    assert back.step(2.0) == pytest.approx(ahead.step(2.0), rel=0.01) and back.step(2.0) > 0


def test_the_longest_step_is_a_limit():
    flow, _, pose_ab = views((0.3, 0, 0))
    assert parallax_of(flow, pose_ab, INTRINSICS).step(0.01) == 0.01


def test_a_random_flow_does_not_agree():
    _, _, pose_ab = views((0.3, 0, 0))
    flow = np.random.default_rng(1).normal(0, 8, (2, 30, 40))
    assert parallax_of(flow, pose_ab, INTRINSICS).agreement() < 0.5


def test_numbers_that_are_not_finite_do_not_count():
    flow, depth, pose_ab = views((0.3, 0, 0))
    flow[:, :5] = np.nan
    assert parallax_of(flow, pose_ab, INTRINSICS).step(2.0) == pytest.approx(0.3 / np.median(depth), rel=0.15)
    nothing = parallax_of(np.full_like(flow, np.nan), pose_ab, INTRINSICS)
    assert nothing.step(2.0) == 0.0 and nothing.agreement() == 0.0


def test_the_share_that_comes_home():
    there, back = np.zeros((2, 2, 10, 20))
    there[0], back[0] = 5.0, -5.0
    assert returning_share(there, back) == pytest.approx(15 / 20)  # a quarter leaves the image
    assert returning_share(there, -back) == 0.0
    assert returning_share(np.full_like(there, np.nan), back) == 0.0
