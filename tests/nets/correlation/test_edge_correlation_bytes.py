"""Look-up in maps of whole numbers: the twin everywhere, and the kernel where the CPU multiplies bytes."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.context import multiplies_bfloat16
from dvo.nets.correlation.edge_correlation import EdgeCorrelation, fits_bytes, round_channels
from tests.support.looked_up_edges import edges

CPU = torch.device("cpu")
CHANNELS = [4, 24, 64, 96]


def whole(x):
    """The numbers that rounding leaves."""
    levels, scale, _ = round_channels(x)
    return levels.float() * scale[..., None]


def filled(channels, dtype, height=12, width=17, frames=3):
    generator = torch.Generator().manual_seed(channels)
    level = EdgeCorrelation(2.0, 3, CPU, dtype)
    for slot in range(frames):
        of_frame = torch.randn(height, width, channels, generator=generator)
        of_frame = of_frame * 10 ** (3 * torch.rand(height, width, 1, generator=generator) - 2)
        kept = of_frame if dtype == torch.uint8 else whole(of_frame)
        level.keep_map(slot, kept.permute(2, 0, 1).contiguous() if slot else kept.permute(2, 0, 1))
    return level


@pytest.mark.parametrize("kernels", ["numba", "torch"])
@given(
    channels=st.sampled_from(CHANNELS), side=st.sampled_from([1, 3]),
    spread=st.sampled_from([0.3, 1.0, 2.2, 9.0, 40.0]), seed=st.integers(0, 99), known=st.booleans(),
    half=st.booleans(),
)  # fmt: skip
@settings(deadline=None)
def test_channels_are_the_products_of_the_whole_numbers(kernels, channels, side, spread, seed, known, half):
    coords, features, kk, frames = edges(channels, side, spread, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DVO_KERNELS", kernels)
        if not half:
            patch.setattr("dvo.nets.correlation.edge_correlation.multiplies_bfloat16", lambda device: False)
        levels, *numbers = round_channels(features)
        given = (levels, kk, frames, torch.stack(numbers, -1)) if known else (features, kk, frames)
        found = filled(channels, torch.uint8).lookup(coords, *given)
        expected = filled(channels, torch.float32).lookup(coords, whole(features), kk, frames)
    assert found.dtype == (torch.bfloat16 if half and multiplies_bfloat16(CPU) else torch.float32)
    half = found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), expected, rtol=2**-8 if half else 1e-4, atol=1e-3, equal_nan=True)
    assert found.isnan().any() and (found == 0).any()


@given(
    seed=st.integers(0, 999), height=st.integers(1, 9), width=st.integers(1, 20), channels=st.integers(1, 70),
    above=st.sampled_from([0, 128]), last=st.booleans(),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_pixels_are_rounded_as_by_the_twin(seed, height, width, channels, above, last):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(channels, height, width, generator=generator)
    x = x * 10 ** (6 * torch.rand(1, height, width, generator=generator) - 3)
    x[:, 0, 0] = 0
    x = x.permute(1, 2, 0).contiguous() if last else x.permute(1, 2, 0)
    for kernels in ("numba", "torch"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("DVO_KERNELS", kernels)
            levels, scale, total = round_channels(x, above=above)
        assert levels.dtype == (torch.uint8 if above else torch.int8)
        numbers = levels.float() - above
        assert numbers.abs().max() <= 127 and (numbers[0, 0] == 0).all()
        torch.testing.assert_close(scale, x.abs().amax(-1) / 127, rtol=1e-6, atol=0)
        error = (numbers.double() * scale[..., None] - x).abs()
        assert (error <= (0.5 + 1e-4) * scale[..., None]).all()
        assert torch.equal(total, 128 * numbers.sum(-1))


@pytest.mark.parametrize("kernels", ["numba", "torch"])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_a_pixel_that_is_not_finite_gives_nan_where_it_is_seen(kernels, bad, monkeypatch):
    monkeypatch.setenv("DVO_KERNELS", kernels)
    x = torch.ones(8, 20, 32)
    x[2, 3, 5] = bad
    levels, scale, total = round_channels(x)
    assert scale.isnan().nonzero().tolist() == [[2, 3]]
    assert (levels[2, 3] == 0).all() and total[2, 3] == 0
    level = EdgeCorrelation(1.0, 3, CPU, torch.uint8)
    level.keep_map(0, x.permute(2, 0, 1))
    index, coords = torch.zeros(2, dtype=torch.long), torch.tensor([[3.0, 2.0], [16.0, 4.0]]).view(2, 1, 1, 2)
    found = level.lookup(coords, torch.ones(1, 1, 32), index, index)
    assert found[0].isnan().any() and found[1].isfinite().all()


@pytest.mark.skipif(not fits_bytes(64, 3), reason="no instructions for products of bytes, or no kernels")
def test_the_kernel_is_used(monkeypatch):
    from dvo.nets.correlation import edge_correlation_kernels

    calls, kernel = [], edge_correlation_kernels.correlate_bytes
    monkeypatch.setattr(edge_correlation_kernels, "correlate_bytes", lambda *given: calls.append(kernel(*given)))
    filled(64, torch.uint8).lookup(*edges(64, 3, 1.0, 0))
    assert len(calls) == 1


def test_no_kernel_for_another_cpu_nor_for_other_sizes(monkeypatch):
    assert not fits_bytes(42, 3) and not fits_bytes(64, 2)
    monkeypatch.setattr("dvo.core.compiled.compiles_int8", lambda: False)
    monkeypatch.setattr("dvo.nets.correlation.edge_correlation_kernels.correlate_bytes", None)
    assert not fits_bytes(64, 3)
    filled(64, torch.uint8).lookup(*edges(64, 3, 1.0, 0))
