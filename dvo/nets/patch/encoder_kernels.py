"""Kernels of :func:`dvo.nets.patch.encoder.normalise`."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from dvo.core.compiled import compiled, part

Array = Any

_RUN = 64  # pixels whose sum is in single precision; sums of these are in double precision


@intrinsic
def _number(context, stored):
    """Number that an array holds: of float32, or the bits of a bfloat16 as uint16."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        if signature.args[0] == types.float32:
            return given[0]
        bits = builder.zext(given[0], ir.IntType(32))
        return builder.bitcast(builder.shl(bits, ir.Constant(bits.type, 16)), ir.FloatType())

    return types.float32(stored), generate


@intrinsic
def _stored(context, value, like):
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


@part
def _normalise(x, eps, rectified, skip):
    """Body of both kernels."""
    images, pixels, channels = x.shape
    zero = np.float32(0)
    low = zero if rectified else np.float32(-np.inf)
    mean, factor, part = np.empty(channels, np.float32), np.empty(channels, np.float32), np.empty(channels, np.float32)
    total = np.empty(channels, np.float64)
    for n in range(images):
        image = x[n]
        mean[:] = 0
        for squares in (False, True):
            total[:] = 0
            for first in range(0, pixels, _RUN):
                part[:] = 0
                if squares:
                    for s in range(first, min(pixels, first + _RUN)):
                        for c in range(channels):
                            part[c] += (_number(image[s, c]) - mean[c]) * (_number(image[s, c]) - mean[c])  # type: ignore[call-arg]
                else:
                    for s in range(first, min(pixels, first + _RUN)):
                        for c in range(channels):
                            part[c] += _number(image[s, c])  # type: ignore[call-arg]
                for c in range(channels):
                    total[c] += part[c]
            for c in range(channels):
                if squares:
                    factor[c] = 1 / np.sqrt(total[c] / pixels + eps)
                else:
                    mean[c] = total[c] / pixels
        if len(skip):
            beside = skip[n]
            for s in range(pixels):
                for c in range(channels):
                    value = (_number(image[s, c]) - mean[c]) * factor[c]  # type: ignore[call-arg]
                    value = low if value < low else value  # NaN stays
                    value = _number(beside[s, c]) + value
                    image[s, c] = _stored(zero if value < zero else value, image[s, c])
        else:
            for s in range(pixels):
                for c in range(channels):
                    value = (_number(image[s, c]) - mean[c]) * factor[c]  # type: ignore[call-arg]
                    image[s, c] = _stored(low if value < low else value, image[s, c])


@compiled
def normalise(x: Array, eps: float, rectified: bool, skip: Array) -> None:
    """Instance normalisation in place, perhaps with a rectifier, and the sum with a skip, rectified.

    Args:
        x: ``(N, S, C)`` float32, images, pixels and channels.
        eps: added to the variance.
        rectified: with a rectifier.
        skip: ``(N, S, C)``, added before another rectifier; ``(0, S, C)``: none.
    """
    _normalise(x, eps, rectified, skip)


@compiled
def normalise_bfloat16(x: Array, eps: float, rectified: bool, skip: Array) -> None:
    """:func:`normalise` of the bits of bfloat16, as uint16; all is computed in float32."""
    _normalise(x, eps, rectified, skip)
