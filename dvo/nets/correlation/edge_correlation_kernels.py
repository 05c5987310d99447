"""Kernels of :class:`dvo.nets.correlation.edge_correlation.EdgeCorrelation`, and the adjoint.

Nearly all of its time goes into dot products of a patch feature with the pixels of a row of a window. The compiler
would sum each of them across the lanes of a vector on its own, which costs as much as the products;
:func:`_eight_products` states in vector instructions how eight of them are summed at once, and :func:`_eight_adjoints`
how a row of eight is taken back.

Maps of bfloat16 are for CPUs that multiply it (AVX-512 BF16): an instruction adds 16 products to eight sums of float32
(one of twice as many takes twice as long on Zen 4, and has more to sum in the end). Maps of bytes are for those that
multiply these (VNNI): it adds 32 products to eight sums of whole numbers.
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
from dvo.core.number_kernels import number, stored

_WIDTH = 8
_CHANNELS = 64  # of the features of the default network
_PAIRED = 16  # products of an instruction for bfloat16
BYTES = 32
"""Products of an instruction for bytes, of which the channels are a multiple."""
_VECTOR, _WHOLE = (ir.VectorType(kind, _WIDTH) for kind in (ir.FloatType(), ir.IntType(32)))
# Lanes of two vectors, side by side, whose sums are those of pairs of lanes, for each of three foldings.
_FOLDINGS = (
    ((0, 8, 2, 10, 4, 12, 6, 14), (1, 9, 3, 11, 5, 13, 7, 15)),
    ((0, 1, 8, 9, 4, 5, 12, 13), (2, 3, 10, 11, 6, 7, 14, 15)),
    ((0, 1, 2, 3, 8, 9, 10, 11), (4, 5, 6, 7, 12, 13, 14, 15)),
)


class _BFloat(ir.HalfType):  # llvmlite has none
    def __str__(self) -> str:
        return "bfloat"


_BFLOATS, _BFLOATS_KEPT = (ir.VectorType(object.__new__(_BFloat), size) for size in (_PAIRED, _WIDTH))


def _added(builder: Any, sums: list[Any], added: Any, known: int | None, channels: Any, step: int) -> list[Any]:
    """Sums after ``added(sums, channel)`` for every channel that is a multiple of a step, in a loop unless it is known
    how many there are."""
    index = channels.type
    if known is not None:
        for channel in range(0, known, step):
            sums = added(sums, ir.Constant(index, channel))
        return sums
    entry, loop, end = builder.block, builder.append_basic_block(), builder.append_basic_block()
    builder.branch(loop)
    builder.position_at_end(loop)
    channel, before = builder.phi(index), [builder.phi(value.type) for value in sums]
    after = added(before, channel)
    following = builder.add(channel, ir.Constant(index, step))
    builder.cbranch(builder.icmp_signed("<", following, channels), loop, end)
    begun = [ir.Constant(index, 0), *sums]
    for value, first, further in zip([channel, *before], begun, [following, *after], strict=True):
        value.add_incoming(first, entry)
        value.add_incoming(further, loop)
    builder.position_at_end(end)
    return after


def _folded(builder: Any, sums: list[Any], add: Any) -> Any:
    """Vector of the sums across the lanes of eight vectors."""
    for folding in _FOLDINGS:
        lanes = [ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), list(order)) for order in folding]
        pairs = zip(sums[::2], sums[1::2], strict=True)
        sums = [add(*(builder.shuffle_vector(a, b, order) for order in lanes)) for a, b in pairs]
    return sums[0]


@intrinsic(prefer_literal=True)
def _eight_products(context, maps, first, feature, channels, out, position):
    """Store at ``position`` of ``out`` the dot products of a feature with eight pixels from ``first`` of flat maps.

    All arrays are contiguous and of float32; the channels are a multiple of eight. Or maps and feature are bits of
    bfloat16, as uint16, and the channels a multiple of 16. If their number is a literal, the addresses of the pixels
    are constants.
    """
    known = channels.literal_value if isinstance(channels, types.IntegerLiteral) else None
    single = maps.dtype == types.float32
    read = _VECTOR if single else _BFLOATS

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        def array(k: int) -> Any:
            return cgutils.create_struct_proxy(signature.args[k])(target, builder, value=given[k])

        def loaded(pointer: Any) -> Any:
            return builder.load(builder.bitcast(pointer, read.as_pointer()), align=4 if single else 2)

        def plus(before: Any, a: Any, b: Any) -> Any:
            if single:
                return builder.fadd(before, builder.fmul(a, b, flags=("contract",)), flags=("contract",))
            kind = ir.FunctionType(_VECTOR, [_VECTOR, read, read])
            unit = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512bf16.dpbf16ps.256")
            return builder.call(unit, [before, a, b])

        channels = given[3] if known is None else ir.Constant(given[1].type, known)
        start = builder.gep(array(0).data, [given[1]])
        nothing = [ir.Constant(_VECTOR, [0.0] * _WIDTH)] * _WIDTH

        def added(sums: Any, channel: Any) -> Any:
            feature_part = loaded(builder.gep(array(2).data, [channel]))
            pixel, after = builder.gep(start, [channel]), []
            for before in sums:
                after.append(plus(before, feature_part, loaded(pixel)))
                pixel = builder.gep(pixel, [channels])
            return after

        after = _added(builder, nothing, added, known, channels, read.count)
        place = builder.gep(array(4).data, [given[5]])
        builder.store(_folded(builder, after, builder.fadd), builder.bitcast(place, _VECTOR.as_pointer()), align=4)
        return target.get_dummy_value()

    return types.void(maps, types.intp, feature, types.intp if known is None else channels, out, types.intp), generate


@intrinsic(prefer_literal=True)
def _eight_byte_products(context, maps, first, feature, channels, scales, pixel, factor, total, out, position):
    """Store at ``position`` of ``out`` the dot products of a feature with eight pixels from ``first`` of flat maps.

    Args:
        maps: uint8, numbers above 128.
        feature: int8, ``(C,)``.
        scales: flat, of the pixels, from ``pixel``.
        factor: scale of the feature.
        total: 128 times the sum of the feature.
    """
    known = channels.literal_value if isinstance(channels, types.IntegerLiteral) else None

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        def array(k: int) -> Any:
            return cgutils.create_struct_proxy(signature.args[k])(target, builder, value=given[k])

        def loaded(pointer: Any) -> Any:
            return builder.load(builder.bitcast(pointer, _WHOLE.as_pointer()), align=1)

        def everywhere(value: Any) -> Any:
            kind = ir.VectorType(value.type, _WIDTH)
            first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
            return builder.shuffle_vector(first, first, ir.Constant(_WHOLE, [0] * _WIDTH))

        kind = ir.FunctionType(_WHOLE, [_WHOLE] * 3)
        unit = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512.vpdpbusd.256")
        index = given[1].type
        channels = given[3] if known is None else ir.Constant(index, known)
        start, nothing = builder.gep(array(0).data, [given[1]]), [ir.Constant(_WHOLE, [0] * _WIDTH)] * _WIDTH

        def added(sums: Any, channel: Any) -> Any:
            own, place, after = loaded(builder.gep(array(2).data, [channel])), builder.gep(start, [channel]), []
            for before in sums:
                after.append(builder.call(unit, [before, loaded(place), own]))
                place = builder.gep(place, [channels])
            return after

        after = _added(builder, nothing, added, known, channels, BYTES)
        whole = builder.sub(_folded(builder, after, builder.add), everywhere(given[7]))
        beside = builder.load(builder.bitcast(builder.gep(array(4).data, [given[5]]), _VECTOR.as_pointer()), align=4)
        found = builder.fmul(builder.sitofp(whole, _VECTOR), builder.fmul(beside, everywhere(given[6])))
        place = builder.gep(array(8).data, [given[9]])
        builder.store(found, builder.bitcast(place, _VECTOR.as_pointer()), align=4)
        return target.get_dummy_value()

    number, at = types.float32, types.intp
    of_channels = at if known is None else channels
    return types.void(maps, at, feature, of_channels, scales, at, number, types.int32, out, at), generate


@intrinsic
def _fetch(context, flat, position):
    """Ask for the cache line with an element of a flat array, which is read soon."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        array = cgutils.create_struct_proxy(signature.args[0])(target, builder, value=given[0])
        byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
        fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        place = builder.bitcast(builder.gep(array.data, [given[1]]), byte)
        builder.call(fetch, [place, *(ir.Constant(flag, value) for value in (0, 3, 1))])  # to read, near, data
        return target.get_dummy_value()

    return types.void(flat, types.intp), generate


@intrinsic
def _blend_eight(context, products, fx, fy, out, position):
    """Store at ``position`` of flat ``out`` the 7 x 7 bilinear blends of 8 x 8 flat products of float32.

    ``out`` is of float32, or holds bits of bfloat16.
    """
    single = out.dtype == types.float32
    kept = _VECTOR if single else _BFLOATS_KEPT

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        def vector(k: int, place: Any, kind: Any) -> Any:
            array = cgutils.create_struct_proxy(signature.args[k])(target, builder, value=given[k])
            return builder.bitcast(builder.gep(array.data, [place]), kind.as_pointer())

        def rounded(row: Any) -> Any:
            kind = ir.FunctionType(kept, [_VECTOR])
            unit = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512bf16.cvtneps2bf16.256")
            return builder.call(unit, [row])

        def shuffled(a: Any, b: Any, lanes: Any) -> Any:
            return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), lanes))

        def everywhere(value: Any) -> Any:
            first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
            return shuffled(first, first, [0] * _WIDTH)

        def between(a: Any, b: Any, share: Any) -> Any:
            step = builder.fmul(share, builder.fsub(b, a), flags=("contract",))
            return builder.fadd(a, step, flags=("contract",))

        def place(at: int) -> Any:
            return ir.Constant(given[4].type, at)

        fx, fy = everywhere(given[1]), everywhere(given[2])
        rows = [builder.load(vector(0, place(_WIDTH * i), _VECTOR), align=4) for i in range(_WIDTH)]
        before = None
        for i in range(_WIDTH - 1):
            across = between(rows[i], rows[i + 1], fy)
            row = between(across, shuffled(across, across, [1, 2, 3, 4, 5, 6, 7, 7]), fx)
            at = builder.add(given[4], place((_WIDTH - 1) * i))
            if i == _WIDTH - 2:  # the last lane of a row is overwritten by the next, and this has none
                row, at = shuffled(before, row, [6, 8, 9, 10, 11, 12, 13, 14]), builder.sub(at, place(1))
            builder.store(row if single else rounded(row), vector(3, at, kept), align=4 if single else 2)
            before = row
        return target.get_dummy_value()

    return types.void(products, types.float32, types.float32, out, types.intp), generate


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
def _products(maps, first, stride, feature, step, out):
    """Dot products of a feature with a window of pixels, from index ``first`` of flat maps with rows of ``stride``.

    ``step`` is the number of channels that are multiplied at once.
    """
    channels, taps = len(feature), len(out)
    if channels % step == 0 and taps % _WIDTH == 0:
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
                total += number(feature[k]) * number(pixel[k])  # type: ignore[call-arg]
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
            out[i, j] = stored(u + fx * (v - u), out[i, j])  # type: ignore[call-arg]


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


@part
def _singles(maps, scales, first, width, feature, numbers, out):
    channels = len(feature)
    _products(maps, first * channels, width * channels, feature, _WIDTH, out)


@part
def _halves(maps, scales, first, width, feature, numbers, out):
    channels = len(feature)
    _products(maps, first * channels, width * channels, feature, _PAIRED, out)


@part
def _bytes(maps, scales, first, width, feature, numbers, out):
    flat, total, channels = out.reshape(-1), np.int32(numbers[1]), len(feature)
    for row in range(_WIDTH):
        at, to = first + row * width, row * _WIDTH
        if channels == _CHANNELS:
            _eight_byte_products(maps, at * _CHANNELS, feature, _CHANNELS, scales, at, numbers[0], total, flat, to)  # type: ignore[call-arg]
        else:
            _eight_byte_products(maps, at * channels, feature, channels, scales, at, numbers[0], total, flat, to)  # type: ignore[call-arg]


@part
def _correlate(maps, scales, features, numbers, at, kk, frames, radius, products_of, out):
    """Body of all kernels; see :func:`correlate_bytes` for scales and numbers, which others pass over."""
    taps = 2 * radius + 2
    _, height, width, channels = maps.shape
    flat, flat_scales, flat_out = maps.reshape(-1), scales.reshape(-1), out.reshape(-1)
    products = np.empty((taps, taps), np.float32)
    flat_products = products.reshape(-1)
    order, line = _by_frame(frames, len(maps)), 64 // maps.itemsize
    for place, edge in enumerate(order):
        # Windows of the next edge are asked for row by row meanwhile.
        following = order[min(place + 1, len(order) - 1)]
        x, y, ahead = at[following, 0, 0], at[following, 0, 1], -1
        if not (math.isnan(x) or math.isnan(y)):
            left, top, _, _ = _corner(x, y, radius, height, width)
            ahead = ((frames[following] * height + top) * width + left) * channels
        for pixel in range(at.shape[1]):
            if ahead >= 0:
                for near in range(0, (taps + 2) * channels, line):
                    _fetch(flat, min(ahead + pixel * width * channels + near, flat.size - 1))  # type: ignore[call-arg]
            x, y = at[edge, pixel, 0], at[edge, pixel, 1]
            if math.isnan(x) or math.isnan(y):
                for i in range(taps - 1):
                    for j in range(taps - 1):
                        out[edge, pixel, i, j] = stored(np.float32(np.nan), out[edge, pixel, i, j])  # type: ignore[call-arg]
                continue
            left, top, fx, fy = _corner(x, y, radius, height, width)
            first, k = (frames[edge] * height + top) * width + left, kk[edge]
            products_of(flat, flat_scales, first, width, features[k, pixel], numbers[k, pixel], products)
            if taps == _WIDTH:
                begin = (edge * at.shape[1] + pixel) * (taps - 1) * (taps - 1)
                _blend_eight(flat_products, fx, fy, flat_out, begin)  # type: ignore[call-arg]
            else:
                _blend(products, fx, fy, out[edge, pixel])


@compiled
def correlate(maps, features, at, kk, frames, radius, out):
    """Fill ``out (E, q, 2r+1, 2r+1)``; the other arguments are those of the twin; all but positions are contiguous."""
    _correlate(maps, at, features, features, at, kk, frames, radius, _singles, out)


@compiled
def correlate_bfloat16(maps, features, at, kk, frames, radius, out):
    """:func:`correlate` where maps, features and ``out`` are bits of bfloat16, as uint16, for CPUs that multiply it."""
    _correlate(maps, at, features, features, at, kk, frames, radius, _halves, out)


@compiled
def correlate_bytes(maps, scales, features, numbers, at, kk, frames, radius, out):
    """:func:`correlate` of whole numbers with scales, for CPUs that multiply bytes.

    Args:
        maps: ``(N, H, W, C)`` uint8, numbers above 128; C is a multiple of :data:`BYTES`.
        scales: ``(N, H, W)`` float32, of the pixels.
        features: ``(K, q, C)`` int8.
        numbers: ``(K, q, 2)`` float32: scale, and 128 times the sum of the channels.
        radius: 3.
        out: of float32, or bits of bfloat16.
    """
    _correlate(maps, scales, features, numbers, at, kk, frames, radius, _bytes, out)


@compiled
def round_pixels(level, above, out, scales, totals):
    """Round the channels of each pixel to whole numbers of -127 to 127 and a scale.

    Args:
        level: ``(C, h, w)`` float32.
        above: what is added to the numbers.
        out: ``(h, w, C)`` uint8; with nothing added, bits of int8.
        scales: ``(h, w)``; NaN where a channel is not finite.
        totals: ``(h, w)``, 128 times the sums of the numbers.
    """
    channels, height, width = level.shape
    values = np.empty((width, channels), np.float32)
    bits = values.view(np.int32)
    bound, shift = np.empty(1, np.int32), np.int32(above - 127)
    largest = bound.view(np.float32)
    for y in range(height):
        for c in range(channels):
            for x in range(width):
                values[x, c] = level[c, y, x]
        for x in range(width):
            most = np.int32(0)
            for c in range(channels):
                value = np.int32(bits[x, c] & np.int32(0x7FFFFFFF))
                most = value if value > most else most
            bound[0] = most
            size = largest[0]
            if not size < np.float32(np.inf):
                scales[y, x], totals[y, x] = np.nan, 0
                for c in range(channels):
                    out[y, x, c] = np.uint8(above)
                continue
            factor = np.float32(127) / size if size > np.float32(1e-28) else np.float32(0)
            scales[y, x] = size / np.float32(127)
            total = np.int32(0)
            for c in range(channels):
                whole = np.int32(values[x, c] * factor + np.float32(127.5))
                total += whole
                out[y, x, c] = np.uint8(np.int32(whole + shift))
            totals[y, x] = np.float32(128) * np.float32(total - 127 * channels)


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
