"""Kernels of :func:`dvo.nets.patch.encoder.normalise`.

The compiler would keep the sum of each channel in memory, and every pixel wait for the one before it; so vector
instructions are stated that sum several runs of pixels beside each other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from dvo.core.compiled import compiled, part
from dvo.core.vectors import CONTRACT, Vectors

Array = Any

LANES = 8
"""Channels that are computed at once."""
_RUN = 64  # pixels whose sum is in single precision; sums of these are in double precision
_BESIDE = 4  # runs that are summed beside each other


@intrinsic(prefer_literal=True)
def _add_runs(context, x, first, pixels, channels, mean, channel, squares, runs, out):
    """Fill ``out`` with sums over literally ``runs`` runs of pixels, of some channels of flat ``x``.

    Args:
        first: index at which the runs begin.
        pixels: of a run.
        channels: elements from a pixel to the next.
        mean: flat, of the channels, from ``channel``; is subtracted.
        squares: of the differences are summed, a bool.
    """
    flat, count = types.intp, runs.literal_value

    def generate(*generating: Any) -> Any:
        vectors, (_, begin, size, stride, _, at, chosen, *_) = Vectors(LANES, *generating), generating[3]
        builder, level, one = vectors.builder, vectors.load(vectors.place(4, at)), vectors.constant(1.0)
        start, run = vectors.place(0, begin), builder.mul(size, stride)

        def added(pixel: Any, sums: list[Any]) -> list[Any]:
            pointer, after = vectors.after(start, builder.mul(pixel, stride)), []
            for before in sums:
                value = builder.fsub(vectors.load(pointer), level)
                after.append(vectors.plus(before, value, builder.select(chosen, value, one)))
                pointer = vectors.after(pointer, run)
            return after

        for k, total in enumerate(vectors.repeat(size, [vectors.constant(0.0)] * count, added)):
            vectors.store(total, vectors.place(8, k * LANES))
        return vectors.target.get_dummy_value()

    return types.void(x, flat, flat, flat, mean, flat, types.boolean, runs, out), generate


@intrinsic(prefer_literal=True)
def _finish(context, x, first, pixels, channels, mean, factor, channel, low, skip, has_skip):
    """Normalise some channels of flat ``x`` in place; see :func:`_add_runs`.

    Args:
        mean, factor: flat, of the channels, from ``channel``.
        low: values below it become it.
        skip: flat, as ``x``; is added, and the sum rectified, if there literally is one.
    """

    flat = types.intp

    def generate(*generating: Any) -> Any:
        vectors, (_, begin, size, stride, _, _, at, least, *_) = Vectors(LANES, *generating), generating[3]
        builder, level, scale = vectors.builder, *(vectors.load(vectors.place(k, at)) for k in (4, 5))
        start, floor, zero = vectors.place(0, begin), vectors.everywhere(least), vectors.constant(0.0)

        def at_least(value: Any, bound: Any) -> Any:  # NaN stays
            return builder.select(builder.fcmp_ordered("<", value, bound), bound, value)

        def finished(pixel: Any, nothing: list[Any]) -> list[Any]:
            step = builder.mul(pixel, stride)
            place = vectors.after(start, step)
            value = builder.fmul(builder.fsub(vectors.load(place), level), scale, **CONTRACT)
            value = at_least(value, floor)
            if has_skip.literal_value:
                beside = vectors.load(vectors.place(8, begin, step))
                value = at_least(builder.fadd(beside, value, **CONTRACT), zero)
            vectors.store(value, place)
            return nothing

        vectors.repeat(size, [], finished)
        return vectors.target.get_dummy_value()

    return types.void(x, flat, flat, flat, mean, factor, flat, types.float32, skip, has_skip), generate


@part
def _sums(x, first, pixels, mean, squares, out):
    """Sums over the pixels of an image of each channel, or of the squares of what differs from a mean."""
    channels, runs = len(out), np.empty(_BESIDE * LANES, np.float32)
    out[:] = 0
    done = 0
    while done < pixels:
        whole = pixels - done >= _BESIDE * _RUN
        size, beside = (_RUN, _BESIDE) if whole else (min(_RUN, pixels - done), 1)
        for c in range(0, channels, LANES):
            at = first + done * channels + c
            if whole:
                _add_runs(x, at, size, channels, mean, c, squares, _BESIDE, runs)  # type: ignore[call-arg]
            else:
                _add_runs(x, at, size, channels, mean, c, squares, 1, runs)  # type: ignore[call-arg]
            for k in range(beside):
                for lane in range(LANES):
                    out[c + lane] += runs[k * LANES + lane]
        done += size * beside


@part
def _normalise(x, eps, rectified, skip):
    """Body of both kernels."""
    images, pixels, channels = x.shape
    low = np.float32(0) if rectified else np.float32(-np.inf)
    mean, factor, total = np.empty(channels, np.float32), np.empty(channels, np.float32), np.empty(channels, np.float64)
    flat, beside = x.reshape(-1), skip.reshape(-1)
    for n in range(images):
        first = n * pixels * channels
        mean[:] = 0
        _sums(flat, first, pixels, mean, False, total)
        for c in range(channels):
            mean[c] = total[c] / pixels
        _sums(flat, first, pixels, mean, True, total)
        for c in range(channels):
            factor[c] = 1 / np.sqrt(total[c] / pixels + eps)
        for c in range(0, channels, LANES):
            if len(skip):
                _finish(flat, first + c, pixels, channels, mean, factor, c, low, beside, True)  # type: ignore[call-arg]
            else:
                _finish(flat, first + c, pixels, channels, mean, factor, c, low, beside, False)  # type: ignore[call-arg]


@compiled
def normalise(x: Array, eps: float, rectified: bool, skip: Array) -> None:
    """Instance normalisation in place, perhaps with a rectifier, and the sum with a skip, rectified.

    Args:
        x: ``(N, S, C)`` float32, images, pixels and channels; these are a multiple of :data:`LANES`.
        eps: added to the variance.
        rectified: with a rectifier.
        skip: ``(N, S, C)``, added before another rectifier; ``(0, S, C)``: none.
    """
    _normalise(x, eps, rectified, skip)


@compiled
def normalise_bfloat16(x: Array, eps: float, rectified: bool, skip: Array) -> None:
    """:func:`normalise` of the bits of bfloat16, as uint16; all is computed in float32."""
    _normalise(x, eps, rectified, skip)
