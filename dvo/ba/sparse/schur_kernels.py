"""Kernels of :mod:`dvo.ba.sparse.equations` and :mod:`dvo.ba.sparse.schur_pattern`."""

from __future__ import annotations

import math

import numpy as np

from dvo.core.compiled import compiled


@compiled
def observations(patch, frame, patches, free):
    """Sorted ``patch * free + frame`` of the observations by free frames, each once."""
    start, count = np.empty(patches + 1, np.int64), np.empty(patches, np.int64)
    for k in range(patches):
        start[k + 1], count[k] = 0, 0
    start[0] = 0
    for m in range(len(patch)):
        if frame[m] < free:
            start[patch[m] + 1] += 1
    for k in range(patches):
        start[k + 1] += start[k]
    found, total = np.empty(start[patches], np.int64), 0
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
            total += 1
    keys, end = np.empty(total, np.int64), 0
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
    seen, mark = np.empty((sources, free), np.bool_), np.empty((free, free), np.bool_)
    members = np.empty(free, np.int64)
    for f in range(free):
        for s in range(sources):
            seen[s, f] = False
        for other in range(free):
            mark[f, other] = False
    for key in keys:
        seen[source[key // free], key % free] = True
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
def reduce(h_pl, keys, start, q, free, by_source, first, pattern, row_start, blocks):
    """Subtract ``H_pl diag(q) H_pl^T`` from the blocks of a pattern with sorted keys.

    ``by_source`` are the patches by source frames, of which ``first`` has the first of each: those of one source are
    seen from much the same frames, so that their sum is a dense product. ``row_start (n + 1,)`` is of the pattern.
    """
    most, real = 1, h_pl.dtype.type
    place, members, at = np.empty(free, np.int64), np.empty(free, np.int64), np.empty(free, np.int64)
    for f in range(free):
        place[f] = -1
    for s in range(len(first) - 1):
        if first[s + 1] - first[s] > most:
            most = first[s + 1] - first[s]
    w = np.empty((most + 7) * 6 * free, h_pl.dtype)
    total = np.empty(6 * free, h_pl.dtype)
    for s in range(len(first) - 1):
        count = 0
        for p in range(first[s], first[s + 1]):
            k = by_source[p]
            for o in range(start[k], start[k + 1]):
                f = keys[o] - k * free
                place[f] = 0
        for f in range(free):
            if place[f] == 0:
                place[f] = count
                members[count] = f
                count += 1
        if count == 0:
            continue
        used, width = 0, 6 * count
        for p in range(first[s], first[s + 1]):
            k = by_source[p]
            if start[k] == start[k + 1]:
                continue
            root, row = math.sqrt(q[k]), w[used * width : (used + 1) * width]
            for c in range(width):
                row[c] = real(0)
            for o in range(start[k], start[k + 1]):
                to = 6 * place[keys[o] - k * free]
                for i in range(6):
                    row[to + i] = h_pl[o, i] * root
            used += 1
        row = w[used * width : (used + 7) * width]  # patches are taken by eight
        for c in range(7 * width):
            row[c] = real(0)
        for a in range(count):
            place[members[a]] = -1
            search = row_start[members[a]]
            for b in range(a + 1):
                key = members[a] * free + members[b]
                while pattern[search] < key:
                    search += 1
                at[b] = search
            for i in range(6):
                length, own = 6 * (a + 1), 6 * a + i
                for c in range(length):
                    total[c] = real(0)
                for p in range(0, used, 8):
                    w0, w1 = w[p * width : (p + 1) * width], w[(p + 1) * width : (p + 2) * width]
                    w2, w3 = w[(p + 2) * width : (p + 3) * width], w[(p + 3) * width : (p + 4) * width]
                    w4, w5 = w[(p + 4) * width : (p + 5) * width], w[(p + 5) * width : (p + 6) * width]
                    w6, w7 = w[(p + 6) * width : (p + 7) * width], w[(p + 7) * width : (p + 8) * width]
                    c0, c1, c2, c3 = w0[own], w1[own], w2[own], w3[own]
                    c4, c5, c6, c7 = w4[own], w5[own], w6[own], w7[own]
                    for c in range(length):
                        total[c] += (
                            c0 * w0[c] + c1 * w1[c] + c2 * w2[c] + c3 * w3[c]
                            + c4 * w4[c] + c5 * w5[c] + c6 * w6[c] + c7 * w7[c]
                        )  # fmt: skip
                for b in range(a + 1):
                    here = blocks[at[b], i]
                    for c in range(6):
                        here[c] -= total[6 * b + c]


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
