"""Kernel of :func:`dvo.nets.patch.selection.structure_selection`."""

from __future__ import annotations

import numpy as np

from dvo.core.compiled import compiled, part


@part
def _grey(image, x, y):
    """Sum of the colours of a pixel; outside the image that of the border."""
    x, y = min(max(x, 0), image.shape[2] - 1), min(max(y, 0), image.shape[1] - 1)
    total = np.int64(0)
    for colour in range(image.shape[0]):
        total += np.int64(image[colour, y, x])
    return total


@compiled
def structure_scores(image, points, stride, box, out):
    """Fill ``out (P,)``, the values of :func:`dvo.nets.patch.selection.structure_score` at ``points (P, 2)``.

    Sums are whole numbers, so that a pixel has the same value whatever is around its window.
    """
    colours, height, width = image.shape
    half = box // 2
    for p in range(len(points)):
        x, y = points[p, 0] * stride, points[p, 1] * stride
        xx = xy = yy = 0
        for v in range(max(0, y - half), min(height, y + half + 1)):
            for u in range(max(0, x - half), min(width, x + half + 1)):
                across = _grey(image, u + 1, v) - _grey(image, u - 1, v)
                down = _grey(image, u, v + 1) - _grey(image, u, v - 1)
                xx += across * across
                xy += across * down
                yy += down * down
        middle, difference = (xx + yy) / 2, (xx - yy) / 2
        least = middle - np.sqrt(difference * difference + np.float64(xy) * np.float64(xy))
        out[p] = max(least, 0) / (4 * colours * colours * box * box)
