"""Linear layers in 8 bits: kernels against their twins, and both against layers in single precision."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from dvo.models.patch_vo import PatchVO
from dvo.nets.patch.config import preset
from dvo.nets.update import int8
from dvo.nets.update.int8 import Int8Linear, Rows, multiply_rounded, pack_rows, round_rows, round_weights

with_kernels = pytest.mark.skipif(not int8.has_kernels(), reason="no instructions for products of bytes, or no kernels")


def unpacked(rows: Rows, channels: int):
    """Levels, scale and offset of a kernel in the shapes of the twin."""
    levels, scale, offset = (torch.from_numpy(x)[: rows.count] for x in (rows.levels, rows.scale, rows.offset))
    return levels[:, :channels].float(), scale[:, None], offset[:, None]


def random_rows(seed: int, *shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    spread = 10 ** (6 * torch.rand(shape[0], 1, generator=generator) - 3)
    return torch.randn(shape, generator=generator) * spread + torch.randn(shape[0], 1, generator=generator)


@with_kernels
@given(
    seed=st.integers(0, 999), count=st.integers(1, 40), first=st.integers(1, 70), further=st.integers(0, 70),
    half=st.booleans(), rectified=st.booleans(),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_rows_are_rounded_as_by_the_twin(seed, count, first, further, half, rectified):
    x = random_rows(seed, count, first + further).to(torch.bfloat16 if half else torch.float32)
    parts = [part.contiguous() for part in x.split([first, further], 1)]
    levels, scale, offset = unpacked(pack_rows(*parts, rectified=rectified), first + further)
    x = x.relu() if rectified else x
    expected, *numbers = round_rows(x)
    torch.testing.assert_close((scale, offset), tuple(numbers), rtol=1e-6, atol=0)
    exact = torch.where(scale > 0, (x.double() - offset) / scale.double(), 0.0)
    for found in (levels, expected):  # what is halfway may be rounded either way
        assert (found - exact).abs().max() <= 0.5 + 2e-4
    assert (levels >= 0).all() and (levels <= 255).all()


@with_kernels
@given(
    seed=st.integers(0, 999), count=st.integers(1, 40), channels=st.integers(1, 150), outputs=st.integers(1, 150),
    half=st.booleans(),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_products_are_those_of_the_rounded_numbers(seed, count, channels, outputs, half):
    torch.manual_seed(seed)
    layer = Int8Linear(nn.Linear(channels, outputs), torch.bfloat16 if half else torch.float32)
    rows = pack_rows(random_rows(seed, count, channels))
    levels, scale, offset = (x.double() for x in unpacked(rows, channels))
    whole, size = (x.double() for x in round_weights(layer.weight))
    expected = (scale * levels + offset) @ (whole * size).mT + layer.bias.double()
    with torch.no_grad():
        found = torch.from_numpy(layer.multiply(rows)).view(layer.gives)
    sizes = (scale * levels + offset).norm(dim=1, keepdim=True) * (whole * size).norm(dim=1)
    assert ((found.double() - expected).abs() <= (4e-3 if half else 1e-5) * (sizes + expected.abs())).all()


@given(seed=st.integers(0, 999), channels=st.integers(8, 100))
@settings(max_examples=30, deadline=None)
def test_a_layer_is_near_the_one_it_is_made_of(seed, channels):
    torch.manual_seed(seed)
    single, x = nn.Linear(channels, 24), torch.randn(2, 9, channels)
    with torch.no_grad():
        expected, found = single(x), Int8Linear(single, torch.float32)(x)
        twin = multiply_rounded(x, single.weight, single.bias)
    assert found.shape == expected.shape
    assert float((found - expected).norm() / expected.norm()) < 0.02
    assert float((found - twin).norm() / twin.norm()) < 2e-3
    assert not torch.equal(twin, expected)


@pytest.mark.parametrize("kernels", ["numba", "torch"])
def test_a_row_that_is_not_finite_gives_nan_and_leaves_the_others(kernels, monkeypatch):
    monkeypatch.setenv("DVO_KERNELS", kernels)
    layer = Int8Linear(nn.Linear(20, 8), torch.float32)
    x = torch.randn(7, 20)
    with torch.no_grad():
        expected = layer(x)
        for bad in (torch.nan, torch.inf, -torch.inf, -torch.nan):
            spoilt = x.clone()
            spoilt[3, 5] = bad
            found = layer(spoilt)
            assert found[3].isnan().all()
            assert torch.equal(found[[0, 1, 2, 4, 5, 6]], expected[[0, 1, 2, 4, 5, 6]])


@pytest.mark.parametrize("kernels", ["numba", "torch"])
def test_rows_of_one_value_and_weights_of_zero(kernels, monkeypatch):
    monkeypatch.setenv("DVO_KERNELS", kernels)
    single = nn.Linear(12, 5)
    with torch.no_grad():
        single.weight[2] = 0
        x = torch.full((3, 12), 2.5)
        x[1] = 0
        x[2] = torch.linspace(0, 1e-41, 12)
        found, expected = Int8Linear(single, torch.float32)(x), single(x)
    torch.testing.assert_close(found, expected, rtol=0.02, atol=0.02)
    torch.testing.assert_close(found[:, 2], single.bias[2].expand(3))
    torch.testing.assert_close(found[1:], single.bias.expand(2, 5))


def test_a_network_in_8_bits_is_a_copy_whose_update_operator_alone_differs():
    model = PatchVO(preset("tiny")).eval()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    found = model.in_int8()
    layers = [layer for layer in found.update.modules() if isinstance(layer, Int8Linear)]
    assert len(layers) == sum(isinstance(x, nn.Linear) for x in model.update.modules()) - 2, "all but the two heads"
    assert {layer.gives for layer in layers} == {found.precision}
    assert not any(isinstance(layer, Int8Linear) for layer in model.modules())
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
