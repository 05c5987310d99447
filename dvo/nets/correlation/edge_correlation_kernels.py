"""Kernel of :class:`dvo.nets.correlation.edge_correlation.EdgeCorrelation`."""

from __future__ import annotations

import math

import numpy as np

from dvo.core.compiled import compiled


@compiled
def _products(maps, first, stride, feature, out):
    """Dot products of a feature with a window of pixels, from index ``first`` of flat maps with rows of ``stride``."""
    channels, taps = len(feature), len(out)
    for row in range(taps):
        for left in range(0, taps - 7, 8):  # eight pixels share the reading of the feature
            m = maps[first + row * stride + left * channels : first + row * stride + (left + 8) * channels]
            a = b = c = d = e = f = g = h = np.float32(0)
            for k in range(channels):
                p = feature[k]
                a += p * m[k]
                b += p * m[channels + k]
                c += p * m[2 * channels + k]
                d += p * m[3 * channels + k]
                e += p * m[4 * channels + k]
                f += p * m[5 * channels + k]
                g += p * m[6 * channels + k]
                h += p * m[7 * channels + k]
            eight = out[row, left : left + 8]
            eight[0], eight[1], eight[2], eight[3], eight[4], eight[5], eight[6], eight[7] = a, b, c, d, e, f, g, h
        for column in range(taps - taps % 8, taps):
            m = maps[first + row * stride + column * channels : first + row * stride + (column + 1) * channels]
            a = np.float32(0)
            for k in range(channels):
                a += feature[k] * m[k]
            out[row, column] = a


@compiled
def correlate(maps, features, at, kk, frames, radius, out):
    """Fill ``out (E, q, 2r+1, 2r+1)``; the other arguments are those of the twin, maps and features contiguous."""
    taps = 2 * radius + 2
    _, height, width, channels = maps.shape
    flat = maps.reshape(-1)
    products = np.empty((taps, taps), np.float32)
    for edge in range(len(at)):
        for pixel in range(at.shape[1]):
            x, y = at[edge, pixel, 0] - np.float32(radius), at[edge, pixel, 1] - np.float32(radius)
            if math.isnan(x) or math.isnan(y):
                out[edge, pixel] = np.nan
                continue
            x = min(max(x, np.float32(-taps)), np.float32(width - 2 * taps))
            y = min(max(y, np.float32(-taps)), np.float32(height - 2 * taps))
            left, top = math.floor(x), math.floor(y)
            fx, fy = x - np.float32(left), y - np.float32(top)
            first = ((frames[edge] * height + top + taps) * width + left + taps) * channels
            _products(flat, first, width * channels, features[kk[edge], pixel], products)
            for i in range(taps - 1):
                for j in range(taps - 1):
                    u = products[i, j] + fy * (products[i + 1, j] - products[i, j])
                    v = products[i, j + 1] + fy * (products[i + 1, j + 1] - products[i, j + 1])
                    out[edge, pixel, i, j] = u + fx * (v - u)
