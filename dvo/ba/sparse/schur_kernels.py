"""Kernels of :mod:`dvo.ba.sparse.equations` and :mod:`dvo.ba.sparse.schur_pattern`."""

from __future__ import annotations

import math
from typing import Any

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from dvo.core.compiled import compiled
from dvo.core.vectors import Vectors

_LANES = 8 if llvmlite.binding.get_host_cpu_features().get("avx512f") else 4
_VECTORS = 2
_COLUMNS = _VECTORS * _LANES  # that are multiplied with six at once: their sums stay in registers


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


@intrinsic
def _add_up(context, w, patches, stride, own, column, out, to):
    """Fill six rows of flat ``out``, from ``to``, with sums over patches of products of some columns of ``w``.

    Args:
        w: flat; rows of the patches are ``stride`` apart, as are those of ``out``.
        patches: one or more.
        own: first of six columns, one for each row of ``out``.
        column: first of those that these are multiplied with.
    """

    def generate(*generating: Any) -> Any:
        vectors, (_, count, step, six, others, _, begin) = Vectors(_LANES, *generating), generating[3]
        builder, index = vectors.builder, vectors.index
        nothing = ir.Constant(ir.VectorType(vectors.place(0).type.pointee, _LANES), [0.0] * _LANES)

        def added(patch: Any, before: list[Any]) -> list[Any]:
            row, after = vectors.place(0, builder.mul(patch, step)), []
            columns = [vectors.load(vectors.after(row, others, _LANES * k)) for k in range(_VECTORS)]
            for i in range(6):
                factor = vectors.everywhere(builder.load(vectors.after(row, six, i)))
                for k, value in enumerate(columns):
                    after.append(vectors.plus(before[i * _VECTORS + k], factor, value))
            return after

        for k, total in enumerate(vectors.repeat(count, [nothing] * (6 * _VECTORS), added)):
            line = builder.mul(step, ir.Constant(index, k // _VECTORS))
            vectors.store(total, vectors.place(5, begin, line, _LANES * (k % _VECTORS)))
        return vectors.target.get_dummy_value()

    flat = types.intp
    return types.void(w, flat, flat, flat, flat, out, flat), generate


@compiled
def reduce(h_pl, keys, start, q, free, by_source, first, pattern, row_start, blocks):
    """Subtract ``H_pl diag(q) H_pl^T`` from the blocks of a pattern with sorted keys.

    ``by_source`` are the patches by source frames, of which ``first`` has the first of each: those of one source are
    seen from much the same frames, so that their sum is a dense product. ``row_start (n + 1,)`` is of the pattern.
    """
    most, real = 1, h_pl.dtype.type
    place, members = np.full(free, -1, np.int64), np.empty(free, np.int64)
    for s in range(len(first) - 1):
        most = max(most, first[s + 1] - first[s])
    widest = 6 * free + _COLUMNS
    w, total = np.empty(most * widest, h_pl.dtype), np.empty(6 * widest, h_pl.dtype)
    for s in range(len(first) - 1):
        count = 0
        for p in range(first[s], first[s + 1]):
            k = by_source[p]
            for o in range(start[k], start[k + 1]):
                place[keys[o] - k * free] = 0
        for f in range(free):
            if place[f] == 0:
                place[f] = count
                members[count] = f
                count += 1
        stride = -(-6 * count // _COLUMNS) * _COLUMNS
        used = 0
        for p in range(first[s], first[s + 1]):
            k = by_source[p]
            if start[k] == start[k + 1]:
                continue
            root, row = math.sqrt(q[k]), used * stride
            for c in range(stride):
                w[row + c] = real(0)
            for o in range(start[k], start[k + 1]):
                to = row + 6 * place[keys[o] - k * free]
                for i in range(6):
                    w[to + i] = h_pl[o, i] * root
            used += 1
        for a in range(count):
            place[members[a]] = -1
            for column in range(0, 6 * (a + 1), _COLUMNS):
                _add_up(w, used, stride, 6 * a, column, total, column)  # type: ignore[call-arg]
            search = row_start[members[a]]
            for b in range(a + 1):
                key = members[a] * free + members[b]
                while pattern[search] < key:
                    search += 1
                for i in range(6):
                    for c in range(6):
                        blocks[search, i, c] -= total[i * stride + 6 * b + c]


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
