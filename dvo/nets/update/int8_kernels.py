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
from dvo.core.vectors import CONTRACT, Vectors

Array = Any

LANES = 16 if llvmlite.binding.get_host_cpu_features().get("avx512vnni") else 8
"""Sums of 32 bits in a vector of this machine."""
_VECTORS = 4 if LANES == 16 else 2
COLUMNS = _VECTORS * LANES
"""Outputs that are computed at once."""
ROWS = 6
"""Inputs likewise: so many sums stay in registers."""
_LEAST = np.float32(1e-30)  # distance of the bounds of a row, below which it is taken as one value


@part
def _copy(x, floor, row):
    for c in range(len(row)):
        row[c] = number(x[c])  # type: ignore[call-arg]
        row[c] = floor if row[c] < floor else row[c]


@intrinsic
def _fill_bounds(context, row, steps, out):
    """Fill ``out (2,)`` with the least and the largest number of some vectors; NaN is beyond the infinite numbers."""

    def generate(*generating: Any) -> Any:
        vectors, (_, count, _) = Vectors(LANES, *generating), generating[3]
        builder = vectors.builder

        def in_order(bits: Any) -> Any:
            """Whole numbers, in the order of the numbers of float32 that have these bits; and the other way round."""
            sign, rest = (ir.Constant(bits.type, k) for k in (31, 0x7FFFFFFF))
            if bits.type == vectors.whole:
                sign, rest = vectors.constant(31), vectors.constant(0x7FFFFFFF)
            return builder.xor(bits, builder.and_(builder.ashr(bits, sign), rest))

        def loaded(step: Any) -> Any:
            place = vectors.place(0, builder.mul(step, ir.Constant(step.type, LANES)))
            return in_order(builder.bitcast(vectors.load(place), vectors.whole))

        def bounded(step: Any, bounds: list[Any]) -> list[Any]:
            pairs, value = zip(("<", ">"), bounds, strict=True), loaded(step)
            return [builder.select(builder.icmp_signed(order, value, bound), value, bound) for order, bound in pairs]

        first = loaded(ir.Constant(count.type, 0))
        found = zip(("smin", "smax"), vectors.repeat(count, [first] * 2, bounded), strict=True)
        for k, (name, bound) in enumerate(found):
            kind = ir.FunctionType(ir.IntType(32), [vectors.whole])
            least = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.{name}.v{LANES}i32")
            bits = in_order(builder.call(least, [bound]))
            builder.store(builder.bitcast(bits, ir.FloatType()), vectors.place(2, k))
        return vectors.target.get_dummy_value()

    return types.void(row, types.intp, out), generate


@intrinsic
def _fill_levels(context, row, steps, low, factor, out, to):
    """Fill flat ``out`` from ``to`` with ``round((row - low) * factor)``, of 0 to 255, of some vectors."""

    def generate(*generating: Any) -> Any:
        vectors, (_, count, low, factor, _, to) = Vectors(LANES, *generating), generating[3]
        builder, half = vectors.builder, vectors.constant(0.5)
        low, factor = vectors.everywhere(low), vectors.everywhere(factor)

        def rounded(step: Any, nothing: list[Any]) -> list[Any]:
            at = builder.mul(step, ir.Constant(step.type, LANES))
            scaled = builder.fmul(builder.fsub(vectors.load(vectors.place(0, at)), low), factor, **CONTRACT)
            level = builder.fptosi(builder.fadd(scaled, half, **CONTRACT), vectors.whole)
            vectors.store(level, vectors.place(4, to, at))
            return nothing

        vectors.repeat(count, [], rounded)
        return vectors.target.get_dummy_value()

    return types.void(row, types.intp, types.float32, types.float32, out, types.intp), generate


@compiled
def quantise(x: Array, further: Array, rectified: bool, out: Array, scale: Array, offset: Array) -> None:
    """Fill ``out (E, C)`` with ``round((x - offset) / scale)``, of 0 to 255 for the bounds of a row.

    A row is that of ``x (E, A)`` followed by that of ``further (E, B)``, perhaps rectified, and by anything up to C, a
    multiple of :data:`LANES`. A row with a number that is not finite gets a scale of NaN.
    """
    count, size = x.shape[1], out.shape[1]
    channels, steps = count + further.shape[1], size // LANES
    row, bounds, flat = np.empty(size, np.float32), np.empty(2, np.float32), out.reshape(-1)
    floor = np.float32(0) if rectified else np.float32(-np.inf)
    for e in range(len(x)):
        _copy(x[e], floor, row[:count])
        _copy(further[e], floor, row[count:channels])
        row[channels:] = row[0]
        _fill_bounds(row, steps, bounds)  # type: ignore[call-arg]
        low, height = bounds[0], bounds[1] - bounds[0]
        if not height < np.float32(np.inf):
            scale[e], offset[e] = np.nan, 0
            out[e] = 0
            continue
        factor = np.float32(255) / height if height > _LEAST else np.float32(0)
        scale[e], offset[e] = height / np.float32(255), low
        _fill_levels(row, steps, low, factor, flat, e * size)


@intrinsic
def _multiply(context, rows, first, size, weights, panel, steps, scales, offsets, at, layer, column, out, to, stride):
    """Products of some rows of bytes with a panel of weights, scaled, into flat ``out`` from ``to``.

    Args:
        rows: flat uint8; those of a product begin at ``first``, and are ``size`` apart.
        weights: flat int8; the panel begins at ``panel`` and has ``steps`` times four bytes of each column.
        scales, offsets: of the rows, from ``at``.
        layer: flat float32: scale, sum and bias of the columns from ``column``, 3 x COLUMNS.
        out: flat, of float32 or bits of bfloat16; rows are ``stride`` apart.
    """

    def generate(*generating: Any) -> Any:
        vectors, given = Vectors(LANES, *generating), generating[3]
        builder, index, kind = vectors.builder, vectors.index, vectors.whole
        unit = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind] * 3), f"llvm.x86.avx512.vpdpbusd.{32 * LANES}"
        )
        start = vectors.place(3, given[4])
        inputs = [vectors.place(0, given[1], builder.mul(given[2], ir.Constant(index, r))) for r in range(ROWS)]

        def added(step: Any, before: list[Any]) -> list[Any]:
            four = builder.mul(step, ir.Constant(index, 4))
            panel = vectors.after(start, builder.mul(step, ir.Constant(index, 4 * COLUMNS)))
            columns = [vectors.raw(vectors.after(panel, 4 * LANES * k), kind) for k in range(_VECTORS)]
            after: list[Any] = []
            for r, row in enumerate(inputs):
                own = vectors.everywhere(vectors.raw(vectors.after(row, four), ir.IntType(32)))
                both = zip(before[r * _VECTORS :], columns, strict=False)
                after.extend(builder.call(unit, [total, own, weight]) for total, weight in both)
            return after

        sums = vectors.repeat(given[5], [vectors.constant(0)] * (ROWS * _VECTORS), added)
        for k in range(_VECTORS):
            places = (vectors.place(9, given[10], n * COLUMNS + k * LANES) for n in range(3))
            scale, total, bias = (vectors.load(place) for place in places)
            for r in range(ROWS):
                size, low = (vectors.everywhere(builder.load(vectors.place(n, given[8], r))) for n in (6, 7))
                value = builder.sitofp(sums[r * _VECTORS + k], vectors.floats)
                value = builder.fmul(value, builder.fmul(size, scale, **CONTRACT), **CONTRACT)
                rest = vectors.plus(bias, low, total)
                line = builder.add(given[12], builder.mul(given[13], ir.Constant(index, r)))
                vectors.store(builder.fadd(value, rest, **CONTRACT), vectors.place(11, line, k * LANES))
        return vectors.target.get_dummy_value()

    flat = types.intp
    return types.void(
        rows, flat, flat, weights, flat, flat, scales, offsets, flat, layer, flat, out, flat, flat
    ), generate  # fmt: skip


@compiled
def multiply(rows: Array, scale: Array, offset: Array, weights: Array, layer: Array, out: Array) -> None:
    """Fill ``out (E, D)`` with a linear layer of rows of bytes.

    Args:
        rows, scale, offset: ``(F, C)`` uint8, ``(F,)``, ``(F,)`` of :func:`quantise`; F is E up to a multiple of ROWS.
        weights: ``(D / COLUMNS, C / 4, COLUMNS, 4)`` int8.
        layer: ``(D / COLUMNS, 3, COLUMNS)`` float32: scale of the weights, sum of the weights, bias.
        out: of float32, or bits of bfloat16.
    """
    panels, steps = weights.shape[:2]
    levels, numbers, outputs, size = rows.reshape(-1), weights.reshape(-1), out.shape[1], rows.shape[1]
    flat, of_layer = out.reshape(-1), layer.reshape(-1)
    spare = np.empty(ROWS * COLUMNS, out.dtype)
    for e in range(0, len(out), ROWS):
        for p in range(panels):
            inside = e + ROWS <= len(out) and (p + 1) * COLUMNS <= outputs
            to, at, stride = (flat, e * outputs + p * COLUMNS, outputs) if inside else (spare, 0, COLUMNS)
            _multiply(  # type: ignore[call-arg]
                levels, e * size, size, numbers, 4 * p * steps * COLUMNS, steps, scale, offset, e,
                of_layer, 3 * p * COLUMNS, to, at, stride,
            )  # fmt: skip
            if not inside:
                for r in range(min(ROWS, len(out) - e)):
                    for c in range(min(COLUMNS, outputs - p * COLUMNS)):
                        out[e + r, p * COLUMNS + c] = spare[r * COLUMNS + c]
