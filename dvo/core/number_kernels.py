"""Parts of kernels that take arrays of float32 and of bfloat16, whose bits numba sees as uint16."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from dvo.core.compiled import part


@intrinsic
def number(context, stored):
    """Number that an array holds: of float32, or the bits of a bfloat16 as uint16."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        if signature.args[0] == types.float32:
            return given[0]
        bits = builder.zext(given[0], ir.IntType(32))
        return builder.bitcast(builder.shl(bits, ir.Constant(bits.type, 16)), ir.FloatType())

    return types.float32(stored), generate


@intrinsic
def stored(context, value, like):
    """Number as an array with elements such as ``like`` holds it; bfloat16 is rounded to the nearest, ties to even."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        if signature.args[1] == types.float32:
            return given[0]
        bits = builder.bitcast(given[0], ir.IntType(32))
        one, half, size = (ir.Constant(bits.type, k) for k in (1, 0x7FFF, 16))
        odd = builder.and_(builder.lshr(bits, size), one)
        rounded = builder.add(builder.add(bits, half), odd)
        return builder.trunc(builder.lshr(rounded, size), ir.IntType(16))

    return like(types.float32, like), generate


@intrinsic
def _power_of_two(context, exponent):
    """Float32 that is two to the power of an int32, of -126 to 127."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        bits = builder.add(given[0], ir.Constant(given[0].type, 127))
        return builder.bitcast(builder.shl(bits, ir.Constant(bits.type, 23)), ir.FloatType())

    return types.float32(types.int32), generate


@part
def exponential(x):
    """Exponential of a float32, to two units in the last place, in instructions that vectors have too.

    Cephes' polynomial (Moshier) behind a power of two. 0 below -87, NaN stays.
    """
    x = np.float32(-87.5) if x < np.float32(-87.5) else x
    x = np.float32(88) if x > np.float32(88) else x
    whole = np.floor(x * np.float32(1.44269504) + np.float32(0.5))
    r = x - whole * np.float32(0.693359375) + whole * np.float32(2.12194440e-4)
    p = np.float32(1.9875691500e-4) * r + np.float32(1.3981999507e-3)
    p = p * r + np.float32(8.3334519073e-3)
    p = p * r + np.float32(4.1665795894e-2)
    p = p * r + np.float32(1.6666665459e-1)
    p = p * r + np.float32(5.0000001201e-1)
    return (p * r * r + r + np.float32(1)) * _power_of_two(np.int32(whole))  # type: ignore[call-arg]
