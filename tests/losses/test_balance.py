"""V2V's weighted flow loss and balance against hand-computed cases."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.losses.balance import FLOOR, Coefficient, gradient
from dvo.losses.flow import flow_error, flow_loss, weighted_flow_error


def patches(*offsets):
    """One edge an offset, all pixels of a patch off by it."""
    estimate = torch.tensor(offsets).view(1, -1, 1, 1, 2).expand(-1, -1, 3, 3, -1).clone().requires_grad_()
    return estimate, torch.zeros_like(estimate), torch.ones(estimate.shape[:-1], dtype=torch.bool)


def test_weighted_error_scales_each_axis_by_its_confidence():
    estimate, truth, valid = patches([3.0, 4.0], [1.0, 0.0])
    confidence = torch.tensor([[[1.0, 0.5], [0.25, 1.0]]])
    error = weighted_flow_error(estimate, truth, valid, confidence)
    torch.testing.assert_close(error, torch.tensor([[13.0**0.5, 0.25]]))  # |(3, 2)| and |(0.25, 0)|
    torch.testing.assert_close(flow_loss(error, torch.tensor([True, True])), torch.tensor((13.0**0.5 + 0.25) / 2))


def test_the_minimum_is_taken_of_the_weighted_errors():
    estimate, truth, valid = patches([2.0, 0.0])
    estimate = estimate.detach().clone()
    estimate[0, 0, 0, 0] = torch.tensor([0.0, 1.0])  # the smaller error, but on the trusted axis
    confidence = torch.tensor([[[0.1, 1.0]]])
    torch.testing.assert_close(flow_error(estimate, truth, valid), torch.tensor([[1.0]]))
    torch.testing.assert_close(weighted_flow_error(estimate, truth, valid, confidence), torch.tensor([[0.2]]))


def test_no_gradient_reaches_the_confidence_and_the_one_to_the_flow_is_weighted():
    estimate, truth, valid = patches([3.0, 4.0], [0.0, 2.0])
    confidence = torch.tensor([[[0.5, 0.5], [0.1, 0.2]]], requires_grad=True)
    flow_loss(weighted_flow_error(estimate, truth, valid, confidence), torch.tensor([True, True])).backward()
    assert confidence.grad is None
    # d|w e| / de = w^2 e / |w e| = 0.5 (0.6, 0.8), half of it by the mean over two edges; and 0.2 (0, 1)
    torch.testing.assert_close(estimate.grad[0, 0].sum((0, 1)), torch.tensor([0.15, 0.2]))
    torch.testing.assert_close(estimate.grad[0, 1].sum((0, 1)), torch.tensor([0.0, 0.1]))


def test_equal_confidence_of_one_is_the_plain_loss():
    estimate, truth, valid = patches([3.0, 4.0], [0.0, 2.0])
    weighted = weighted_flow_error(estimate, truth, valid, torch.ones(1, 2, 2))
    assert torch.equal(weighted, flow_error(estimate, truth, valid))


def test_coefficient_is_the_mean_of_clamped_ratios():
    c = Coefficient()
    assert c.follow(6.0, 2.0) == 3.0  # the first measurement: the mean of one
    assert c.follow(1.0, 1.0) == pytest.approx((3 + 1) / 2)
    assert c.follow(1000.0, 1.0) == pytest.approx((3 + 1 + 20) / 3)  # at most ten times the present 2
    assert c.follow(0.0, 1.0) == pytest.approx((3 + 1 + 20 + 0.8) / 4)  # at least a tenth of the present 8
    assert Coefficient().follow(1.0, 0.0) == 10.0
    assert Coefficient(value=1.0).follow(2 * FLOOR, 0.0) == pytest.approx(2.0)  # the floor of the norms


def test_coefficient_forgets_beyond_its_window_and_survives_saving():
    c = Coefficient(window=2)
    for ratio in (1.0, 2.0, 4.0):
        c.follow(ratio, 1.0)
    assert c.value == 3.0
    again = Coefficient(window=2)
    again.load_state_dict(c.state_dict())
    assert again.follow(5.0, 1.0) == c.follow(5.0, 1.0) == 4.5


@given(st.lists(st.floats(1e-9, 1e9), min_size=1, max_size=80))
@settings(max_examples=30, deadline=None)
def test_coefficient_never_runs_away_in_one_measurement(ratios):
    c = Coefficient()
    for ratio in ratios:
        before = c.value
        after = c.follow(ratio, 1.0)
        assert 0 < after < float("inf")
        assert after <= max(10 * before, max(c.recent)) + 1e-9
        assert len(c.recent) <= 50


def test_measuring_a_gradient_leaves_training_untouched():
    x = torch.tensor([1.0, 2.0], requires_grad=True)
    unused = torch.ones(3, requires_grad=True)
    loss = (x**2).sum()
    torch.testing.assert_close(gradient(loss, x), torch.tensor([2.0, 4.0]))
    assert torch.equal(gradient(loss, unused), torch.zeros(3))
    assert torch.equal(gradient(torch.zeros(()), x), torch.zeros(2))
    assert x.grad is None
    loss.backward()
    torch.testing.assert_close(x.grad, torch.tensor([2.0, 4.0]))
