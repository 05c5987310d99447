"""Kernels of :mod:`dvo.nets.alignment.alignment`."""

from __future__ import annotations

import numpy as np

from dvo.core.compiled import compiled, part


@part
def _sample(image, height, width, x, y):
    """Grey level of a flat image at ``x, y`` float32; outside that of the border, at NaN that of row or column 0."""
    x = min(x, np.float32(width - 1)) if x > 0 else np.float32(0)
    y = min(y, np.float32(height - 1)) if y > 0 else np.float32(0)
    left, top = min(np.int32(x), np.int32(width - 2)), min(np.int32(y), np.int32(height - 2))
    u, v = x - np.float32(left), y - np.float32(top)
    first = np.uint64(np.uint32(top * np.int32(width) + left))  # an index without a sign needs no test of it
    below = first + np.uint64(width)
    upper = image[first] + u * (image[first + np.uint64(1)] - image[first])
    lower = image[below] + u * (image[below + np.uint64(1)] - image[below])
    return upper + v * (lower - upper)


@part
def _centre(values):
    total = np.float32(0)
    for k in range(len(values)):
        total += values[k]
    total /= np.float32(len(values))
    for k in range(len(values)):
        values[k] -= total


@part
def _dot(first, second):
    total = np.float32(0)
    for k in range(len(first)):
        total += first[k] * second[k]
    return np.float64(total)


@part
def _template(image, height, width, x, y, side, around, grey, gx, gy):
    """Fill the centred grey levels of a window and their central differences."""
    half = side // 2 + 1
    for i in range(side + 2):
        for j in range(side + 2):
            around[i, j] = _sample(image, height, width, x + np.float32(j - half), y + np.float32(i - half))
    for i in range(side):
        for j in range(side):
            k = i * side + j
            grey[k] = around[i + 1, j + 1]
            gx[k] = (around[i + 1, j + 2] - around[i + 1, j]) * np.float32(0.5)
            gy[k] = (around[i + 2, j + 1] - around[i, j + 1]) * np.float32(0.5)
    _centre(grey)
    _centre(gx)
    _centre(gy)


@part
def _look(image, height, width, x, y, warp, side, seen):
    """Fill the centred grey levels of a warped window."""
    half = side // 2
    xx, xy, yx, yy = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
    for i in range(side):
        row, down = seen[i * side : (i + 1) * side], np.float32(i - half)
        for j in range(side):
            across = np.float32(np.int32(j)) - np.float32(half)
            row[j] = _sample(image, height, width, x + (xx * across + xy * down), y + (yx * across + yy * down))
    _centre(seen)


@compiled
def align(images, source, target, centres, start, warps, side, iterations, floor, longest, positions, quality):
    """Fill positions, and correlation and last step of ``quality (2, E)``; the rest is as in the twin.

    Images have two rows and columns at least.
    """
    count, height, width = images.shape
    flat = images.reshape(count, height * width)
    around = np.empty((side + 2, side + 2), np.float32)
    area = side * side
    grey, gx, gy = np.empty(area, np.float32), np.empty(area, np.float32), np.empty(area, np.float32)
    seen, error = np.empty(area, np.float32), np.empty(area, np.float32)
    for edge in range(len(source)):
        _template(flat[source[edge]], height, width, centres[edge, 0], centres[edge, 1], side, around, grey, gx, gy)
        energy = _dot(grey, grey) + floor
        a, b, c = _dot(gx, gx) + floor, _dot(gx, gy), _dot(gy, gy) + floor
        image, warp = flat[target[edge]], warps[edge]
        x, y = start[edge, 0], start[edge, 1]
        moved = 0.0
        for _ in range(iterations):
            _look(image, height, width, x, y, warp, side, seen)
            gain = np.float32(np.sqrt(energy / (_dot(seen, seen) + floor)))
            for k in range(area):
                error[k] = seen[k] * gain - grey[k]
            u, v = _dot(gx, error), _dot(gy, error)
            across, down = (c * u - b * v) / (a * c - b * b), (a * v - b * u) / (a * c - b * b)
            dx, dy = warp[0, 0] * across + warp[0, 1] * down, warp[1, 0] * across + warp[1, 1] * down
            moved = np.sqrt(dx * dx + dy * dy)
            shorter = longest / max(moved, longest)
            x, y = np.float32(x - dx * shorter), np.float32(y - dy * shorter)
        _look(image, height, width, x, y, warp, side, seen)
        positions[edge, 0], positions[edge, 1], quality[1, edge] = x, y, moved
        quality[0, edge] = _dot(seen, grey) / np.sqrt(energy * (_dot(seen, seen) + floor))


@compiled
def texture(images, frames, centres, side, out):
    """Fill ``out (E,)``; the rest is as in the twin, of images with two rows and columns at least."""
    count, height, width = images.shape
    flat, half = images.reshape(count, height * width), side // 2 + 1
    around = np.empty((side + 2, side + 2), np.float32)
    for e in range(len(frames)):
        for i in range(side + 2):
            for j in range(side + 2):
                x, y = centres[e, 0] + np.float32(j - half), centres[e, 1] + np.float32(i - half)
                around[i, j] = _sample(flat[frames[e]], height, width, x, y)
        xx = xy = yy = np.float32(0)
        for i in range(1, side + 1):
            for j in range(1, side + 1):
                across, down = around[i, j + 1] - around[i, j - 1], around[i + 1, j] - around[i - 1, j]
                xx += across * across
                xy += across * down
                yy += down * down
        middle, difference = (xx + yy) / 2, (xx - yy) / 2
        least = middle - np.sqrt(difference * difference + xy * xy)
        out[e] = np.sqrt(max(least, 0) / (4 * side * side))


@compiled
def warps_of(coords, tilts, smallest, largest, out):
    """Fill ``out (E, 2, 2)``; the rest is as in the twin, :func:`dvo.nets.alignment.alignment.patch_warps`.

    ``tilts (E, 2, 2)``, or none of them: zero.
    """
    last = coords.shape[1] - 1
    middle = coords.shape[1] // 2
    for e in range(len(coords)):
        for axis in range(2):
            out[e, axis, 0] = (coords[e, middle, last, axis] - coords[e, middle, 0, axis]) / np.float32(last)
            out[e, axis, 1] = (coords[e, last, middle, axis] - coords[e, 0, middle, axis]) / np.float32(last)
            if len(tilts):
                out[e, axis, 0] += tilts[e, axis, 0]
                out[e, axis, 1] += tilts[e, axis, 1]
        area = out[e, 0, 0] * out[e, 1, 1] - out[e, 0, 1] * out[e, 1, 0]
        if not smallest < area < largest:  # nor NaN
            out[e, 0, 0] = out[e, 1, 1] = 1
            out[e, 0, 1] = out[e, 1, 0] = 0


@compiled
def accepted(positions, correlation, last_step, measured, width, height, half, reach, longest, least, out):
    """Fill ``out (E,)`` bool with the decision of :func:`dvo.nets.alignment.alignment.accept`.

    ``reach`` and ``longest``, of the last step, are in pixels, ``least`` is of the correlation.
    """
    for e in range(len(positions)):
        x, y = positions[e, 0], positions[e, 1]
        dx, dy = np.float64(x - measured[e, 0]), np.float64(y - measured[e, 1])
        good = half <= x <= width - 1 - half and half <= y <= height - 1 - half
        good = good and np.sqrt(dx * dx + dy * dy) <= reach
        out[e] = good and last_step[e] <= longest and correlation[e] >= least
