"""Kernels of :mod:`dvo.ba.sparse.equations` and :mod:`dvo.ba.sparse.schur_pattern`."""

from __future__ import annotations

import numpy as np

from dvo.core.compiled import compiled


@compiled
def observations(patch, frame, patches, free):
    """Sorted ``patch * free + frame`` of the observations by free frames, each once."""
    start = np.zeros(patches + 1, np.int64)
    for m in range(len(patch)):
        if frame[m] < free:
            start[patch[m] + 1] += 1
    for k in range(patches):
        start[k + 1] += start[k]
    found, count = np.empty(start[patches], np.int64), np.zeros(patches, np.int64)
    for m in range(len(patch)):
        if frame[m] < free:  # insertion into the few frames of the patch, rising
            k, f = patch[m], frame[m]
            begin, at = start[k], start[k] + count[k]
            while at > begin and found[at - 1] > f:
                at -= 1
            if at > begin and found[at - 1] == f:
                continue
            for i in range(start[k] + count[k], at, -1):
                found[i] = found[i - 1]
            found[at] = f
            count[k] += 1
    keys, end = np.empty(count.sum(), np.int64), 0
    for k in range(patches):
        for i in range(start[k], start[k] + count[k]):
            keys[end] = k * free + found[i]
            end += 1
    return keys


@compiled
def find(keys, start, frame, patch, free):
    """Position of observations, one past the last for frames that are not free."""
    out = np.empty(len(frame), np.int64)
    for m in range(len(frame)):
        out[m] = len(keys)
        if frame[m] < free:
            key = patch[m] * free + frame[m]
            low, high = start[patch[m]], start[patch[m] + 1]
            while low < high:
                middle = (low + high) // 2
                if keys[middle] < key:
                    low = middle + 1
                else:
                    high = middle
            out[m] = low
    return out


@compiled
def coupled(keys, source, free, sources, others):
    """Sorted keys ``row * free + column`` of the lower triangle: pairs of frames of one source, and those of others."""
    seen = np.zeros((sources, free), np.bool_)
    for key in keys:
        seen[source[key // free], key % free] = True
    mark, members = np.zeros((free, free), np.bool_), np.empty(free, np.int64)
    for key in others:
        mark[key // free, key % free] = True
    for s in range(sources):
        count = 0
        for f in range(free):
            if seen[s, f]:
                members[count] = f
                count += 1
        for a in range(count):
            for b in range(a + 1):
                mark[members[a], members[b]] = True
    total = 0
    for row in range(free):
        for column in range(row + 1):
            total += mark[row, column]
    out, end = np.empty(total, np.int64), 0
    for row in range(free):
        for column in range(row + 1):
            if mark[row, column]:
                out[end] = row * free + column
                end += 1
    return out


@compiled
def reduce(h_pl, keys, start, q, free, pattern, row_start, blocks):
    """Subtract ``H_pl diag(q) H_pl^T`` from the blocks of a pattern with sorted keys; ``row_start (n + 1,)``."""
    most = 1
    for k in range(len(q)):
        most = max(most, start[k + 1] - start[k])
    place, known = np.empty((most, most), np.int64), np.full(most, -1)
    scaled, other = np.empty(6, h_pl.dtype), np.empty(6, h_pl.dtype)
    length = -1
    for k in range(len(q)):
        begin, count = start[k], start[k + 1] - start[k]
        if count == 0 or q[k] == 0:
            continue
        same = count == length
        for a in range(count):
            f = keys[begin + a] - k * free
            same = same and known[a] == f
            known[a] = f
        if not same:  # most patches are seen from the frames of the one before
            length = count
            for a in range(count):
                at = row_start[known[a]]
                for b in range(a + 1):
                    key = known[a] * free + known[b]
                    while pattern[at] < key:
                        at += 1
                    place[a, b] = at
        for a in range(count):
            for i in range(6):
                scaled[i] = h_pl[begin + a, i] * q[k]
            for b in range(a + 1):
                here = blocks[place[a, b]]
                for c in range(6):
                    other[c] = h_pl[begin + b, c]
                for i in range(6):
                    for c in range(6):
                        here[i, c] -= scaled[i] * other[c]


@compiled
def to_depths(h_pl, keys, start, free, x, out):
    """``H_pl^T x`` for ``x (n, 6)``."""
    for k in range(len(out)):
        total = out.dtype.type(0)
        for o in range(start[k], start[k + 1]):
            f = keys[o] - k * free
            for i in range(6):
                total += h_pl[o, i] * x[f, i]
        out[k] = total


@compiled
def to_poses(h_pl, keys, start, free, y, out):
    """``H_pl y`` for ``y (K,)``, added to ``out (n, 6)``."""
    for k in range(len(y)):
        for o in range(start[k], start[k + 1]):
            f = keys[o] - k * free
            for i in range(6):
                out[f, i] += h_pl[o, i] * y[k]
