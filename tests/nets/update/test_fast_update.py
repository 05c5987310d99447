"""The update operator with kernels, against its twin, and the exponential of these kernels."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.compiled import compiled
from dvo.map.edges import build_graph
from dvo.models.patch_vo import PatchVO
from dvo.nets.correlation.correlation import Correlation
from dvo.nets.patch.config import preset
from dvo.nets.update import fast_update
from dvo.nets.update.int8 import Int8Linear, has_kernels
from dvo.nets.update.update_kernels import exponential


@compiled
def exponentials(x, out):
    for k in range(len(x)):
        out[k] = exponential(x[k])


def random_update(seed, frames=5, per_frame=3, share=0.7):
    """An operator with random weights and norms, and arguments of edges of which a share is there."""
    torch.manual_seed(seed)
    config = preset("tiny")
    model = PatchVO(config).eval()
    with torch.no_grad():
        for parameter in model.update.parameters():
            parameter += 0.2 * torch.randn_like(parameter)
    kk, jj = (
        x.flatten() for x in torch.meshgrid(torch.arange(frames * per_frame), torch.arange(frames), indexing="ij")
    )
    chosen = torch.rand(len(kk)) < share
    chosen[0] = True
    kk, jj = kk[chosen], jj[chosen]
    graph = build_graph(kk // per_frame, jj, kk, frames)
    channels = config.correlation_channels // len(config.pyramid)
    hidden, context = torch.randn(2, 1, len(kk), config.hidden_channels)
    levels = [3 * torch.randn(1, len(kk), channels) for _ in config.pyramid]
    return model, (hidden, context, Correlation(levels, "pixels_first"), graph)


def by_both(operator, arguments, monkeypatch):
    calls, kernel, found = [], fast_update.revise_by_kernels, []
    with monkeypatch.context() as patch, torch.inference_mode():
        patch.setattr(fast_update, "revise_by_kernels", lambda *given: calls.append(1) or kernel(*given))
        for kernels in ("numba", "torch"):
            patch.setenv("DVO_KERNELS", kernels)
            found.append(operator(*arguments))
    assert len(calls) == (isinstance(operator.corr[0], Int8Linear) <= has_kernels())
    return found


@given(seed=st.integers(0, 999), share=st.sampled_from([0.05, 0.7, 1.0]))
@settings(max_examples=20, deadline=None)
def test_kernels_give_what_the_twin_gives(seed, share):
    model, arguments = random_update(seed, share=share)
    with pytest.MonkeyPatch.context() as monkeypatch:
        found, expected = by_both(model.update, arguments, monkeypatch)
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape and one.dtype == other.dtype
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("precision", ["bfloat16", "int8", "int8 and float32"])
def test_in_lower_precision_they_are_as_near_to_single_precision(precision, monkeypatch):
    """On average over operators: each of the few outputs of one is rounded its own way."""
    if precision == "int8 and float32":  # as on a CPU without instructions for bfloat16
        monkeypatch.setattr("dvo.models.patch_vo.multiplies_bfloat16", lambda device: False)
    sizes = torch.zeros(3, 3)  # by output: errors with kernels and of the twin, and the values
    for seed in range(8):
        model, arguments = random_update(seed)
        lower = model.in_bfloat16() if precision == "bfloat16" else model.in_int8()
        found, twin = by_both(lower.update, arguments, monkeypatch)
        with torch.no_grad():
            exact = model.update(*arguments)
        for k, (one, other, wanted) in enumerate(zip(found, twin, exact, strict=True)):
            assert one.dtype == wanted.dtype
            sizes[k] += torch.stack([x.abs().mean() for x in (one - wanted, other - wanted, wanted)])
    errors, of_twin, values = sizes.unbind(1)
    assert (errors <= 1.3 * of_twin).all() and (errors < 0.05 * values).all()


def test_nan_stays_with_the_edges_that_it_reaches(monkeypatch):
    model, arguments = random_update(0)
    arguments[0][0, 2] = math.nan
    found, expected = by_both(model.update, arguments, monkeypatch)
    for one, other in zip(found, expected, strict=True):
        assert one[0, 2].isnan().all() and not (one.isnan() & ~other.isnan()).any()


def test_the_twin_where_gradients_are_recorded_or_precision_is_mixed(monkeypatch):
    model, arguments = random_update(0)
    monkeypatch.setenv("DVO_KERNELS", "numba")
    monkeypatch.setattr(fast_update, "revise_by_kernels", None)
    hidden, *_ = model.update(*arguments)
    assert hidden.requires_grad
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        model.update(*arguments)


def test_the_exponential_is_that_of_numpy():
    x = np.linspace(-87, 88, 100_001).astype(np.float32)
    found = np.empty_like(x)
    exponentials(x, found)
    exact = np.exp(x.astype(np.float64))
    assert (np.abs(found - exact) <= 2.5e-7 * exact).all()
    special = np.array([-np.inf, -200, 0, np.nan], np.float32)
    exponentials(special, found)
    assert found[0] < 1e-37 and found[1] < 1e-37 and found[2] == 1 and np.isnan(found[3])
