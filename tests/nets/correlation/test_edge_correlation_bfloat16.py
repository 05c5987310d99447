"""Look-up in maps of bfloat16: the twin everywhere, and the kernel where the CPU multiplies it."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvo.core.compiled import compiles_bfloat16
from dvo.core.context import multiplies_bfloat16
from dvo.core.kernels import available
from dvo.nets.correlation.edge_correlation import EdgeCorrelation
from tests.support.looked_up_edges import edges

CPU = torch.device("cpu")


def filled(channels, radius, dtype, height=12, width=17, frames=3):
    generator = torch.Generator().manual_seed(channels)
    level = EdgeCorrelation(2.0, radius, CPU, dtype)
    for slot in range(frames):
        level.keep_map(slot, torch.randn(channels, height, width, generator=generator).bfloat16().float())
    return level


@pytest.mark.parametrize("kernels", ["numba", "torch"])
@given(
    channels=st.sampled_from([16, 24, 48, 64, 96]), radius=st.integers(1, 3), side=st.sampled_from([1, 3]),
    spread=st.sampled_from([0.3, 1.0, 2.2, 9.0, 40.0]), seed=st.integers(0, 99),
)  # fmt: skip
def test_channels_are_those_of_single_precision(kernels, channels, radius, side, spread, seed):
    """Of numbers that bfloat16 holds; some sizes are multiplied at once, and others one by one."""
    given = edges(channels, side, spread, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DVO_KERNELS", kernels)
        found = filled(channels, radius, torch.bfloat16).lookup(*given)
        expected = filled(channels, radius, torch.float32).lookup(*given)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), expected, rtol=2**-8, atol=1e-4, equal_nan=True)
    assert found.isnan().any() and (found == 0).any()


@pytest.mark.skipif(
    not (available() and compiles_bfloat16() and multiplies_bfloat16(CPU)), reason="no bfloat16, or no kernels"
)
def test_the_kernel_is_used(monkeypatch):
    from dvo.nets.correlation import edge_correlation_kernels

    calls, kernel = [], edge_correlation_kernels.correlate_bfloat16
    monkeypatch.setattr(edge_correlation_kernels, "correlate_bfloat16", lambda *given: calls.append(kernel(*given)))
    level, (coords, features, *rest) = filled(64, 3, torch.bfloat16), edges(64, 3, 1.0, 0)
    found = [level.lookup(coords, given, *rest) for given in (features, features.bfloat16())]
    assert len(calls) == 2 and torch.equal(*(x.nan_to_num(-1) for x in found))


def test_no_kernel_for_another_cpu(monkeypatch):
    monkeypatch.setattr("dvo.core.compiled.compiles_bfloat16", lambda: False)
    monkeypatch.setattr("dvo.nets.correlation.edge_correlation_kernels.correlate_bfloat16", None)
    given = edges(64, 3, 1.0, 0)
    found, expected = (filled(64, 3, dtype).lookup(*given) for dtype in (torch.bfloat16, torch.float32))
    torch.testing.assert_close(found.float(), expected, rtol=2**-8, atol=1e-4, equal_nan=True)
