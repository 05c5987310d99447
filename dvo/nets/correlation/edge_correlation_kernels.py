"""Kernels of :class:`dvo.nets.correlation.edge_correlation.EdgeCorrelation`, and the adjoint.

Nearly all of its time goes into dot products of a patch feature with the pixels of a row of a window. The compiler
would sum each of them across the lanes of a vector on its own, which costs as much as the products;
:func:`_eight_products` states in vector instructions how eight of them are summed at once, and :func:`_eight_adjoints`
how a row of eight is taken back.

Maps of bfloat16 are for matrix units of a CPU (Intel's AMX), which multiply tiles: 16 rows of 32 numbers by 32 rows of
16, with sums in float32. A tile of the map is 16 pixels of a row, as it lies in memory; the other one holds the
features of all pixels of a patch, in pairs of channels. So all pixels of a patch take their products with a window from
two instructions a row.
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

_WIDTH = 8
_CHANNELS = 64  # of the features of the default network
_VECTOR = ir.VectorType(ir.FloatType(), _WIDTH)
# Lanes of two vectors, side by side, whose sums are those of pairs of lanes, for each of three foldings.
_FOLDINGS = (
    ((0, 8, 2, 10, 4, 12, 6, 14), (1, 9, 3, 11, 5, 13, 7, 15)),
    ((0, 1, 8, 9, 4, 5, 12, 13), (2, 3, 10, 11, 6, 7, 14, 15)),
    ((0, 1, 2, 3, 8, 9, 10, 11), (4, 5, 6, 7, 12, 13, 14, 15)),
)
_SIDE, _DEPTH = 16, 32  # pixels of a map and of a patch in a tile, and channels
_BYTE, _INDEX = ir.IntType(8), ir.IntType(64)
_SUMS, _MAP, _PATCH = 0, 1, 2  # tiles
_NAN = 0x7FC0  # bits
_TAPS = 7  # a side of the channels of a pixel, of the default radius


@intrinsic(prefer_literal=True)
def _eight_products(context, maps, first, feature, channels, out, position):
    """Store at ``position`` of ``out`` the dot products of a feature with eight pixels from ``first`` of flat maps.

    All arrays are contiguous and of float32; the channels are a multiple of eight. If their number is a literal, the
    addresses of the pixels are constants.
    """
    known = channels.literal_value if isinstance(channels, types.IntegerLiteral) else None

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        def array(k: int) -> Any:
            return cgutils.create_struct_proxy(signature.args[k])(target, builder, value=given[k])

        def vector(pointer: Any) -> Any:
            return builder.bitcast(pointer, _VECTOR.as_pointer())

        channels = given[3] if known is None else ir.Constant(given[1].type, known)
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
        builder.store(after[0], vector(builder.gep(array(4).data, [given[5]])), align=4)
        return target.get_dummy_value()

    return types.void(maps, types.intp, feature, types.intp if known is None else channels, out, types.intp), generate


@intrinsic
def _eight_adjoints(context, maps, first, d_maps, feature, d_feature, weights, position):
    """Take eight products back, of which ``weights`` holds the gradients from ``position``.

    ``d_maps`` receives those of the eight pixels from ``first``, ``d_feature`` that of the feature. Maps and
    weights are flat; all arrays are contiguous and of float32; the channels are a multiple of eight.
    """

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        def array(k: int) -> Any:
            return cgutils.create_struct_proxy(signature.args[k])(target, builder, value=given[k])

        def vector(pointer: Any) -> Any:
            return builder.bitcast(pointer, _VECTOR.as_pointer())

        def plus(before: Any, a: Any, b: Any) -> Any:
            return builder.fadd(before, builder.fmul(a, b, flags=("contract",)), flags=("contract",))

        channels = builder.extract_value(array(3).shape, 0)
        start, d_start = (builder.gep(array(k).data, [given[1]]) for k in (0, 2))
        own = builder.load(vector(builder.gep(array(5).data, [given[6]])), align=4)
        lanes = ir.VectorType(ir.IntType(32), _WIDTH)
        each = [builder.shuffle_vector(own, own, ir.Constant(lanes, [k] * _WIDTH)) for k in range(_WIDTH)]
        entry, loop, end = builder.block, builder.append_basic_block(), builder.append_basic_block()
        builder.branch(loop)

        builder.position_at_end(loop)
        channel = builder.phi(channels.type)
        feature_part = builder.load(vector(builder.gep(array(3).data, [channel])), align=4)
        d_feature_at = vector(builder.gep(array(4).data, [channel]))
        total = builder.load(d_feature_at, align=4)
        pixel, d_pixel = builder.gep(start, [channel]), builder.gep(d_start, [channel])
        for weight in each:
            total = plus(total, weight, builder.load(vector(pixel), align=4))
            sums = plus(builder.load(vector(d_pixel), align=4), weight, feature_part)
            builder.store(sums, vector(d_pixel), align=4)
            pixel, d_pixel = builder.gep(pixel, [channels]), builder.gep(d_pixel, [channels])
        builder.store(total, d_feature_at, align=4)
        following = builder.add(channel, ir.Constant(channels.type, _WIDTH))
        builder.cbranch(builder.icmp_signed("<", following, channels), loop, end)
        channel.add_incoming(ir.Constant(channels.type, 0), entry)
        channel.add_incoming(following, loop)

        builder.position_at_end(end)
        return target.get_dummy_value()

    return types.void(maps, types.intp, d_maps, feature, d_feature, weights, types.intp), generate


@part
def _products(maps, first, stride, feature, out):
    """Dot products of a feature with a window of pixels, from index ``first`` of flat maps with rows of ``stride``."""
    channels, taps = len(feature), len(out)
    if channels % _WIDTH == 0 and taps % _WIDTH == 0:
        flat = out.reshape(-1)
        for row in range(taps):
            for left in range(0, taps, _WIDTH):
                at = first + row * stride + left * channels
                if channels == _CHANNELS:
                    _eight_products(maps, at, feature, _CHANNELS, flat, row * taps + left)  # type: ignore[call-arg]
                else:
                    _eight_products(maps, at, feature, channels, flat, row * taps + left)  # type: ignore[call-arg]
        return
    for row in range(taps):
        for column in range(taps):
            pixel = maps[first + row * stride + column * channels :]
            total = np.float32(0)
            for k in range(channels):
                total += feature[k] * pixel[k]
            out[row, column] = total


@part
def _adjoint_of_products(maps, d_maps, first, stride, feature, d_feature, weights):
    """Take :func:`_products` back, of which ``weights`` are the gradients: add to those of the maps and the feature."""
    channels, taps = len(feature), len(weights)
    if channels % _WIDTH == 0 and taps % _WIDTH == 0:
        flat = weights.reshape(-1)
        for row in range(taps):
            for left in range(0, taps, _WIDTH):
                at = first + row * stride + left * channels
                _eight_adjoints(maps, at, d_maps, feature, d_feature, flat, row * taps + left)  # type: ignore[call-arg]
        return
    for row in range(taps):
        for column in range(taps):
            weight, at = weights[row, column], first + row * stride + column * channels
            for k in range(channels):
                d_feature[k] += weight * maps[at + k]
                d_maps[at + k] += weight * feature[k]


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
def _blend(products, fx, fy, out):
    """Bilinear blend of a window of products."""
    for i in range(len(out)):
        for j in range(len(out)):
            u = products[i, j] + fy * (products[i + 1, j] - products[i, j])
            v = products[i, j + 1] + fy * (products[i + 1, j + 1] - products[i, j + 1])
            out[i, j] = u + fx * (v - u)


@part
def _take_back_blend(grad, fx, fy, weights):
    """Fill the gradients of a window of products from that of their blend."""
    for i in range(len(weights)):
        for j in range(len(weights)):
            weights[i, j] = 0
    for i in range(len(weights) - 1):
        for j in range(len(weights) - 1):
            right = fx * grad[i, j]
            here = grad[i, j] - right
            weights[i, j] += here - fy * here
            weights[i, j + 1] += right - fy * right
            weights[i + 1, j] += fy * here
            weights[i + 1, j + 1] += fy * right


@part
def _by_frame(frames, count):
    """Edges in the order of their frames, so that a map is read from a near cache."""
    begins = np.zeros(count + 1, np.intp)
    for frame in frames:
        begins[frame + 1] += 1
    for frame in range(count):
        begins[frame + 1] += begins[frame]
    order = np.empty(len(frames), np.intp)
    for edge in range(len(frames)):
        order[begins[frames[edge]]] = edge
        begins[frames[edge]] += 1
    return order


@compiled
def correlate(maps, features, at, kk, frames, radius, out):
    """Fill ``out (E, q, 2r+1, 2r+1)``; the other arguments are those of the twin, maps and features contiguous."""
    taps = 2 * radius + 2
    _, height, width, channels = maps.shape
    flat = maps.reshape(-1)
    products = np.empty((taps, taps), np.float32)
    for edge in _by_frame(frames, len(maps)):
        for pixel in range(at.shape[1]):
            x, y = at[edge, pixel, 0], at[edge, pixel, 1]
            if math.isnan(x) or math.isnan(y):
                for i in range(taps - 1):
                    for j in range(taps - 1):
                        out[edge, pixel, i, j] = math.nan
                continue
            left, top, fx, fy = _corner(x, y, radius, height, width)
            first = ((frames[edge] * height + top) * width + left) * channels
            _products(flat, first, width * channels, features[kk[edge], pixel], products)
            _blend(products, fx, fy, out[edge, pixel])


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

        line = ir.Constant(_INDEX, 4 * _SIDE)
        _unit(builder, "tilezero", [_tile(_SUMS)])
        with cgutils.for_range(builder, builder.udiv(given[4], ir.Constant(_INDEX, _DEPTH))) as loop:
            across, along = (builder.mul(loop.index, ir.Constant(_INDEX, k)) for k in (_DEPTH, _DEPTH // 2 * _SIDE))
            pixels = at(0, builder.add(given[1], across))
            _unit(builder, "tileloadd64", [_tile(_MAP), pixels, bytes_of(given[4], 2)])
            _unit(builder, "tileloadd64", [_tile(_PATCH), at(2, builder.add(given[3], along)), line])
            _unit(builder, "tdpbf16ps", [_tile(_SUMS), _tile(_MAP), _tile(_PATCH)])
        _unit(builder, "tilestored64", [_tile(_SUMS), at(5, given[6]), line])
        return target.get_dummy_value()

    return types.void(maps, types.intp, tiles, types.intp, types.intp, products, types.intp), generate


def _vector(builder: Any, address: Any, element: Any) -> Any:
    return builder.bitcast(address, ir.VectorType(element, _SIDE).as_pointer())


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
        value = builder.bitcast(moved, ir.VectorType(whole, _SIDE))

        def constant(number: int) -> Any:
            return ir.Constant(value.type, [number] * _SIDE)

        odd = builder.and_(builder.lshr(value, constant(16)), constant(1))
        nearest = builder.lshr(builder.add(builder.add(value, constant(0x7FFF)), odd), constant(16))
        place = _address(target, builder, signature.args[4], given[4], given[1])
        builder.store(builder.trunc(nearest, ir.VectorType(half, _SIDE)), _vector(builder, place, half), align=2)
        return target.get_dummy_value()

    return types.void(products, types.intp, types.intp, shares, bits), generate


@part
def _tiles(features):
    """Features ``(K, q, C / 2)``, pairs of channels, as tiles ``(K, C / 32, 16 pairs, 16 pixels)``."""
    patches, pixels, pairs = features.shape
    tiles = np.zeros((patches, pairs, _SIDE), np.uint32)
    for k in range(patches):
        for pixel in range(pixels):
            for pair in range(pairs):
                tiles[k, pair, pixel] = features[k, pixel, pair]
    return tiles.reshape(-1)


@part
def _blend_tiles(products, rows, columns, fx, fy, bits):
    """Blend products ``(rows, 16, 16 pixels of a patch)`` bilinearly with those to the right and below."""
    for row in range(rows):
        for column in range(columns - 1):
            k = (row * _SIDE + column) * _SIDE
            _move(products, k, _SIDE, fx)  # type: ignore[call-arg]
            if row > 0:
                _move_to(products, k - _SIDE * _SIDE, _SIDE * _SIDE, fy, bits)


@part
def _take(bits, first, side, out):
    """Copy the blended products of a pixel of a patch, which begin at ``first``."""
    for i in range(side):
        for j in range(side):
            out[i, j] = bits[first + (i * _SIDE + j) * _SIDE]


@compiled
def correlate_bfloat16(maps, features, at, kk, frames, radius, out):
    """Fill ``out (E, q, 2r+1, 2r+1)``, bits of bfloat16 as uint16; for CPUs with matrix units alone.

    The other arguments are those of :func:`correlate`, but for ``maps``, which are bits, have at least 16 columns and a
    multiple of 32 channels, ``features (K, q, C / 2)`` of at most 16 pixels as the bits of two channels in a uint32,
    and a radius of at most 3.
    """
    side, taps = 2 * radius + 1, 2 * radius + 2
    _, height, width, channels = maps.shape
    pixels = at.shape[1]
    flat, tiles = maps.reshape(-1), _tiles(features)
    shapes = np.zeros(64, np.uint8)
    shapes[0] = 1
    for tile in range(3):
        shapes[16 + 2 * tile], shapes[48 + tile] = 4 * _SIDE, _SIDE
    lefts, tops = np.empty(pixels, np.intp), np.empty(pixels, np.intp)
    fx, fy = np.zeros(_SIDE, np.float32), np.zeros(_SIDE, np.float32)
    products = np.empty(2 * _SIDE * _SIDE * _SIDE, np.float32)
    bits = np.empty(len(products), np.uint16)
    _configure(shapes)  # type: ignore[call-arg]
    for edge in _by_frame(frames, len(maps)):
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
        begin, second = frames[edge] * height * width * channels, kk[edge] * _SIDE * channels // 2
        # Pixels too far from each other are looked up one by one.
        together = last_left - first_left <= _SIDE - taps and last_top - first_top <= 2 * _SIDE - taps
        for turn in range(1 if together else pixels):
            if not together:
                first_left, first_top, last_left, last_top = lefts[turn], tops[turn], lefts[turn], tops[turn]
            if first_left < 0 or first_left > last_left:
                continue
            column, rows = min(first_left, width - _SIDE), last_top - first_top + taps
            for row in range(rows):
                where = begin + ((first_top + row) * width + column) * channels
                _row_of_products(flat, where, tiles, second, channels, products, row * _SIDE * _SIDE)
            _blend_tiles(products, rows, last_left - column + taps, fx, fy, bits)
            for pixel in range(0 if together else turn, pixels if together else turn + 1):
                if lefts[pixel] >= 0:
                    start = ((tops[pixel] - first_top) * _SIDE + lefts[pixel] - column) * _SIDE + pixel
                    if side == _TAPS:  # a constant is faster
                        _take(bits, start, _TAPS, out[edge, pixel])
                    else:
                        _take(bits, start, side, out[edge, pixel])
    _release()


@compiled
def correlate_adjoint(maps, features, at, kk, frames, radius, edges, grad, d_maps, d_features):
    """Add the gradients of :func:`correlate` by maps and features, in the order of ``edges``.

    ``edges (L,)`` are those that propagate one; ``grad (E, q, 2r+1, 2r+1)`` is that of ``out``. A position that is not
    a number leaves NaN.
    """
    taps = 2 * radius + 2
    _, height, width, channels = maps.shape
    flat, d_flat = maps.reshape(-1), d_maps.reshape(-1)
    weights = np.empty((taps, taps), np.float32)
    for edge in edges:
        k = kk[edge]
        for pixel in range(at.shape[1]):
            x, y = at[edge, pixel, 0], at[edge, pixel, 1]
            if math.isnan(x) or math.isnan(y):
                d_features[k, pixel, 0] = math.nan
                d_maps[frames[edge], taps, taps, 0] = math.nan
                continue
            left, top, fx, fy = _corner(x, y, radius, height, width)
            _take_back_blend(grad[edge, pixel], fx, fy, weights)
            first = ((frames[edge] * height + top) * width + left) * channels
            _adjoint_of_products(
                flat, d_flat, first, width * channels, features[k, pixel], d_features[k, pixel], weights
            )


@compiled
def look_up(volume, start, at, height, width, radius, out):
    """Fill ``out (E, q, 2r+1, 2r+1)`` from slices of a volume, flat, that begin at ``start (E, q)``."""
    taps = 2 * radius + 2
    products = np.empty((taps, taps), np.float32)
    for edge in range(len(at)):
        for pixel in range(at.shape[1]):
            x, y, first = at[edge, pixel, 0], at[edge, pixel, 1], start[edge, pixel]
            if math.isnan(x) or math.isnan(y):
                for i in range(taps - 1):
                    for j in range(taps - 1):
                        out[edge, pixel, i, j] = math.nan
                continue
            left, top, fx, fy = _corner(x, y, radius, height + 2 * taps, width + 2 * taps)
            for i in range(taps):
                row = top - taps + i
                for j in range(taps):
                    column = left - taps + j
                    inside = 0 <= row < height and 0 <= column < width
                    products[i, j] = volume[first + row * width + column] if inside else 0
            _blend(products, fx, fy, out[edge, pixel])


@compiled
def look_up_adjoint(start, at, height, width, radius, edges, grad, d_volume):
    """Add the gradient of :func:`look_up` by the volume; see :func:`correlate_adjoint`."""
    taps = 2 * radius + 2
    weights = np.empty((taps, taps), np.float32)
    for edge in edges:
        for pixel in range(at.shape[1]):
            x, y, first = at[edge, pixel, 0], at[edge, pixel, 1], start[edge, pixel]
            if math.isnan(x) or math.isnan(y):
                d_volume[first] = math.nan
                continue
            left, top, fx, fy = _corner(x, y, radius, height + 2 * taps, width + 2 * taps)
            _take_back_blend(grad[edge, pixel], fx, fy, weights)
            for i in range(max(0, taps - top), min(taps, height + taps - top)):
                for j in range(max(0, taps - left), min(taps, width + taps - left)):
                    d_volume[first + (top - taps + i) * width + left - taps + j] += weights[i, j]
