"""MambaVO's penalty for trends against hand-computed cases, and the gradient of the loss that it weights."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvo.geometry import se3
from dvo.losses.flow import flow_error, flow_loss
from dvo.losses.pose import pose_errors
from dvo.losses.trend import CLAMP, TrendPenalty, trend_ratio


def test_the_ratio_is_that_to_the_mean_of_the_last_values_and_clamped():
    assert trend_ratio(3.0, (9.0, 1.0, 3.0), 2) == 1.5
    assert trend_ratio(100.0, (1.0, 1.0), 2) == CLAMP[1] and trend_ratio(0.01, (1.0, 1.0), 2) == CLAMP[0]
    assert trend_ratio(3.0, (1.0,), 2) == 1.0  # too few values for a trend
    assert trend_ratio(3.0, (0.0, 0.0), 2) == 1.0


def test_a_growing_flow_gains_weight_and_a_growing_pose_loss_takes_it():
    penalty = TrendPenalty(window=2)
    assert [penalty.follow(1.0, 2.0) for _ in range(3)] == [1.0, 1.0, 1.0]
    assert penalty.follow(1.0, 3.0) == pytest.approx(math.exp(1.5 - 1))
    assert penalty.follow(1.5, 2.5) == pytest.approx(math.exp(1 - 1.5))
    assert penalty.follow(1.25 * 1.2, 2.75 * 1.2) == pytest.approx(1.0)  # equal trends


@pytest.mark.parametrize("bad", [(math.nan, 1.0), (1.0, math.inf), (1.0, 0.0)])
def test_a_step_without_a_loss_changes_nothing(bad):
    penalty = TrendPenalty(window=2)
    for flow in (1.0, 1.0, 1.4):
        penalty.follow(1.0, flow)
    before = penalty.state_dict()
    assert penalty.follow(*bad) == before["value"] and penalty.state_dict() == before


@given(st.lists(st.tuples(st.floats(1e-9, 1e9), st.floats(1e-9, 1e9)), max_size=30))
def test_the_factor_is_bounded_and_survives_a_checkpoint(losses):
    penalty = TrendPenalty()
    for pair in losses:
        assert math.exp(-1.5) <= penalty.follow(*pair) <= math.exp(1.5)
    again = TrendPenalty()
    again.load_state_dict(penalty.state_dict())
    assert again == penalty and len(again.flow) == min(4, len(losses))


@pytest.mark.long
def test_gradcheck_of_the_weighted_loss():
    """The penalty is a constant: the gradient is that of the sum with fixed weights."""
    g = torch.Generator().manual_seed(0)
    truth = se3.exp(0.3 * torch.randn(1, 4, 6, generator=g, dtype=torch.float64))
    twist = torch.randn(1, 4, 6, generator=g, dtype=torch.float64, requires_grad=True)
    coords = torch.randn(1, 5, 3, 3, 2, generator=g, dtype=torch.float64, requires_grad=True)
    valid, edges = torch.ones(1, 5, 3, 3, dtype=torch.bool), torch.ones(5, dtype=torch.bool)
    penalty = TrendPenalty(window=1, pose=(1.0,), flow=(1.0,))

    def terms(twist, coords):
        # The reference frame of the scale is fixed, because the alignment of the scale carries no gradient.
        moved = torch.cat([truth[..., :3], se3.exp(0.2 * twist)[..., 3:]], -1)
        errors = pose_errors(moved, truth)
        return errors.rotation.mean(), flow_loss(flow_error(coords, torch.zeros_like(coords), valid), edges)

    factor = penalty.follow(*(x.item() for x in terms(twist, coords)))
    assert factor != 1
    assert torch.autograd.gradcheck(lambda *x: terms(*x)[0] + factor * terms(*x)[1], (twist, coords))
    pose, flow = terms(twist, coords)
    (found,) = torch.autograd.grad(pose + factor * flow, coords, retain_graph=True)
    (plain,) = torch.autograd.grad(flow, coords)
    torch.testing.assert_close(found, factor * plain)
