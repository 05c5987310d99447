"""Kernel of :class:`dvo.nets.correlation.edge_correlation.EdgeCorrelation`.

Nearly all of its time goes into dot products of a patch feature with the pixels of a row of a window. The compiler
would sum each of them across the lanes of a vector on its own, which costs as much as the products;
:func:`_eight_products` states in vector instructions how eight of them are summed at once.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from dvo.core.compiled import compiled, part

_WIDTH = 8
_VECTOR = ir.VectorType(ir.FloatType(), _WIDTH)
# Lanes of two vectors, side by side, whose sums are those of pairs of lanes, for each of three foldings.
_FOLDINGS = (
    ((0, 8, 2, 10, 4, 12, 6, 14), (1, 9, 3, 11, 5, 13, 7, 15)),
    ((0, 1, 8, 9, 4, 5, 12, 13), (2, 3, 10, 11, 6, 7, 14, 15)),
    ((0, 1, 2, 3, 8, 9, 10, 11), (4, 5, 6, 7, 12, 13, 14, 15)),
)


@intrinsic
def _eight_products(context, maps, first, feature, out, position):
    """Store at ``position`` of ``out`` the dot products of a feature with eight pixels from ``first`` of flat maps.

    All arrays are contiguous and of float32; the channels are a multiple of eight.
    """

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        def array(k: int) -> Any:
            return cgutils.create_struct_proxy(signature.args[k])(target, builder, value=given[k])

        def vector(pointer: Any) -> Any:
            return builder.bitcast(pointer, _VECTOR.as_pointer())

        channels = builder.extract_value(array(2).shape, 0)
        start = builder.gep(array(0).data, [given[1]])
        entry, loop, end = builder.block, builder.append_basic_block(), builder.append_basic_block()
        builder.branch(loop)

        builder.position_at_end(loop)
        channel, sums = builder.phi(channels.type), [builder.phi(_VECTOR) for _ in range(_WIDTH)]
        feature_part = builder.load(vector(builder.gep(array(2).data, [channel])), align=4)
        pixel, after = builder.gep(start, [channel]), []
        for before in sums:
            product = builder.fmul(feature_part, builder.load(vector(pixel), align=4), flags=("contract",))
            after.append(builder.fadd(before, product, flags=("contract",)))
            pixel = builder.gep(pixel, [channels])
        following = builder.add(channel, ir.Constant(channels.type, _WIDTH))
        builder.cbranch(builder.icmp_signed("<", following, channels), loop, end)
        for value, zero, further in zip(
            [channel, *sums], [0] + [[0.0] * _WIDTH] * _WIDTH, [following, *after], strict=True
        ):
            value.add_incoming(ir.Constant(value.type, zero), entry)
            value.add_incoming(further, loop)

        builder.position_at_end(end)
        for folding in _FOLDINGS:
            one, other = (ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), list(lanes)) for lanes in folding)
            after = [
                builder.fadd(builder.shuffle_vector(a, b, one), builder.shuffle_vector(a, b, other))
                for a, b in zip(after[::2], after[1::2], strict=True)
            ]
        builder.store(after[0], vector(builder.gep(array(3).data, [given[4]])), align=4)
        return target.get_dummy_value()

    return types.void(maps, types.intp, feature, out, types.intp), generate


@part
def _products(maps, first, stride, feature, out):
    """Dot products of a feature with a window of pixels, from index ``first`` of flat maps with rows of ``stride``."""
    channels, taps = len(feature), len(out)
    if channels % _WIDTH == 0 and taps % _WIDTH == 0:
        flat = out.reshape(-1)
        for row in range(taps):
            for left in range(0, taps, _WIDTH):
                at = first + row * stride + left * channels
                _eight_products(maps, at, feature, flat, row * taps + left)  # type: ignore[call-arg]
        return
    for row in range(taps):
        for column in range(taps):
            pixel = maps[first + row * stride + column * channels :]
            total = np.float32(0)
            for k in range(channels):
                total += feature[k] * pixel[k]
            out[row, column] = total


@compiled
def correlate(maps, features, at, kk, frames, radius, out):
    """Fill ``out (E, q, 2r+1, 2r+1)``; the other arguments are those of the twin, maps and features contiguous."""
    taps = 2 * radius + 2
    _, height, width, channels = maps.shape
    flat = maps.reshape(-1)
    products = np.empty((taps, taps), np.float32)
    for edge in range(len(at)):
        for pixel in range(at.shape[1]):
            x, y = at[edge, pixel, 0] - np.float32(radius), at[edge, pixel, 1] - np.float32(radius)
            if math.isnan(x) or math.isnan(y):
                for i in range(taps - 1):
                    for j in range(taps - 1):
                        out[edge, pixel, i, j] = math.nan
                continue
            x = min(max(x, np.float32(-taps)), np.float32(width - 2 * taps))
            y = min(max(y, np.float32(-taps)), np.float32(height - 2 * taps))
            left, top = math.floor(x), math.floor(y)
            fx, fy = x - np.float32(left), y - np.float32(top)
            first = ((frames[edge] * height + top + taps) * width + left + taps) * channels
            _products(flat, first, width * channels, features[kk[edge], pixel], products)
            for i in range(taps - 1):
                for j in range(taps - 1):
                    u = products[i, j] + fy * (products[i + 1, j] - products[i, j])
                    v = products[i, j + 1] + fy * (products[i + 1, j + 1] - products[i, j + 1])
                    out[edge, pixel, i, j] = u + fx * (v - u)
