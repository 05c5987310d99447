"""Trust in a teacher's flow, and the mean over what counts."""

import pytest
import torch

from dvo.core.errors import DvoError
from dvo.losses.consistency import Limits, masked_mean, trusted_edges

NAN = float("nan")
LIMITS = Limits(confidence=0.5, residual=1.0, disagreement=2.0, share=0.0)


def row(*values):
    return torch.tensor([values])


def test_every_limit_counts_and_limits_themselves_are_within():
    confidence = row(0.5, 0.4, 0.9, 0.9, 0.9, NAN)
    residual = row(1.0, 0.1, 1.1, 0.1, 0.1, 0.1)
    apart = row(2.0, 0.1, 0.1, 2.1, 0.1, 0.1)
    valid = row(True, True, True, True, False, True)
    assert trusted_edges(confidence, residual, apart, valid, LIMITS).tolist() == [[True] + [False] * 5]
    without = trusted_edges(confidence, residual, None, valid, LIMITS)
    assert without.tolist() == [[True, False, False, True, False, False]]


def test_a_clip_with_few_trusted_edges_teaches_nothing():
    confidence = torch.tensor([[0.9, 0.9, 0.1, 0.1], [0.9, 0.1, 0.1, 0.1]])
    zero, valid = torch.zeros(2, 4), torch.ones(2, 4, dtype=torch.bool)
    half = Limits(confidence=0.5, share=0.5)
    assert trusted_edges(confidence, zero, zero, valid, half).sum(1).tolist() == [2, 0]
    valid[1, 2:] = False  # edges that are not there do not count as distrusted
    assert trusted_edges(confidence, zero, zero, valid, half).sum(1).tolist() == [2, 1]


def test_the_mean_is_over_the_edges_of_a_clip_then_over_clips():
    error = torch.tensor([[1.0, 3.0, NAN], [8.0, 0.0, 0.0], [5.0, 5.0, 5.0]], requires_grad=True)
    used = torch.tensor([[True, True, False], [True, False, False], [False] * 3])
    mean = masked_mean(error, used)
    assert mean.item() == pytest.approx((2 + 8 + 0) / 3)
    mean.backward()
    torch.testing.assert_close(error.grad, torch.tensor([[1 / 6, 1 / 6, 0], [1 / 3, 0, 0], [0, 0, 0]]))


def test_the_gradient_of_the_mean_is_the_derivative():
    error = torch.rand(2, 4, dtype=torch.float64, requires_grad=True)
    used = torch.tensor([[True, False, True, True], [False] * 4])
    assert torch.autograd.gradcheck(lambda x: masked_mean(x, used), (error,))


@pytest.mark.parametrize("change", [{"confidence": 1.5}, {"residual": -1.0}, {"share": "half"}])
def test_limits_out_of_range_are_refused(change):
    with pytest.raises(DvoError, match=next(iter(change))):
        Limits(**change)
