"""Kernel of :func:`dvo.nets.patch.encoder.normalise`."""

from __future__ import annotations

from typing import Any

import numpy as np

from dvo.core.compiled import compiled

Array = Any

_RUN = 64  # pixels whose sum is in single precision; sums of these are in double precision


@compiled
def normalise(x: Array, eps: float, rectified: bool, skip: Array) -> None:
    """Instance normalisation in place, perhaps with a rectifier, and the sum with a skip, rectified.

    Args:
        x: ``(N, S, C)``, images, pixels and channels.
        eps: added to the variance.
        rectified: with a rectifier.
        skip: ``(N, S, C)``, added before another rectifier; ``(0, S, C)``: none.
    """
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
                            part[c] += (image[s, c] - mean[c]) * (image[s, c] - mean[c])
                else:
                    for s in range(first, min(pixels, first + _RUN)):
                        for c in range(channels):
                            part[c] += image[s, c]
                for c in range(channels):
                    total[c] += part[c]
            for c in range(channels):
                if squares:
                    factor[c] = 1 / np.sqrt(total[c] / pixels + eps)
                else:
                    mean[c] = total[c] / pixels
        for s in range(pixels):
            for c in range(channels):
                value = (image[s, c] - mean[c]) * factor[c]
                image[s, c] = low if value < low else value  # NaN stays
        if len(skip):
            beside = skip[n]
            for s in range(pixels):
                for c in range(channels):
                    value = beside[s, c] + image[s, c]
                    image[s, c] = zero if value < zero else value
