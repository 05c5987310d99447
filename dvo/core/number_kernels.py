"""Parts of kernels that take arrays of float32 and of bfloat16, whose bits numba sees as uint16."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


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
