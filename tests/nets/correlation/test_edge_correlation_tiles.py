"""Look-up in maps of bfloat16: the twin everywhere, and the kernel where the CPU has matrix units."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvo.core.compiled import compiled_for
from dvo.core.context import multiplies_tiles
from dvo.core.kernels import available
from dvo.nets.correlation.edge_correlation import EdgeCorrelation, fits_tiles

CPU = torch.device("cpu")
tiled = pytest.mark.skipif(
    not (available() and compiled_for("amx-bf16") and multiplies_tiles(CPU)), reason="no matrix units, or no kernels"
)


def filled(channels, radius, dtype, height=12, width=17, frames=3):
    generator = torch.Generator().manual_seed(channels)
    level = EdgeCorrelation(2.0, radius, CPU, dtype)
    for slot in range(frames):
        level.keep_map(slot, torch.randn(channels, height, width, generator=generator).bfloat16().float())
    return level


def edges(channels, side, spread, seed, count=40):
    generator = torch.Generator().manual_seed(seed)
    ticks = spread * (torch.arange(side) - side // 2)
    patch = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1)
    coords = torch.rand(count, 1, 1, 2, generator=generator) * torch.tensor([60.0, 50.0]) - 12 + patch
    coords[3, 0, 0, 1] = torch.nan
    coords[5, ..., 0] = 1e6
    features = torch.randn(7, side**2, channels, generator=generator).bfloat16().float()
    kk, frames = (torch.randint(most, (count,), generator=generator) for most in (7, 3))
    return coords, features, kk, frames


@pytest.mark.parametrize("kernels", ["numba", "torch"])
@given(
    channels=st.sampled_from([32, 64, 96]), radius=st.integers(1, 3), side=st.sampled_from([1, 3]),
    spread=st.sampled_from([0.3, 1.0, 2.2, 9.0, 40.0]), seed=st.integers(0, 99),
)  # fmt: skip
def test_channels_are_those_of_single_precision_rounded(kernels, channels, radius, side, spread, seed):
    """Of numbers that bfloat16 holds."""
    given = edges(channels, side, spread, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DVO_KERNELS", kernels)
        found = filled(channels, radius, torch.bfloat16).lookup(*given)
        expected = filled(channels, radius, torch.float32).lookup(*given)
    assert found.dtype == torch.bfloat16 and found.shape == expected.shape
    torch.testing.assert_close(found.float(), expected, rtol=2**-8, atol=1e-4, equal_nan=True)
    assert found.isnan().any() and (found == 0).any()


@tiled
def test_the_kernel_serves_the_sizes_of_the_default_network(monkeypatch):
    from dvo.nets.correlation import edge_correlation_kernels

    calls = []
    kernel = edge_correlation_kernels.correlate_bfloat16
    monkeypatch.setattr(edge_correlation_kernels, "correlate_bfloat16", lambda *given: calls.append(kernel(*given)))
    filled(64, 3, torch.bfloat16).lookup(*edges(64, 3, 1.0, 0))
    assert len(calls) == 1 and fits_tiles(64, 9, 3)
    filled(48, 3, torch.bfloat16).lookup(*edges(48, 3, 1.0, 0))
    assert len(calls) == 1 and not fits_tiles(48, 9, 3)


class Units:
    """Instructions of matrix units in NumPy, each as the intrinsic of its name."""

    @staticmethod
    def _configure(shapes):
        assert shapes[0] == 1 and set(shapes[48:51]) == {16}

    @staticmethod
    def _release(): ...

    @staticmethod
    def _row_of_products(maps, first, tiles, second, channels, products, row):
        pixels = numbers(maps[first : first + 16 * channels]).reshape(16, channels)
        pairs = tiles[second : second + 8 * channels].view(np.uint16).reshape(channels // 2, 16, 2)
        features = numbers(pairs).transpose(0, 2, 1).reshape(channels, 16)
        products[row : row + 256] = (pixels @ features).ravel()

    @staticmethod
    def _move(products, first, step, shares):
        here, beyond = products[first : first + 16], products[first + step : first + step + 16]
        here += shares * (beyond - here)

    @staticmethod
    def _move_to(products, first, step, shares, bits):
        Units._move(products, first, step, shares)
        bits[first : first + 16] = torch.tensor(products[first : first + 16]).bfloat16().view(torch.uint16).numpy()


def numbers(bits):
    return (bits.astype(np.uint32) << 16).view(np.float32)


@pytest.mark.skipif(not available(), reason="no kernels")
@pytest.mark.parametrize(("radius", "side", "spread"), [(3, 3, 1.0), (2, 3, 9.0), (3, 1, 0.0)])
def test_what_the_kernel_asks_of_the_units(radius, side, spread, monkeypatch):
    """Its loops as Python runs them, on any CPU."""
    from dvo.nets.correlation import edge_correlation_kernels as kernels

    given = edges(32, side, spread, 0, count=8)
    expected = filled(32, radius, torch.float32).lookup(*given)  # compiled before its parts are replaced
    for name in ("_tiles", "_corner", "_by_frame", "_blend_tiles", "_take"):
        monkeypatch.setattr(kernels, name, getattr(kernels, name).py_func)
    for name in ("_configure", "_release", "_row_of_products", "_move", "_move_to"):
        monkeypatch.setattr(kernels, name, getattr(Units, name))
    monkeypatch.setattr(kernels, "correlate_bfloat16", kernels.correlate_bfloat16.py_func)
    level = filled(32, radius, torch.bfloat16)
    monkeypatch.setattr("dvo.nets.correlation.edge_correlation.multiplies_tiles", lambda device: True)
    monkeypatch.setattr("dvo.core.compiled.compiled_for", lambda feature: True)
    monkeypatch.setattr("dvo.nets.correlation.edge_correlation.correlate_edges", None)
    found = level.lookup(*given)
    torch.testing.assert_close(found.float(), expected, rtol=2**-8, atol=1e-4, equal_nan=True)


def test_units_are_used_with_permission_alone(monkeypatch):
    """A CPU may have them, and the operating system not give them."""
    monkeypatch.setattr("dvo.core.compiled.compiled_for", lambda feature: True)
    monkeypatch.setattr("dvo.nets.correlation.edge_correlation.multiplies_tiles", lambda device: False)
    given = edges(64, 3, 1.0, 0)
    assert filled(64, 3, torch.bfloat16).lookup(*given).dtype == torch.bfloat16


@tiled
def test_torch_multiplies_as_before_beside_the_kernel():
    """Both use the units of one thread."""
    matrix = torch.randn(64, 64, generator=torch.Generator().manual_seed(0)).bfloat16()
    before = matrix @ matrix
    for _ in range(3):
        filled(64, 3, torch.bfloat16).lookup(*edges(64, 3, 1.0, 0))
        assert torch.equal(matrix @ matrix, before)
