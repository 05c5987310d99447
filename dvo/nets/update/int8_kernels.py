"""Kernels of :mod:`dvo.nets.update.int8`: rows rounded to 8 bits, and their products with packed weights.

An instruction (AVX-512 VNNI, or AVX-VNNI for vectors half as long) adds four products of bytes to each of its sums of
32 bits. Sums of integers are exact, so that no order of them matters. Features are of float32, or bits of bfloat16 as
uint16 (:mod:`dvo.core.number_kernels`).
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from dvo.core.compiled import compiled, part
from dvo.core.number_kernels import number

Array = Any

LANES = 16 if llvmlite.binding.get_host_cpu_features().get("avx512vnni") else 8
"""Sums of 32 bits in a vector of this machine."""
_VECTORS = 4 if LANES == 16 else 2
COLUMNS = _VECTORS * LANES
"""Outputs that are computed at once."""
ROWS = 6
"""Inputs likewise: so many sums stay in registers."""
_SUMS, _FLOATS = ir.VectorType(ir.IntType(32), LANES), ir.VectorType(ir.FloatType(), LANES)
_HALVES = ir.VectorType(ir.IntType(16), LANES)
_LEAST = np.float32(1e-30)  # distance of the bounds of a row, below which it is taken as one value


@part
def _copy(x, floor, row):
    for c in range(len(row)):
        row[c] = number(x[c])  # type: ignore[call-arg]
        row[c] = floor if row[c] < floor else row[c]


@part
def _ordered(bits):
    """Whole numbers, in the order of the numbers of float32 that have these bits; and the other way round."""
    return np.int32(bits ^ ((bits >> np.int32(31)) & np.int32(0x7FFFFFFF)))


@part
def _bounds(bits):
    """Least and largest of a row of float32 by their bits, by :func:`_ordered`; NaN is beyond the infinite numbers."""
    least, most = _ordered(bits[0]), _ordered(bits[0])
    for c in range(len(bits)):
        value = _ordered(bits[c])
        least = value if value < least else least
        most = value if value > most else most
    return least, most


@compiled
def quantise(x: Array, further: Array, rectified: bool, out: Array, scale: Array, offset: Array) -> None:
    """Fill ``out (E / ROWS, C / 4, ROWS)`` with ``round((x - offset) / scale)``, of 0 to 255 for the bounds of a row.

    A row is that of ``x (E, A)`` followed by that of ``further (E, B)``, perhaps rectified; four levels are a uint32. A
    row with a number that is not finite gets a scale of NaN.
    """
    count, steps = x.shape[1], out.shape[1]
    row, levels = np.empty(count + further.shape[1], np.float32), np.zeros(4 * steps, np.uint8)
    bits, bound, fours = row.view(np.int32), np.empty(2, np.int32), levels.view(np.uint32)
    bounds = bound.view(np.float32)
    floor = np.float32(0) if rectified else np.float32(-np.inf)
    for e in range(len(x)):
        _copy(x[e], floor, row[:count])
        _copy(further[e], floor, row[count:])
        least, most = _bounds(bits)
        to, r = out[e // ROWS], e % ROWS
        bound[0], bound[1] = _ordered(least), _ordered(most)
        low, size = bounds[0], bounds[1] - bounds[0]
        if not size < np.float32(np.inf):
            scale[e], offset[e] = np.nan, 0
            to[:, r] = 0
            continue
        factor = np.float32(255) / size if size > _LEAST else np.float32(0)
        scale[e], offset[e] = size / np.float32(255), low
        for c in range(len(row)):
            levels[c] = np.uint8(np.int32((row[c] - low) * factor + np.float32(0.5)))
        for c in range(steps):
            to[c, r] = fours[c]


@intrinsic
def _multiply(context, rows, first, weights, panel, steps, scales, offsets, at, layer, column, out, to, stride):
    """Products of some rows of bytes with a panel of weights, scaled, into flat ``out`` from ``to``.

    Args:
        rows: flat uint8; those of a product begin at ``first``.
        weights: flat int8; the panel begins at ``panel`` and has ``steps`` times four bytes of each column.
        scales, offsets: of the rows, from ``at``.
        layer: flat float32: scale, sum and bias of the columns from ``column``, 3 x COLUMNS.
        out: flat, of float32 or bits of bfloat16; rows are ``stride`` apart.
    """
    single = out.dtype == types.float32
    kept = _FLOATS if single else _HALVES

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        index = given[1].type

        def place(k: int, *steps: Any) -> Any:
            pointer = cgutils.create_struct_proxy(signature.args[k])(target, builder, value=given[k]).data
            for step in steps:
                pointer = builder.gep(pointer, [ir.Constant(index, step) if isinstance(step, int) else step])
            return pointer

        def loaded(pointer: Any, kind: Any) -> Any:
            return builder.load(builder.bitcast(pointer, kind.as_pointer()), align=1)

        def everywhere(value: Any, kind: Any) -> Any:
            undefined, lanes = ir.Constant(kind, ir.Undefined), ir.VectorType(ir.IntType(32), LANES)
            first = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
            return builder.shuffle_vector(first, undefined, ir.Constant(lanes, [0] * LANES))

        def rounded(value: Any) -> Any:
            """Bits of bfloat16, ties to even."""
            bits = builder.bitcast(value, _SUMS)
            size, half, one = (ir.Constant(_SUMS, [k] * LANES) for k in (16, 0x7FFF, 1))
            odd = builder.and_(builder.lshr(bits, size), one)
            return builder.trunc(builder.lshr(builder.add(builder.add(bits, half), odd), size), _HALVES)

        unit = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_SUMS, [_SUMS] * 3), f"llvm.x86.avx512.vpdpbusd.{32 * LANES}"
        )
        entry, loop, end = builder.block, builder.append_basic_block(), builder.append_basic_block()
        inputs, start = place(0, given[1]), place(2, given[3])
        builder.branch(loop)
        builder.position_at_end(loop)
        step = builder.phi(index)
        sums = [[builder.phi(_SUMS) for _ in range(_VECTORS)] for _ in range(ROWS)]
        inputs = builder.gep(inputs, [builder.mul(step, ir.Constant(index, 4 * ROWS))])
        start = builder.gep(start, [builder.mul(step, ir.Constant(index, 4 * COLUMNS))])
        columns = [loaded(builder.gep(start, [ir.Constant(index, 4 * LANES * k)]), _SUMS) for k in range(_VECTORS)]
        after = []
        for r, before in enumerate(sums):
            four = loaded(builder.gep(inputs, [ir.Constant(index, 4 * r)]), ir.IntType(32))
            own = everywhere(four, _SUMS)
            both = zip(before, columns, strict=True)
            after.append([builder.call(unit, [total, own, weight]) for total, weight in both])
        following = builder.add(step, ir.Constant(index, 1))
        builder.cbranch(builder.icmp_signed("<", following, given[4]), loop, end)
        nothing = ir.Constant(_SUMS, [0] * LANES)
        for value, further in zip(sum(sums, [step]), sum(after, [following]), strict=True):
            value.add_incoming(ir.Constant(index, 0) if value is step else nothing, entry)
            value.add_incoming(further, loop)
        builder.position_at_end(end)
        fast = dict(flags=("contract",))
        for k in range(_VECTORS):
            scale, total, bias = (loaded(place(8, given[9], n * COLUMNS + k * LANES), _FLOATS) for n in range(3))
            for r in range(ROWS):
                size = everywhere(builder.load(place(5, given[7], r)), _FLOATS)
                low = everywhere(builder.load(place(6, given[7], r)), _FLOATS)
                value = builder.fmul(builder.sitofp(after[r][k], _FLOATS), builder.fmul(size, scale, **fast), **fast)
                value = builder.fadd(value, builder.fadd(builder.fmul(low, total, **fast), bias, **fast), **fast)
                line = builder.add(given[11], builder.mul(given[12], ir.Constant(index, r)))
                where = place(10, line, k * LANES)
                builder.store(value if single else rounded(value), builder.bitcast(where, kept.as_pointer()), align=2)
        return target.get_dummy_value()

    flat = types.intp
    return types.void(
        rows, flat, weights, flat, flat, scales, offsets, flat, layer, flat, out, flat, flat
    ), generate  # fmt: skip


@compiled
def multiply(rows: Array, scale: Array, offset: Array, weights: Array, layer: Array, out: Array) -> None:
    """Fill ``out (E, D)`` with a linear layer of rows of bytes.

    Args:
        rows, scale, offset: ``(F / ROWS, C / 4, ROWS)``, ``(F,)``, ``(F,)`` of :func:`quantise`; F is E or more.
        weights: ``(D / COLUMNS, C / 4, COLUMNS, 4)`` int8.
        layer: ``(D / COLUMNS, 3, COLUMNS)`` float32: scale of the weights, sum of the weights, bias.
        out: of float32, or bits of bfloat16.
    """
    panels, steps = weights.shape[:2]
    levels, numbers, outputs = rows.reshape(-1).view(np.uint8), weights.reshape(-1), out.shape[1]
    flat, of_layer = out.reshape(-1), layer.reshape(-1)
    spare = np.empty(ROWS * COLUMNS, out.dtype)
    for e in range(0, len(out), ROWS):
        for p in range(panels):
            inside = e + ROWS <= len(out) and (p + 1) * COLUMNS <= outputs
            to, at, stride = (flat, e * outputs + p * COLUMNS, outputs) if inside else (spare, 0, COLUMNS)
            _multiply(  # type: ignore[call-arg]
                levels, 4 * e * steps, numbers, 4 * p * steps * COLUMNS, steps, scale, offset, e,
                of_layer, 3 * p * COLUMNS, to, at, stride,
            )  # fmt: skip
            if not inside:
                for r in range(min(ROWS, len(out) - e)):
                    for c in range(min(COLUMNS, outputs - p * COLUMNS)):
                        out[e + r, p * COLUMNS + c] = spare[r * COLUMNS + c]
