"""Kernels of :class:`dvo.nets.correlation.edge_correlation.EdgeCorrelation`, and the adjoint.

Nearly all of its time goes into dot products of a patch feature with the pixels of a row of a window. The compiler
would sum each of them across the lanes of a vector on its own, which costs as much as the products;
:func:`_window_products` states in vector instructions how eight of them are summed at once, and :func:`_eight_adjoints`
how a row of eight is taken back.

Maps of bfloat16 are for CPUs that multiply it (AVX-512 BF16): an instruction adds 16 products to eight sums of float32
(one of twice as many takes twice as long on Zen 4, and has more to sum in the end). Maps of bytes are for those that
multiply these (VNNI): it adds four products of a pixel to each of eight sums of whole numbers, which are those of
eight pixels, and nothing is left to sum.
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
from dvo.core.vectors import Vectors

_WIDTH = 8
_CHANNELS = 64  # of the features of the default network
_PAIRED = 16  # products of an instruction for bfloat16
BYTES = 4
"""Channels that an instruction for bytes multiplies in each of eight pixels."""
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


@intrinsic(prefer_literal=True)
def _window_products(
    context, maps, first, line, features, own, channels, scales, pixel, width, factor, total, out
):  # fmt: skip
    """Fill flat ``out`` with the dot products of a feature with a window of 8 x 8 pixels of flat maps.

    Args:
        maps: of float32 or bits of bfloat16 (uint16), pixel by pixel. Or uint8, numbers above 128: four channels of a
            row of pixels, then the next four.
        first: index at which the window begins; the next row is ``line`` farther.
        features: flat, of float32, bits of bfloat16, or int8; the feature begins at ``own``. If the number of its
            channels is a literal, the addresses of pixels are constants.
        scales: flat, of the pixels, from ``pixel``; rows are ``width`` apart. For whole numbers, as are the next two.
        factor, total: scale of the feature, and 128 times its sum.
    """
    known = channels.literal_value if isinstance(channels, types.IntegerLiteral) else None
    kind = {types.float32: _VECTOR, types.uint16: _BFLOATS, types.uint8: _WHOLE}[maps.dtype]

    def generate(*generating: Any) -> Any:
        vectors, (_, first, line, _, own, channels, _, pixel, width, factor, total, _) = (
            Vectors(_WIDTH, *generating), generating[3])  # fmt: skip
        builder, count = vectors.builder, known or channels
        start, feature = vectors.place(0, first), vectors.place(3, own)
        align = 4 if maps.dtype == types.float32 else 1

        def plus(before: Any, a: Any, b: Any) -> Any:
            if kind == _VECTOR:
                return vectors.plus(before, a, b)
            name = "avx512.vpdpbusd.256" if kind == _WHOLE else "avx512bf16.dpbf16ps.256"
            return vectors.call(f"llvm.x86.{name}", before.type, before, a, b)

        def of_pixels(row: Any) -> None:
            """Eight sums, each of products of one pixel."""
            begin = vectors.after(start, builder.mul(row, line))
            size = ir.Constant(vectors.index, known) if known else channels

            def added(channel: Any, sums: list[Any]) -> list[Any]:
                part, pixel = vectors.raw(vectors.after(feature, channel), kind, align), vectors.after(begin, channel)
                after = []
                for before in sums:
                    after.append(plus(before, part, vectors.raw(pixel, kind, align)))
                    pixel = vectors.after(pixel, size)
                return after

            after = vectors.repeat(count, [vectors.constant(0.0)] * _WIDTH, added, kind.count)
            for folding in _FOLDINGS:
                pairs = zip(after[::2], after[1::2], strict=True)
                after = [builder.fadd(*(vectors.shuffled(a, b, lanes) for lanes in folding)) for a, b in pairs]
            vectors.store(after[0], vectors.place(11, builder.mul(row, ir.Constant(vectors.index, _WIDTH))))

        def of_rows() -> None:
            """Sums of each row, whose lanes are those of its pixels."""

            def added(channel: Any, sums: list[Any]) -> list[Any]:
                four = vectors.everywhere(vectors.raw(vectors.after(feature, channel), ir.IntType(32)))
                pixels, after = vectors.after(start, builder.mul(channel, width)), []
                for before in sums:
                    after.append(plus(before, vectors.raw(pixels, kind, align), four))
                    pixels = vectors.after(pixels, line)
                return after

            sums = vectors.repeat(count, [vectors.constant(0)] * _WIDTH, added, BYTES)
            most, scale, beside = vectors.everywhere(total), vectors.everywhere(factor), vectors.place(6, pixel)
            for row, value in enumerate(sums):
                whole = builder.sitofp(builder.sub(value, most), _VECTOR)
                scaled = builder.fmul(whole, builder.fmul(vectors.load(beside), scale))
                vectors.store(scaled, vectors.place(11, _WIDTH * row))
                beside = vectors.after(beside, width)

        if kind == _WHOLE:
            of_rows()
        else:
            with cgutils.for_range(builder, ir.Constant(vectors.index, _WIDTH)) as loop:
                of_pixels(loop.index)
        return vectors.target.get_dummy_value()

    at, number = types.intp, types.float32
    of_channels = at if known is None else channels
    return types.void(
        maps, at, at, features, at, of_channels, scales, at, at, number, types.int32, out
    ), generate  # fmt: skip


@intrinsic
def _fetch(context, flat, position):
    """Ask for the cache line with an element of a flat array, which is read soon."""

    def generate(*generating: Any) -> Any:
        vectors, (_, position) = Vectors(1, *generating), generating[3]
        byte, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
        place = vectors.builder.bitcast(vectors.place(0, position), byte)
        how = (ir.Constant(flag, value) for value in (0, 3, 1))  # to read, near, data
        vectors.call("llvm.prefetch.p0", ir.VoidType(), place, *how)
        return vectors.target.get_dummy_value()

    return types.void(flat, types.intp), generate


@intrinsic
def _blend_eight(context, products, fx, fy, out, position):
    """Store at ``position`` of flat ``out`` the 7 x 7 bilinear blends of 8 x 8 flat products of float32.

    ``out`` is of float32, or holds bits of bfloat16.
    """
    single = out.dtype == types.float32

    def generate(*generating: Any) -> Any:
        vectors, (_, fx, fy, _, position) = Vectors(_WIDTH, *generating), generating[3]
        builder, shuffled = vectors.builder, vectors.shuffled

        def between(a: Any, b: Any, share: Any) -> Any:
            return vectors.plus(a, share, builder.fsub(b, a))

        def stored(row: Any, place: Any) -> None:
            if single:
                vectors.store(row, place)
                return
            half = vectors.call("llvm.x86.avx512bf16.cvtneps2bf16.256", _BFLOATS_KEPT, row)
            builder.store(half, builder.bitcast(place, _BFLOATS_KEPT.as_pointer()), align=2)

        fx, fy = vectors.everywhere(fx), vectors.everywhere(fy)
        rows = [vectors.load(vectors.place(0, _WIDTH * i)) for i in range(_WIDTH)]
        before = None
        for i in range(_WIDTH - 1):
            across = between(rows[i], rows[i + 1], fy)
            row, at = between(across, shuffled(across, across, [1, 2, 3, 4, 5, 6, 7, 7]), fx), (_WIDTH - 1) * i
            if i == _WIDTH - 2:  # the last lane of a row is overwritten by the next, and this has none
                row, at = shuffled(before, row, [6, 8, 9, 10, 11, 12, 13, 14]), at - 1
            stored(row, vectors.place(3, position, at))
            before = row
        return vectors.target.get_dummy_value()

    return types.void(products, types.float32, types.float32, out, types.intp), generate


@intrinsic
def _eight_adjoints(context, maps, first, d_maps, feature, d_feature, channels, weights, position):
    """Take eight products back, of which ``weights`` holds the gradients from ``position``.

    ``d_maps`` receives those of the eight pixels from ``first``, ``d_feature`` that of the feature. Maps and
    weights are flat; all arrays are contiguous and of float32; the number of channels is a multiple of eight.
    """

    def generate(*generating: Any) -> Any:
        vectors, (_, first, _, _, _, channels, _, position) = Vectors(_WIDTH, *generating), generating[3]
        plus = vectors.plus
        start, d_start = vectors.place(0, first), vectors.place(2, first)
        own = vectors.load(vectors.place(6, position))
        each = [vectors.shuffled(own, own, [k] * _WIDTH) for k in range(_WIDTH)]

        def taken_back(channel: Any, none: list[Any]) -> list[Any]:
            part, d_feature_at = vectors.load(vectors.place(3, channel)), vectors.place(4, channel)
            total = vectors.load(d_feature_at)
            pixel, d_pixel = vectors.after(start, channel), vectors.after(d_start, channel)
            for weight in each:
                total = plus(total, weight, vectors.load(pixel))
                vectors.store(plus(vectors.load(d_pixel), weight, part), d_pixel)
                pixel, d_pixel = vectors.after(pixel, channels), vectors.after(d_pixel, channels)
            vectors.store(total, d_feature_at)
            return none

        vectors.repeat(channels, [], taken_back, _WIDTH)
        return vectors.target.get_dummy_value()

    at = types.intp
    return types.void(maps, at, d_maps, feature, d_feature, at, weights, at), generate


@part
def _products(maps, first, stride, feature, out):
    """Dot products of a feature with a window of pixels, from index ``first`` of flat maps with rows of ``stride``."""
    channels, taps = len(feature), len(out)
    for row in range(taps):
        for column in range(taps):
            at = first + row * stride + column * channels
            total = np.float32(0)
            for k in range(channels):
                total += number(feature[k]) * number(maps[at + k])  # type: ignore[call-arg]
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
                own = row * taps + left
                _eight_adjoints(maps, at, d_maps, feature, d_feature, channels, flat, own)  # type: ignore[call-arg]
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
    left, top = np.int64(x), np.int64(y)  # towards zero; a floor is a call
    left, top = left - (x < left), top - (y < top)
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
def _correlate(maps, size, step, scales, features, numbers, at, kk, frames, radius, out):
    """Body of all kernels; see :func:`correlate_bytes` for scales and numbers, which others pass over.

    Nothing is sliced for a window: that would count references, which takes as long as its products.
    """
    taps, pixels, channels = 2 * radius + 2, features.shape[1], features.shape[2]
    height, width = size
    flat, flat_scales, flat_out = maps.reshape(-1), scales.reshape(-1), out.reshape(-1)
    flat_features, flat_numbers = features.reshape(-1), numbers.reshape(-1)
    products = np.empty((taps, taps), np.float32)
    flat_products, order = products.reshape(-1), _by_frame(frames, len(maps))
    # Distance of pixels, and of what is asked for ahead in a row.
    by_pixel, reach, jump = channels, (taps + 2) * channels, 64 // maps.itemsize
    if maps.ndim == 5:
        by_pixel, reach, jump = BYTES, width * channels, BYTES * width
    for place, edge in enumerate(order):
        # Windows of the next edge are asked for row by row meanwhile.
        following = order[min(place + 1, len(order) - 1)]
        x, y, ahead = at[following, 0, 0], at[following, 0, 1], -1
        if not (math.isnan(x) or math.isnan(y)):
            left, top, _, _ = _corner(x, y, radius, height, width)
            ahead = (frames[following] * height + top) * width * channels + left * by_pixel
        for pixel in range(pixels):
            if ahead >= 0:
                for near in range(0, reach, jump):
                    _fetch(flat, min(ahead + pixel * width * channels + near, flat.size - 1))  # type: ignore[call-arg]
            x, y, to = at[edge, pixel, 0], at[edge, pixel, 1], (edge * pixels + pixel) * (taps - 1) * (taps - 1)
            if math.isnan(x) or math.isnan(y):
                for k in range((taps - 1) * (taps - 1)):
                    flat_out[to + k] = stored(np.float32(np.nan), flat_out[to + k])  # type: ignore[call-arg]
                continue
            left, top, fx, fy = _corner(x, y, radius, height, width)
            line, k = frames[edge] * height + top, kk[edge] * pixels + pixel
            first, stride, own = line * width * channels + left * by_pixel, width * channels, k * channels
            if taps != _WIDTH or channels % step:
                _products(flat, first, stride, features[kk[edge], pixel], products)
            elif channels == _CHANNELS and maps.ndim == 4:
                _window_products(  # type: ignore[call-arg]
                    flat, first, stride, flat_features, own, _CHANNELS, flat_scales, line * width + left, width,
                    flat_numbers[2 * k], np.int32(flat_numbers[2 * k + 1]), flat_products,
                )  # fmt: skip
            else:
                _window_products(  # type: ignore[call-arg]
                    flat, first, stride, flat_features, own, channels, flat_scales, line * width + left, width,
                    flat_numbers[2 * k], np.int32(flat_numbers[2 * k + 1]), flat_products,
                )  # fmt: skip
            if taps == _WIDTH:
                _blend_eight(flat_products, fx, fy, flat_out, to)  # type: ignore[call-arg]
            else:
                _blend(products, fx, fy, out[edge, pixel])


@compiled
def correlate(maps, features, at, kk, frames, radius, out):
    """Fill ``out (E, q, 2r+1, 2r+1)``; the other arguments are those of the twin; all but positions are contiguous."""
    none = np.zeros(2 * features.shape[0] * features.shape[1], np.float32)
    _correlate(maps, maps.shape[1:3], _WIDTH, none, features, none, at, kk, frames, radius, out)


@compiled
def correlate_bfloat16(maps, features, at, kk, frames, radius, out):
    """:func:`correlate` where maps, features and ``out`` are bits of bfloat16, as uint16, for CPUs that multiply it."""
    none = np.zeros(2 * features.shape[0] * features.shape[1], np.float32)
    _correlate(maps, maps.shape[1:3], _PAIRED, none, features, none, at, kk, frames, radius, out)


@compiled
def correlate_bytes(maps, scales, features, numbers, at, kk, frames, radius, out):
    """:func:`correlate` of whole numbers with scales, for CPUs that multiply bytes.

    Args:
        maps: ``(N, H, C / 4, W, 4)`` uint8, numbers above 128.
        scales: ``(N, H, W)`` float32, of the pixels.
        features: ``(K, q, C)`` int8.
        numbers: ``(K, q, 2)`` float32: scale, and 128 times the sum of the channels.
        radius: 3.
        out: of float32, or bits of bfloat16.
    """
    size = maps.shape[1], maps.shape[3]
    _correlate(maps, size, BYTES, scales, features, numbers, at, kk, frames, radius, out)


@compiled
def round_pixels(level, above, out, scales, totals):
    """Round the channels of each pixel to whole numbers of -127 to 127 and a scale.

    Args:
        level: ``(C, h, w)`` float32.
        above: what is added to the numbers.
        out: ``(h, C / 4, w, 4)`` uint8; with nothing added, bits of int8.
        scales: ``(h, w)``; NaN where a channel is not finite.
        totals: ``(h, w)``, 128 times the sums of the numbers.
    """
    channels, height, width = level.shape
    values = np.empty((width, channels), np.float32)
    bits = values.view(np.int32)
    bound, shift, levels = np.empty(1, np.int32), np.int32(above - 127), np.empty(channels, np.uint8)
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
                    out[y, c // BYTES, x, c % BYTES] = np.uint8(above)
                continue
            factor = np.float32(127) / size if size > np.float32(1e-28) else np.float32(0)
            scales[y, x] = size / np.float32(127)
            total = np.int32(0)
            for c in range(channels):
                whole = np.int32(values[x, c] * factor + np.float32(127.5))
                total += whole
                levels[c] = np.uint8(np.int32(whole + shift))
            for c in range(0, channels, BYTES):
                for k in range(BYTES):
                    out[y, c // BYTES, x, k] = levels[c + k]
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
