"""Kernel of :func:`dvo.nets.patch.selection.structure_selection`."""

from __future__ import annotations

import numpy as np

from dvo.core.compiled import compiled


@compiled
def structure_scores(image, points, stride, box, out):
    """Fill ``out (P,)``, the values of :func:`dvo.nets.patch.selection.structure_score` at ``points (P, 2)``.

    Sums are whole numbers, so that a pixel has the same value whatever is around its window.
    """
    colours, height, width = image.shape
    half = box // 2
    grey = np.empty((box + 2, box + 2), np.int64)  # sums of the colours; outside the image those of its border
    for p in range(len(points)):
        x, y = points[p, 0] * stride - half, points[p, 1] * stride - half
        for i in range(box + 2):
            v = min(max(y + i - 1, 0), height - 1)
            for j in range(box + 2):
                u = min(max(x + j - 1, 0), width - 1)
                grey[i, j] = 0
                for colour in range(colours):
                    grey[i, j] += image[colour, v, u]
        xx = xy = yy = 0
        for i in range(max(1, 1 - y), min(box, height - y) + 1):
            for j in range(max(1, 1 - x), min(box, width - x) + 1):
                across, down = grey[i, j + 1] - grey[i, j - 1], grey[i + 1, j] - grey[i - 1, j]
                xx += across * across
                xy += across * down
                yy += down * down
        middle, difference = (xx + yy) / 2, (xx - yy) / 2
        least = middle - np.sqrt(difference * difference + np.float64(xy) * np.float64(xy))
        out[p] = max(least, 0) / (4 * colours * colours * box * box)
