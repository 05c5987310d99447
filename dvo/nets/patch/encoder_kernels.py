"""Kernel of :func:`dvo.nets.patch.encoder.activate`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dvo.core.compiled import compiled

Array = Any

_RUN = 512  # values of a sum in single precision; sums of these are in double precision


@compiled
def normalise(x: Array, eps: float, skip: Array) -> None:
    """Instance normalisation and rectifier in place, and those of a sum with a skip.

    Args:
        x: ``(R, S)``, a row for each channel of each image.
        eps: added to the variance.
        skip: ``(R, S)``, added before a second rectifier; ``(0, S)``: none.
    """
    rows, size = x.shape
    zero = np.float32(0)
    for r in range(rows):
        row = x[r]
        total = 0.0
        for first in range(0, size, _RUN):
            part = zero
            for k in range(first, min(size, first + _RUN)):
                part += row[k]
            total += part
        mean = np.float32(total / size)
        total = 0.0
        for first in range(0, size, _RUN):
            part = zero
            for k in range(first, min(size, first + _RUN)):
                part += (row[k] - mean) * (row[k] - mean)
            total += part
        factor = np.float32(1 / math.sqrt(total / size + eps))
        if len(skip):
            beside = skip[r]
            for k in range(size):
                value = (row[k] - mean) * factor
                value = beside[k] + (zero if value < zero else value)
                row[k] = zero if value < zero else value
        else:
            for k in range(size):
                value = (row[k] - mean) * factor
                row[k] = zero if value < zero else value  # NaN stays
