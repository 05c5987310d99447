"""Kernels of :func:`dvo.nets.patch.encoder.normalise`."""

from __future__ import annotations

from typing import Any

import numpy as np

from dvo.core.compiled import compiled, part
from dvo.core.number_kernels import number, stored

Array = Any

_RUN = 64  # pixels whose sum is in single precision; sums of these are in double precision


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
                            part[c] += (number(image[s, c]) - mean[c]) * (number(image[s, c]) - mean[c])  # type: ignore[call-arg]
                else:
                    for s in range(first, min(pixels, first + _RUN)):
                        for c in range(channels):
                            part[c] += number(image[s, c])  # type: ignore[call-arg]
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
                    value = (number(image[s, c]) - mean[c]) * factor[c]  # type: ignore[call-arg]
                    value = low if value < low else value  # NaN stays
                    value = number(beside[s, c]) + value
                    image[s, c] = stored(zero if value < zero else value, image[s, c])
        else:
            for s in range(pixels):
                for c in range(channels):
                    value = (number(image[s, c]) - mean[c]) * factor[c]  # type: ignore[call-arg]
                    image[s, c] = stored(low if value < low else value, image[s, c])


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
