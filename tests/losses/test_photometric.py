"""Photometric errors of windows: twins, derivatives, and cases known by hand."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.losses.photometric import census_error, photometric_error, photometric_error_plain, ssim_error

FORMS = ["census", "ssim"]


def windows(seed, count=5, side=5, dtype=torch.float64):
    draw = torch.Generator().manual_seed(seed)
    return 255 * torch.rand(2, count, side, side, generator=draw, dtype=dtype)


@pytest.mark.parametrize("form", FORMS)
def test_values_and_gradients_are_those_of_the_definition(form):
    found = []
    for function in (photometric_error, photometric_error_plain):
        a, b = (x.clone().requires_grad_() for x in windows(1))
        error = function(a, b, form)
        error.sum().backward()
        found.append((error.detach(), a.grad, b.grad))
    for fast, plain in zip(*found, strict=True):
        torch.testing.assert_close(fast, plain)


@pytest.mark.parametrize("form", FORMS)
def test_gradients_are_the_derivatives(form):
    # Near each other in grey level: of large differences the census has hardly a derivative.
    a, b = (100 + x / 100 for x in windows(2, 3, 3))
    assert torch.autograd.gradcheck(
        lambda x, y: photometric_error(x, y, form), (a.requires_grad_(), b.requires_grad_())
    )


@pytest.mark.parametrize("form", FORMS)
@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_equal_windows_cost_nothing_others_at_most_one(form, seed):
    a, b = windows(seed)
    assert photometric_error(a, a, form).abs().max() < 1e-9
    error = photometric_error(a, b, form)
    assert (error > 1e-5).all() and (error <= 1).all()
    torch.testing.assert_close(error, photometric_error(b, a, form))


def test_the_census_does_not_see_an_offset_and_ssim_does():
    a, _ = windows(3)
    torch.testing.assert_close(census_error(a, a + 40), torch.zeros(5).double())
    assert (ssim_error(a, a + 40) > 0.02).all()


def test_one_pixel_of_another_order_by_hand():
    """A pixel above the centre in one window and as far below it in the other; the rest is equal."""
    a, b = torch.zeros(1, 3, 3), torch.zeros(1, 3, 3)
    a[0, 0, 0], b[0, 0, 0] = 2.0, -2.0
    gap = 2 * 2.0 / math.sqrt(0.81 + 4)
    assert census_error(a, b).item() == pytest.approx(gap**2 / (0.1 + gap**2) / 8)


@pytest.mark.parametrize("form", FORMS)
def test_the_gradient_of_flat_windows_is_finite(form):
    a = torch.full((2, 5, 5), 30.0, requires_grad=True)
    photometric_error(a, torch.full((2, 5, 5), 30.0), form).sum().backward()
    assert torch.isfinite(a.grad).all()
