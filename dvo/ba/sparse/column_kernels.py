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
    near = np.zeros((size, size), np.bool_)
    degree = np.zeros(size, np.int64)
    for i in range(len(rows)):
        a, b = rows[i], columns[i]
        if a != b and not near[a, b]:
            near[a, b] = near[b, a] = True
            degree[a] += 1
            degree[b] += 1
    rank, order = np.full(size, -1), np.empty(size, np.int64)
    start = np.zeros(size + 1, np.int64)
    found, members = np.empty(min(most, 64 * size), np.int64), np.empty(size, np.int64)
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
        if end > len(found):
            more = np.empty(min(most, max(2 * len(found), end)), np.int64)
            more[:begin] = found[:begin]
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
        for i in range(start[step], start[step + 1]):
            under[i] = rank[found[i]]
        under[start[step] : start[step + 1]].sort()
    return rank, start, under


@compiled
def places(rank, start, under, rows, columns):
    """Index among ``under`` of each block of the lower triangle."""
    out = np.empty(len(rows), np.int64)
    for i in range(len(rows)):
        a, b = rank[rows[i]], rank[columns[i]]
        low, high = min(a, b), max(a, b)
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
def solve(rank, start, under, rows, columns, place, blocks, rhs, x):
    """Factorise and substitute; False where the matrix is not positive definite.

    Column ``j`` of the factor is stored as its six scalar columns, one after the other, each over all rows below.
    """
    size = len(rank)
    panel = np.zeros(36 * len(under), blocks.dtype)
    for i in range(len(rows)):
        a, b = rank[rows[i]], rank[columns[i]]
        low = min(a, b)
        height, first = 6 * (start[low + 1] - start[low]), 36 * start[low]
        at = first + 6 * (place[i] - start[low])
        for r in range(6):
            for c in range(6):
                panel[at + c * height + r] = blocks[i, r, c] if a >= b else blocks[i, c, r]
    for j in range(size):
        begin, end = start[j], start[j + 1]
        height = 6 * (end - begin)
        column = panel[36 * begin : 36 * end].reshape(6, height)
        for k in range(6):
            here = column[k]
            for n in range(k):
                factor, left = column[n, k], column[n]
                for r in range(height):
                    here[r] -= factor * left[r]
            pivot = here[k]
            if not pivot > 0:
                return False
            scale = 1 / math.sqrt(pivot)
            for r in range(height):
                here[r] *= scale
        for s in range(begin + 1, end):
            to = under[s]
            first, last = start[to], start[to + 1]
            target = panel[36 * first : 36 * last].reshape(6, 6 * (last - first))
            a, at = s, first  # rows of this column, and where they are in that one
            while a < end:
                while under[at] != under[a]:
                    at += 1
                run = 1
                while a + run < end and under[at + run] == under[a + run]:
                    run += 1
                source, goes, width = 6 * (a - begin), 6 * (at - first), 6 * run
                own = 6 * (s - begin)
                p0, p1 = column[0, source : source + width], column[1, source : source + width]
                p2, p3 = column[2, source : source + width], column[3, source : source + width]
                p4, p5 = column[4, source : source + width], column[5, source : source + width]
                for c in range(0, 6, 2):
                    e0, e1, e2 = column[0, own + c], column[1, own + c], column[2, own + c]
                    e3, e4, e5 = column[3, own + c], column[4, own + c], column[5, own + c]
                    f0, f1, f2 = column[0, own + c + 1], column[1, own + c + 1], column[2, own + c + 1]
                    f3, f4, f5 = column[3, own + c + 1], column[4, own + c + 1], column[5, own + c + 1]
                    out, next_out = target[c, goes : goes + width], target[c + 1, goes : goes + width]
                    for r in range(width):
                        q0, q1, q2, q3, q4, q5 = p0[r], p1[r], p2[r], p3[r], p4[r], p5[r]
                        out[r] -= e0 * q0 + e1 * q1 + e2 * q2 + e3 * q3 + e4 * q4 + e5 * q5
                        next_out[r] -= f0 * q0 + f1 * q1 + f2 * q2 + f3 * q3 + f4 * q4 + f5 * q5
                a, at = a + run, at + run
    y = np.empty((size, 6), blocks.dtype)
    for i in range(size):
        y[rank[i]] = rhs[i]
    for j in range(size):
        begin, end = start[j], start[j + 1]
        column = panel[36 * begin : 36 * end].reshape(6, 6 * (end - begin))
        for k in range(6):
            y[j, k] /= column[k, k]
            for r in range(k + 1, 6):
                y[j, r] -= column[k, r] * y[j, k]
        for s in range(begin + 1, end):
            for k in range(6):
                for r in range(6):
                    y[under[s], r] -= column[k, 6 * (s - begin) + r] * y[j, k]
    for j in range(size - 1, -1, -1):
        begin, end = start[j], start[j + 1]
        column = panel[36 * begin : 36 * end].reshape(6, 6 * (end - begin))
        for s in range(begin + 1, end):
            for k in range(6):
                for r in range(6):
                    y[j, k] -= column[k, 6 * (s - begin) + r] * y[under[s], r]
        for k in range(5, -1, -1):
            for r in range(k + 1, 6):
                y[j, k] -= column[k, r] * y[j, r]
            y[j, k] /= column[k, k]
    for i in range(size):
        x[i] = y[rank[i]]
    return True
