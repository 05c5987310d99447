"""Losses against hand-computed cases."""

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.geometry import se3
from dvo.losses.flow import flow_error, flow_loss
from dvo.losses.pose import alignment_scale, pose_errors


def test_flow_error_is_the_smallest_of_the_valid_pixels():
    truth = torch.zeros(1, 2, 3, 3, 2)
    estimate = truth + torch.tensor([3.0, 4.0])
    estimate[0, 0, 1, 2] = torch.tensor([0.0, 0.5])
    estimate[0, 0, 0, 0] = 0.0
    valid = torch.ones(1, 2, 3, 3, dtype=torch.bool)
    valid[0, 0, 0, 0] = False  # the perfect pixel does not count
    error = flow_error(estimate, truth, valid)
    torch.testing.assert_close(error, torch.tensor([[0.5, 5.0]]))
    edges = torch.tensor([True, True])
    torch.testing.assert_close(flow_loss(error, edges), torch.tensor(2.75))
    torch.testing.assert_close(flow_loss(error, torch.tensor([True, False])), torch.tensor(0.5))


def test_flow_loss_leaves_out_edges_without_a_valid_pixel_and_stays_finite():
    estimate = torch.ones(1, 2, 3, 3, 2, requires_grad=True)
    valid = torch.zeros(1, 2, 3, 3, dtype=torch.bool)
    loss = flow_loss(flow_error(estimate, torch.zeros(1, 2, 3, 3, 2), valid), torch.tensor([True, True]))
    loss.backward()
    assert loss == 0
    assert torch.equal(estimate.grad, torch.zeros_like(estimate))


def test_flow_gradient_is_finite_at_zero_error():
    estimate = torch.zeros(1, 1, 3, 3, 2, requires_grad=True)
    valid = torch.ones(1, 1, 3, 3, dtype=torch.bool)
    flow_loss(flow_error(estimate, torch.zeros(1, 1, 3, 3, 2), valid), torch.tensor([True])).backward()
    assert torch.isfinite(estimate.grad).all()


def line(step: float) -> torch.Tensor:
    """World-to-camera poses of a camera that goes along x."""
    poses = se3.identity(1, 3, dtype=torch.float64)
    poses[0, :, 0] = -step * torch.arange(3, dtype=torch.float64)
    return poses


def test_scale_is_aligned_and_rotation_is_not():
    errors = pose_errors(line(0.5), line(1.0))
    assert errors.translation.item() < 1e-7
    assert errors.rotation.item() < 1e-7
    turned = line(1.0)
    half = math.radians(10) / 2
    turned[0, 2, 3:] = torch.tensor([0, 0, math.sin(half), math.cos(half)], dtype=torch.float64)
    # Of the six ordered pairs, the four with frame 2 are off by 10 degrees.
    got = pose_errors(turned, line(1.0)).rotation.item()
    assert abs(got - math.radians(10) * 4 / 6) < 1e-6


def test_translation_error_of_one_wrong_camera():
    estimate = line(1.0)
    estimate[0, :, 1] = torch.tensor([0.0, 0.3, 0.0])
    scale = alignment_scale(-estimate[..., :3], -line(1.0)[..., :3]).item()
    expected = []
    true = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
    off = [(0.0, 0.0), (1.0, -0.3), (2.0, 0.0)]
    for i in range(3):
        for j in range(3):
            if i != j:
                dx = scale * (off[j][0] - off[i][0]) - (true[j][0] - true[i][0])
                dy = scale * (off[j][1] - off[i][1]) - (true[j][1] - true[i][1])
                expected.append(math.hypot(dx, dy))
    got = pose_errors(estimate, line(1.0)).translation.item()
    assert abs(got - sum(expected) / 6) < 1e-6


@given(st.floats(0.2, 5.0), st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_pose_loss_does_not_see_scale(scale, seed):
    g = torch.Generator().manual_seed(seed)
    truth = se3.exp(0.3 * torch.randn(1, 4, 6, generator=g, dtype=torch.float64))
    noisy = se3.retract(truth, 0.05 * torch.randn(1, 4, 6, generator=g, dtype=torch.float64))
    scaled = noisy.clone()
    scaled[..., :3] *= scale
    a, b = pose_errors(noisy, truth), pose_errors(scaled, truth)
    torch.testing.assert_close(a.translation, b.translation)
    torch.testing.assert_close(a.rotation, b.rotation)


def test_standing_still_gives_finite_gradients():
    estimate = se3.identity(1, 4, dtype=torch.float64).requires_grad_()
    errors = pose_errors(estimate, se3.identity(1, 4, dtype=torch.float64))
    (errors.translation + errors.rotation).sum().backward()
    assert torch.isfinite(estimate.grad).all()
