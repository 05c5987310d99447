"""Losses of two-frame odometry: hand-computed cases, derivatives, and the flow of known motions."""

import math

import pytest
import torch

from dvo.geometry import se3
from dvo.losses.two_frame import flow_errors, rotation_loss, translation_loss, true_flow


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("form", ["distance", "cosine"])
def test_the_length_of_a_translation_does_not_count(form):
    truth = random(6, 3)
    torch.testing.assert_close(translation_loss(3.7 * truth, truth, form), torch.zeros(6).double(), atol=2e-6, rtol=0)
    a, b = random(6, 3, seed=1), random(6, 3, seed=2)
    torch.testing.assert_close(
        translation_loss(a, b, form), translation_loss(0.2 * a, 9.0 * b, form), atol=1e-5, rtol=0
    )


def test_a_right_angle_by_hand():
    a, b = torch.tensor([[2.0, 0, 0]]), torch.tensor([[0, 0, 0.5]])
    assert translation_loss(a, b, "distance").item() == pytest.approx(math.sqrt(2))
    assert translation_loss(a, b, "cosine").item() == pytest.approx(1.0)
    assert translation_loss(-b, b, "distance").item() == pytest.approx(2.0)
    assert translation_loss(-b, b, "cosine").item() == pytest.approx(2.0)


@pytest.mark.parametrize("form", ["distance", "cosine"])
def test_gradients_are_the_derivatives(form):
    estimate, truth = random(4, 3).requires_grad_(), random(4, 3, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda a, b: translation_loss(a, b, form), (estimate, truth))
    assert torch.autograd.gradcheck(rotation_loss, (estimate, truth))


@pytest.mark.parametrize("form", ["distance", "cosine"])
def test_gradients_are_finite_at_zero_and_at_the_truth(form):
    truth = torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 0]])
    estimate = torch.tensor([[0.0, 0, 0], [0, 0, 1], [0, 1, 0]], requires_grad=True)
    (translation_loss(estimate, truth, form) + rotation_loss(estimate, truth)).sum().backward()
    assert torch.isfinite(estimate.grad).all()


def test_a_camera_at_rest_has_no_direction():
    estimate = random(2, 3).requires_grad_()
    loss = translation_loss(estimate, torch.tensor([[0.0, 0, 1e-4], [0, 0, 0]]).double())
    assert (loss == 0).all()
    loss.sum().backward()
    assert (estimate.grad == 0).all()


def test_the_rotation_error_is_an_angle():
    phi = torch.tensor([[0.0, 0.3, 0.0]])
    assert rotation_loss(phi, 1.5 * phi).item() == pytest.approx(0.15)


def test_the_flow_of_known_motions():
    intrinsics, depth = torch.tensor([[50.0, 60.0, 7.0, 5.0]]), torch.full((1, 11, 15), 2.0)
    depth[0, 0, 0] = torch.nan
    sideways = se3.identity(1)
    sideways[:, 0] = 0.4
    flow, valid = true_flow(depth, sideways, intrinsics)
    assert not valid[0, 0, 0] and valid.sum() == 11 * 15 - 1 and (flow[0, :, 0, 0] == 0).all()
    torch.testing.assert_close(flow[0, :, 4, 4], torch.tensor([-50 * 0.4 / 2, 0.0]))
    ahead = se3.identity(1)
    ahead[:, 2] = 1.0
    flow, _ = true_flow(depth, ahead, intrinsics)
    torch.testing.assert_close(flow[0, :, 3, 9], torch.tensor([9.0 - 7, 3 - 5.0]))  # twice as far from the centre
    beyond = ahead.clone()
    beyond[:, 2] = 2.5
    assert not true_flow(depth, beyond, intrinsics)[1].any()


def test_exact_flows_of_all_levels_cost_nothing():
    truth, valid = torch.randn(2, 2, 11, 14), torch.ones(2, 11, 14, dtype=torch.bool)
    levels = [truth[..., ::4, ::4] / 4, truth[..., ::2, ::2] / 2, truth]
    torch.testing.assert_close(flow_errors(levels, truth, valid), torch.zeros(3), atol=1e-5, rtol=0)
    levels[1] = levels[1] + torch.tensor([1.5, 2.0])[:, None, None]  # of pixels that are twice as large
    torch.testing.assert_close(flow_errors(levels, truth, valid)[1], torch.tensor(5.0))
    assert (flow_errors(levels, truth, ~valid) == 0).all()


def test_gradients_of_the_flow_are_the_derivatives():
    truth, valid = random(1, 2, 4, 6), torch.rand(1, 4, 6, generator=torch.Generator().manual_seed(0)) < 0.7
    levels = (random(1, 2, 2, 3, seed=1).requires_grad_(), random(1, 2, 4, 6, seed=2).requires_grad_())
    assert torch.autograd.gradcheck(lambda a, b: flow_errors([a, b], truth, valid), levels)
