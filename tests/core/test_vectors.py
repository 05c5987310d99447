"""Vector instructions: what an intrinsic that is made of them loads, repeats and stores."""

import numpy as np
import pytest
import torch

numba = pytest.importorskip("numba")

from numba import types  # noqa: E402
from numba.extending import intrinsic  # noqa: E402

from dvo.core.vectors import CONTRACT, Vectors  # noqa: E402

LANES = 8


@intrinsic
def _scaled_sums(context, x, rows, factor, out):
    """Fill ``out (LANES,)`` with the sums over rows of flat ``x``, times a factor."""

    def generate(*generating):
        vectors, (_, count, factor, _) = Vectors(LANES, *generating), generating[3]
        builder, scale = vectors.builder, vectors.everywhere(factor)

        def added(row, sums):
            value = vectors.load(vectors.place(0, builder.mul(row, vectors.index(LANES))))
            return [builder.fadd(sums[0], builder.fmul(value, scale, **CONTRACT), **CONTRACT)]

        (total,) = vectors.repeat(count, [vectors.constant(0.0)], added)
        vectors.store(total, vectors.place(3))
        return vectors.target.get_dummy_value()

    return types.void(x, types.intp, types.float32, out), generate


@numba.njit
def scaled_sums(x, factor, out):
    _scaled_sums(x, len(x) // LANES, factor, out)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("rows", [1, 5])
def test_numbers_of_float32_and_bfloat16_are_loaded_and_stored(half, rows):
    x = torch.randn(rows, LANES, generator=torch.Generator().manual_seed(rows))
    x = x.bfloat16() if half else x
    out = torch.empty(LANES, dtype=x.dtype)
    bits = [(one.view(torch.uint16) if half else one).numpy() for one in (x.flatten(), out)]
    scaled_sums(bits[0], np.float32(1.5), bits[1])
    exact = 1.5 * x.double().sum(0)
    torch.testing.assert_close(out.double(), exact, atol=1e-5, rtol=2**-8 if half else 1e-5)


def test_bfloat16_is_rounded_to_the_nearest_ties_to_even():
    given = torch.tensor([1.0, 1.00390625, 1.01171875, -1.00390625, 3e38, 0.0, float("inf"), 1e-30]).bfloat16()
    out = torch.empty(LANES, dtype=torch.bfloat16)
    factor = 1.00390625  # products that bfloat16 does not hold
    scaled_sums(given.view(torch.uint16).numpy(), np.float32(factor), out.view(torch.uint16).numpy())
    assert torch.equal(out, (given.float() * factor).bfloat16())
