"""Kernel of :class:`dvo.nets.correlation.edge_correlation.EdgeCorrelation` by matrix units of the CPU (Intel's AMX).

These units multiply tiles: 16 rows of 32 numbers of bfloat16 by 32 rows of 16, with sums in float32. A tile of the map
is 16 pixels of a row, as it lies in memory; the other one holds the features of all pixels of a patch, in pairs of
channels. So all pixels of a patch take their products with a window from two instructions a row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from dvo.core.compiled import compiled, part

SIDE, DEPTH = 16, 32  # pixels of a map and of a patch in a tile, and channels
_BYTE, _INDEX = ir.IntType(8), ir.IntType(64)
_SUMS, _MAP, _PATCH = 0, 1, 2  # tiles
_NAN = 0x7FC0  # bits
_TAPS = 7  # a side of the channels of a pixel, of the default radius


def _unit(builder: Any, name: str, arguments: Sequence[Any]) -> None:
    """Call an instruction of the matrix units."""
    kind = ir.FunctionType(ir.VoidType(), [argument.type for argument in arguments])
    builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.x86.{name}"), arguments)


def _tile(number: int) -> Any:
    return ir.Constant(_BYTE, number)


def _address(target: Any, builder: Any, kind: Any, array: Any, first: Any) -> Any:
    data = cgutils.create_struct_proxy(kind)(target, builder, value=array).data
    return builder.bitcast(builder.gep(data, [first]), _BYTE.as_pointer())


@intrinsic
def _configure(context, shapes):
    """Set the shapes of the tiles, 64 bytes."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        _unit(builder, "ldtilecfg", [_address(target, builder, signature.args[0], given[0], ir.Constant(_INDEX, 0))])
        return target.get_dummy_value()

    return types.void(shapes), generate


@intrinsic
def _release(context):
    """Give the units back."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        _unit(builder, "tilerelease", [])
        return target.get_dummy_value()

    return types.void(), generate


@intrinsic
def _row_of_products(context, maps, first, tiles, second, channels, products, row):
    """Fill ``(16, 16)`` of ``products`` from ``row`` on: 16 pixels of flat maps from ``first``, by pixels of a patch.

    ``tiles`` holds the features of patches, from ``second``. All arrays are contiguous.
    """

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        def at(array: int, first: Any) -> Any:
            return _address(target, builder, signature.args[array], given[array], first)

        def bytes_of(count: Any, size: int) -> Any:
            return builder.mul(count, ir.Constant(_INDEX, size))

        line = ir.Constant(_INDEX, 4 * SIDE)
        _unit(builder, "tilezero", [_tile(_SUMS)])
        with cgutils.for_range(builder, builder.udiv(given[4], ir.Constant(_INDEX, DEPTH))) as loop:
            across, along = (builder.mul(loop.index, ir.Constant(_INDEX, k)) for k in (DEPTH, DEPTH // 2 * SIDE))
            pixels = at(0, builder.add(given[1], across))
            _unit(builder, "tileloadd64", [_tile(_MAP), pixels, bytes_of(given[4], 2)])
            _unit(builder, "tileloadd64", [_tile(_PATCH), at(2, builder.add(given[3], along)), line])
            _unit(builder, "tdpbf16ps", [_tile(_SUMS), _tile(_MAP), _tile(_PATCH)])
        _unit(builder, "tilestored64", [_tile(_SUMS), at(5, given[6]), line])
        return target.get_dummy_value()

    return types.void(maps, types.intp, tiles, types.intp, types.intp, products, types.intp), generate


def _vector(builder: Any, address: Any, element: Any) -> Any:
    return builder.bitcast(address, ir.VectorType(element, SIDE).as_pointer())


def _moved(target: Any, builder: Any, signature: Any, given: Any) -> Any:
    """Products of 16 pixels at the second argument, moved to those a step beyond by their shares."""
    single = ir.FloatType()

    def at(array: int, first: Any) -> Any:
        return _vector(builder, _address(target, builder, signature.args[array], given[array], first), single)

    here = builder.load(at(0, given[1]), align=4)
    beyond = builder.load(at(0, builder.add(given[1], given[2])), align=4)
    shares = builder.load(at(3, ir.Constant(_INDEX, 0)), align=4)
    return builder.fadd(
        here, builder.fmul(shares, builder.fsub(beyond, here), flags=("contract",)), flags=("contract",)
    )


@intrinsic
def _move(context, products, first, step, shares):
    """Replace 16 products, of a pixel of a patch each, by their blend with those a step beyond."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        moved = _moved(target, builder, signature, given)
        place = _address(target, builder, signature.args[0], given[0], given[1])
        builder.store(moved, _vector(builder, place, ir.FloatType()), align=4)
        return target.get_dummy_value()

    return types.void(products, types.intp, types.intp, shares), generate


@intrinsic
def _move_to(context, products, first, step, shares, bits):
    """Blend 16 products as :func:`_move`, and store them as bfloat16 at the same place of ``bits``."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        moved = _moved(target, builder, signature, given)
        whole, half = ir.IntType(32), ir.IntType(16)
        value = builder.bitcast(moved, ir.VectorType(whole, SIDE))

        def constant(number: int) -> Any:
            return ir.Constant(value.type, [number] * SIDE)

        odd = builder.and_(builder.lshr(value, constant(16)), constant(1))
        nearest = builder.lshr(builder.add(builder.add(value, constant(0x7FFF)), odd), constant(16))
        place = _address(target, builder, signature.args[4], given[4], given[1])
        builder.store(builder.trunc(nearest, ir.VectorType(half, SIDE)), _vector(builder, place, half), align=2)
        return target.get_dummy_value()

    return types.void(products, types.intp, types.intp, shares, bits), generate


@part
def _tiles(features):
    """Features ``(K, q, C / 2)``, pairs of channels, as tiles ``(K, C / 32, 16 pairs, 16 pixels)``."""
    patches, pixels, pairs = features.shape
    tiles = np.zeros((patches, pairs, SIDE), np.uint32)
    for k in range(patches):
        for pixel in range(pixels):
            for pair in range(pairs):
                tiles[k, pair, pixel] = features[k, pixel, pair]
    return tiles.reshape(-1)


@part
def _corner(x, y, radius, height, width):
    """Left and top of a window, one beyond the border for one far out, and the fractions."""
    taps = 2 * radius + 2
    x, y = x - np.float32(radius), y - np.float32(radius)
    x = min(max(x, np.float32(-taps)), np.float32(width - 2 * taps))
    y = min(max(y, np.float32(-taps)), np.float32(height - 2 * taps))
    left, top = math.floor(x), math.floor(y)
    return left + taps, top + taps, x - np.float32(left), y - np.float32(top)


@part
def _blend(products, rows, columns, fx, fy, bits):
    """Blend products ``(rows, 16, 16 pixels of a patch)`` bilinearly with those to the right and below."""
    for row in range(rows):
        for column in range(columns - 1):
            k = (row * SIDE + column) * SIDE
            _move(products, k, SIDE, fx)  # type: ignore[call-arg]
            if row > 0:
                _move_to(products, k - SIDE * SIDE, SIDE * SIDE, fy, bits)


@part
def _take(bits, first, side, out):
    """Copy the blended products of a pixel of a patch, which begin at ``first``."""
    for i in range(side):
        for j in range(side):
            out[i, j] = bits[first + (i * SIDE + j) * SIDE]


@compiled
def correlate(maps, features, at, kk, order, frames, radius, out):
    """Fill ``out (E, q, 2r+1, 2r+1)``, bits of bfloat16 as uint16.

    The other arguments are those of the twin: ``maps (N, H, W, C)`` as bits, with at least 16 columns and a multiple of
    32 channels, ``features (K, q, C / 2)`` of at most 16 pixels as the bits of two channels in a uint32, and the radius
    at most 3. ``order (E,)`` is that of the edges: those into a frame after each other read its map from a near cache.
    """
    side, taps = 2 * radius + 1, 2 * radius + 2
    _, height, width, channels = maps.shape
    pixels = at.shape[1]
    flat, tiles = maps.reshape(-1), _tiles(features)
    shapes = np.zeros(64, np.uint8)
    shapes[0] = 1
    for tile in range(3):
        shapes[16 + 2 * tile], shapes[48 + tile] = 4 * SIDE, SIDE
    lefts, tops = np.empty(pixels, np.intp), np.empty(pixels, np.intp)
    fx, fy = np.zeros(SIDE, np.float32), np.zeros(SIDE, np.float32)
    products = np.empty(2 * SIDE * SIDE * SIDE, np.float32)
    bits = np.empty(len(products), np.uint16)
    _configure(shapes)  # type: ignore[call-arg]
    for edge in order:
        first_left, last_left, first_top, last_top = width, 0, height, 0
        for pixel in range(pixels):
            x, y = at[edge, pixel, 0], at[edge, pixel, 1]
            if math.isnan(x) or math.isnan(y):
                lefts[pixel] = -1
                out[edge, pixel] = _NAN
                continue
            lefts[pixel], tops[pixel], fx[pixel], fy[pixel] = _corner(x, y, radius, height, width)
            first_left, last_left = min(first_left, lefts[pixel]), max(last_left, lefts[pixel])
            first_top, last_top = min(first_top, tops[pixel]), max(last_top, tops[pixel])
        begin, second = frames[edge] * height * width * channels, kk[edge] * SIDE * channels // 2
        # Pixels too far from each other are looked up one by one.
        together = last_left - first_left <= SIDE - taps and last_top - first_top <= 2 * SIDE - taps
        for turn in range(1 if together else pixels):
            if not together:
                first_left, first_top, last_left, last_top = lefts[turn], tops[turn], lefts[turn], tops[turn]
            if first_left < 0 or first_left > last_left:
                continue
            column, rows = min(first_left, width - SIDE), last_top - first_top + taps
            for row in range(rows):
                where = begin + ((first_top + row) * width + column) * channels
                _row_of_products(flat, where, tiles, second, channels, products, row * SIDE * SIDE)
            _blend(products, rows, last_left - column + taps, fx, fy, bits)
            for pixel in range(0 if together else turn, pixels if together else turn + 1):
                if lefts[pixel] >= 0:
                    start = ((tops[pixel] - first_top) * SIDE + lefts[pixel] - column) * SIDE + pixel
                    if side == _TAPS:  # a constant is faster
                        _take(bits, start, _TAPS, out[edge, pixel])
                    else:
                        _take(bits, start, side, out[edge, pixel])
    _release()
