"""Kernels of :mod:`dvo.ba.sparse.column_cholesky`: blocks of 6 x 6."""

from __future__ import annotations

import math

import numpy as np

from dvo.core.compiled import compiled


@compiled
def eliminate(size, rows, columns, most):
    """Order by minimum degree, and the structure of the factor.

    Returns ``rank (n,)``, and ``start (n + 1,)`` and ``under`` of each column: ranks of its rows, rising, itself first.
    Empty arrays where there are more than ``most`` of them.
    """
    near = np.empty((size, size), np.bool_)
    degree, rank, order = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    start, members = np.empty(size + 1, np.int64), np.empty(size, np.int64)
    for i in range(size):
        degree[i], rank[i], start[i] = 0, -1, 0
        for j in range(size):
            near[i, j] = False
    for i in range(len(rows)):
        a, b = rows[i], columns[i]
        if a != b and not near[a, b]:
            near[a, b] = near[b, a] = True
            degree[a] += 1
            degree[b] += 1
    room = 64 * size if 64 * size < most else most
    found = np.empty(room, np.int64)
    for step in range(size):
        best = -1
        for i in range(size):
            if rank[i] < 0 and (best < 0 or degree[i] < degree[best]):
                best = i
        rank[best], order[step] = step, best
        count, begin = 0, start[step]
        for i in range(size):
            if near[best, i] and rank[i] < 0:
                members[count] = i
                count += 1
        end = begin + count + 1
        if end > most:
            return rank[:0], start[:0], found[:0]
        if end > room:
            room = 2 * end if 2 * end < most else most
            more = np.empty(room, np.int64)
            for i in range(begin):
                more[i] = found[i]
            found = more
        found[begin] = best
        for a in range(count):
            found[begin + 1 + a] = members[a]
            degree[members[a]] -= 1
            for b in range(a):
                if not near[members[a], members[b]]:
                    near[members[a], members[b]] = near[members[b], members[a]] = True
                    degree[members[a]] += 1
                    degree[members[b]] += 1
        start[step + 1] = end
    under = np.empty(start[size], np.int64)
    for step in range(size):
        begin = start[step]
        for i in range(begin, start[step + 1]):
            value, at = rank[found[i]], i
            while at > begin and under[at - 1] > value:
                under[at] = under[at - 1]
                at -= 1
            under[at] = value
    return rank, start, under


@compiled
def places(rank, start, under, rows, columns):
    """Index among ``under`` of each block of the lower triangle."""
    out = np.empty(len(rows), np.int64)
    for i in range(len(rows)):
        a, b = rank[rows[i]], rank[columns[i]]
        low, high = (a, b) if a < b else (b, a)
        begin, end = start[low], start[low + 1]
        while begin < end:
            middle = (begin + end) // 2
            if under[middle] < high:
                begin = middle + 1
            else:
                end = middle
        out[i] = begin
    return out


@compiled
def solve(rank, start, under, rows, columns, place, blocks, rhs, x, y, panel):
    """Factorise and substitute; False where the matrix is not positive definite.

    ``y`` like ``rhs`` and ``panel (36 len(under),)``, of zeros, are for use within.

    Column ``j`` of the factor is stored as its six scalar columns, one after the other, each over all rows below.
    """
    size = len(rank)
    for i in range(len(rows)):
        a, b = rank[rows[i]], rank[columns[i]]
        low = a if a < b else b
        height, first = 6 * (start[low + 1] - start[low]), 36 * start[low]
        at = first + 6 * (place[i] - start[low])
        for r in range(6):
            for c in range(6):
                panel[at + c * height + r] = blocks[i, r, c] if a >= b else blocks[i, c, r]
    for j in range(size):
        begin, end = start[j], start[j + 1]
        height = 6 * (end - begin)
        first = 36 * begin
        for k in range(6):
            here = panel[first + k * height : first + (k + 1) * height]
            for n in range(k):
                left = panel[first + n * height : first + (n + 1) * height]
                factor = left[k]
                for r in range(height):
                    here[r] -= factor * left[r]
            pivot = here[k]
            if not pivot > 0:
                return False
            scale = 1 / math.sqrt(pivot)
            for r in range(height):
                here[r] *= scale
        for s in range(begin + 1, end):
            to, own = under[s], first + 6 * (s - begin)
            target, wide = start[to], 6 * (start[to + 1] - start[to])
            a, at = s, target  # rows of this column, and where they are in that one
            while a < end:
                while under[at] != under[a]:
                    at += 1
                run = 1
                while a + run < end and under[at + run] == under[a + run]:
                    run += 1
                source, goes, width = first + 6 * (a - begin), 36 * target + 6 * (at - target), 6 * run
                p0 = panel[source : source + width]
                p1 = panel[source + height : source + height + width]
                p2 = panel[source + 2 * height : source + 2 * height + width]
                p3 = panel[source + 3 * height : source + 3 * height + width]
                p4 = panel[source + 4 * height : source + 4 * height + width]
                p5 = panel[source + 5 * height : source + 5 * height + width]
                for c in range(0, 6, 2):
                    e = panel[own + c : first + 6 * height]
                    e0, e1, e2 = e[0], e[height], e[2 * height]
                    e3, e4, e5 = e[3 * height], e[4 * height], e[5 * height]
                    f0, f1, f2 = e[1], e[height + 1], e[2 * height + 1]
                    f3, f4, f5 = e[3 * height + 1], e[4 * height + 1], e[5 * height + 1]
                    out = panel[goes + c * wide : goes + c * wide + width]
                    next_out = panel[goes + (c + 1) * wide : goes + (c + 1) * wide + width]
                    for r in range(width):
                        q0, q1, q2, q3, q4, q5 = p0[r], p1[r], p2[r], p3[r], p4[r], p5[r]
                        out[r] -= e0 * q0 + e1 * q1 + e2 * q2 + e3 * q3 + e4 * q4 + e5 * q5
                        next_out[r] -= f0 * q0 + f1 * q1 + f2 * q2 + f3 * q3 + f4 * q4 + f5 * q5
                a, at = a + run, at + run
    for i in range(size):
        for k in range(6):
            y[rank[i], k] = rhs[i, k]
    for j in range(size):
        begin, height = start[j], 6 * (start[j + 1] - start[j])
        for k in range(6):
            column = panel[36 * begin + k * height : 36 * begin + (k + 1) * height]
            pivot = y[j, k] / column[k]
            y[j, k] = pivot
            for r in range(k + 1, 6):
                y[j, r] -= column[r] * pivot
            for s in range(1, height // 6):
                to = under[begin + s]
                for r in range(6):
                    y[to, r] -= column[6 * s + r] * pivot
    for j in range(size - 1, -1, -1):
        begin, height = start[j], 6 * (start[j + 1] - start[j])
        for k in range(5, -1, -1):
            column = panel[36 * begin + k * height : 36 * begin + (k + 1) * height]
            total = y[j, k]
            for s in range(1, height // 6):
                from_row = under[begin + s]
                for r in range(6):
                    total -= column[6 * s + r] * y[from_row, r]
            for r in range(k + 1, 6):
                total -= column[r] * y[j, r]
            y[j, k] = total / column[k]
    for i in range(size):
        for k in range(6):
            x[i, k] = y[rank[i], k]
    return True
