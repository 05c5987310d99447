"""The selective scan: its loop, its gradients, and that nothing overflows."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from dvo.nets.update.selective_scan import linear_recurrence, selective_loop, selective_scan, selective_step

METHODS = ["parallel", "sequential"]


def arguments(length=7, channels=3, states=2, sequences=2, seed=0, dtype=torch.float64):
    g = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=g, dtype=dtype)

    s, n = sequences, length
    step, rate = functional.softplus(draw(s, n, channels)), draw(states, channels).exp()
    inputs, write, read = draw(s, n, channels), draw(s, n, states), draw(s, n, states)
    return inputs, step, rate, write, read, draw(s, states, channels)


@pytest.mark.parametrize("method", METHODS)
@given(length=st.integers(1, 40), seed=st.integers(0, 99), started=st.booleans())
@settings(max_examples=30)
def test_the_scan_equals_the_loop_in_values_and_gradients(method, length, seed, started):
    values = [x.requires_grad_() for x in arguments(length, seed=seed)[: 6 if started else 5]]
    outcomes = []
    for run in (lambda *a: selective_scan(*a, method=method), selective_loop):
        y, state = run(*values)
        loss = (y * torch.linspace(-1, 1, y.numel(), dtype=y.dtype).view_as(y)).sum() + state.square().sum()
        outcomes.append([y, state, *torch.autograd.grad(loss, values)])
    for ours, specified in zip(*outcomes, strict=True):
        torch.testing.assert_close(ours, specified, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("method", METHODS)
def test_gradcheck_and_second_derivatives(method):
    values = [x.requires_grad_() for x in arguments(5)]
    assert torch.autograd.gradcheck(lambda *a: selective_scan(*a, method=method), values)
    small = [x.requires_grad_() for x in arguments(3, 2, 1, 1)]
    assert torch.autograd.gradgradcheck(lambda *a: selective_scan(*a, method=method)[0], small)


def test_it_is_the_zero_order_hold_of_the_continuous_system():
    """One state under constant input: the closed form of dh/dt = -a h + B x, whatever the steps."""
    rate, x, write = torch.tensor([[0.7]]).double(), 1.3, 0.4
    steps = torch.tensor([0.1, 2.0, 0.03, 1.1]).double()
    ones = torch.ones(4, 1).double()
    y, _ = selective_scan(x * ones, steps[:, None], rate, write * ones, ones)
    torch.testing.assert_close(y[:, 0], write * x / 0.7 * (1 - torch.exp(-0.7 * steps.cumsum(0))))


@pytest.mark.parametrize("method", METHODS)
def test_a_step_of_zero_passes_a_position_over(method):
    inputs, step, rate, write, read, state = arguments(6)
    kept = torch.tensor([0, 2, 5])
    step[:, [1, 3, 4]] = 0
    y, last = selective_scan(inputs, step, rate, write, read, state, method)
    short, end = selective_scan(inputs[:, kept], step[:, kept], rate, write[:, kept], read[:, kept], state, method)
    torch.testing.assert_close(y[:, kept], short)
    torch.testing.assert_close(last, end)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12, 3e38])
def test_long_sequences_and_any_step_stay_finite_and_bounded(method, size):
    inputs, step, rate, write, read, _ = arguments(3000, seed=1, dtype=torch.float32)
    step = (torch.rand_like(step) * size).requires_grad_()
    rate = rate.clamp(0.1, 10)
    y, state = selective_scan(inputs, step, rate, write, read, method=method)
    assert torch.isfinite(y).all()
    bound = (inputs[..., None, :] * write[..., None]).abs().amax(1) / rate
    assert (state.abs() <= bound * 1.0001).all()
    (gradient,) = torch.autograd.grad(y.sum(), step)
    assert torch.isfinite(gradient).all()


def test_half_precision_is_raised_to_single():
    values = arguments(dtype=torch.float32)
    exact, _ = selective_scan(*values)
    with torch.autocast("cpu", torch.bfloat16):
        y, state = selective_scan(*values)
        torch.testing.assert_close(y, exact, rtol=0, atol=0)
    half, _ = selective_scan(*(v.bfloat16() for v in values))
    one, after = selective_step(*(v[:, 0].bfloat16() if i != 2 else v for i, v in enumerate(values[:5])), state)
    assert half.dtype == one.dtype == after.dtype == state.dtype == torch.float32


def test_the_recurrence_has_no_effect_of_the_first_decay():
    decay, drive = torch.rand(4, 2, 1), torch.randn(4, 2, 1)
    other = decay.clone()
    other[0] = torch.nan
    assert torch.equal(linear_recurrence(decay, drive), linear_recurrence(other, drive))
