"""Kernels of :func:`dvo.nets.update.fast_update.revise_by_kernels`: all of an update but its matrix products.

Arrays of ``(E, D)`` features are of float32, or hold bits of bfloat16 as uint16; all is computed in float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from dvo.core.compiled import compiled, part
from dvo.core.number_kernels import number, stored

Array = Any


@intrinsic
def _power_of_two(context, exponent):
    """Float32 that is two to the power of an int32, of -126 to 127."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        bits = builder.add(given[0], ir.Constant(given[0].type, 127))
        return builder.bitcast(builder.shl(bits, ir.Constant(bits.type, 23)), ir.FloatType())

    return types.float32(types.int32), generate


@part
def exponential(x):
    """Exponential of a float32, to two units in the last place, in instructions that vectors have too.

    Cephes' polynomial (Moshier) behind a power of two. 0 below -87, NaN stays.
    """
    x = np.float32(-87.5) if x < np.float32(-87.5) else x
    x = np.float32(88) if x > np.float32(88) else x
    whole = np.floor(x * np.float32(1.44269504) + np.float32(0.5))
    r = x - whole * np.float32(0.693359375) + whole * np.float32(2.12194440e-4)
    p = np.float32(1.9875691500e-4) * r + np.float32(1.3981999507e-3)
    p = p * r + np.float32(8.3334519073e-3)
    p = p * r + np.float32(4.1665795894e-2)
    p = p * r + np.float32(1.6666665459e-1)
    p = p * r + np.float32(5.0000001201e-1)
    return (p * r * r + r + np.float32(1)) * _power_of_two(np.int32(whole))  # type: ignore[call-arg]


@part
def _normalise(row, weight, bias, eps, low, out):
    """Layer normalisation of a row of float32 into one that is kept; values below ``low`` become it."""
    count = len(row)
    mean = np.float32(0)
    for c in range(count):
        mean += row[c]
    mean /= np.float32(count)
    square = np.float32(0)
    for c in range(count):
        square += (row[c] - mean) * (row[c] - mean)
    factor = np.float32(1) / np.sqrt(square / np.float32(count) + np.float32(eps))
    for c in range(count):
        value = (row[c] - mean) * factor * number(weight[c]) + number(bias[c])  # type: ignore[call-arg]
        out[c] = stored(low if value < low else value, out[c])


@compiled
def join(hidden: Array, context: Array, seen: Array, weight: Array, bias: Array, eps: float, out: Array) -> None:
    """Fill ``out`` with the normalised sum of state and context, both ``(E, D)`` float32, and encoded correlation."""
    row = np.empty(out.shape[1], np.float32)
    for e in range(len(out)):
        for c in range(len(row)):
            row[c] = hidden[e, c] + context[e, c] + number(seen[e, c])  # type: ignore[call-arg]
        _normalise(row, weight, bias, eps, np.float32(-np.inf), out[e])


@compiled
def normalise(x: Array, weight: Array, bias: Array, eps: float, rectified: bool) -> None:
    """Layer normalisation of the rows of ``x`` in place, perhaps with a rectifier."""
    row, low = np.empty(x.shape[1], np.float32), np.float32(0) if rectified else np.float32(-np.inf)
    for e in range(len(x)):
        for c in range(len(row)):
            row[c] = number(x[e, c])  # type: ignore[call-arg]
        _normalise(row, weight, bias, eps, low, x[e])


@part
def _add(row, further):
    for c in range(len(row)):
        row[c] = stored(number(row[c]) + number(further[c]), row[c])  # type: ignore[call-arg]


@compiled
def neighbours(x: Array, added: Array, index: Array, has: Array, out: Array) -> None:
    """Add ``added`` to ``x``, if there is any, and fill ``out`` with its rows at ``index``, or 0 without ``has``."""
    for e in range(len(added)):
        _add(x[e], added[e])
    for e in range(len(x)):  # numba takes two seconds to compile an assignment of rows
        for c in range(x.shape[1]):
            out[e, c] = x[index[e], c] if has[e] else out.dtype.type(0)


@compiled
def add(x: Array, further: Array) -> None:
    """Add to the rows of ``x``, in place."""
    for e in range(len(x)):
        _add(x[e], further[e])


@compiled
def pool(value: Array, score: Array, members: Array, real: Array, out: Array) -> None:
    """Fill ``out (G, D)`` with the sums of the values of each group, weighted by a softmax of their scores.

    ``members (G, M)`` rows, of which those count that ``real (G, M)`` says.
    """
    channels = out.shape[1]
    most, total, held = np.empty(channels, np.float32), np.empty(channels, np.float32), np.empty(channels, np.float32)
    for g in range(len(out)):
        most[:] = -np.inf
        for m in range(members.shape[1]):
            if real[g, m]:
                own = score[members[g, m]]
                for c in range(channels):
                    most[c] = max(most[c], number(own[c]))  # type: ignore[call-arg]
        total[:] = 0
        held[:] = 0
        for m in range(members.shape[1]):
            if real[g, m]:
                own, given = score[members[g, m]], value[members[g, m]]
                for c in range(channels):
                    share = exponential(number(own[c]) - most[c])  # type: ignore[call-arg]
                    total[c] += share
                    held[c] += share * number(given[c])
        for c in range(channels):
            out[g, c] = stored(held[c] / total[c], out[g, c])  # type: ignore[call-arg]


@compiled
def spread(x: Array, pooled: Array, group: Array) -> None:
    """Add to each row of ``x`` that of its group, in place."""
    for e in range(len(x)):
        _add(x[e], pooled[group[e]])


@compiled
def gate(x: Array, gates: Array, residual: Array, weight: Array, bias: Array, eps: float) -> None:
    """Add a residual by the sigmoid of its gates to ``x``, in place; normalise the sum unless ``weight`` is empty."""
    channels = x.shape[1]
    row = np.empty(channels, np.float32)
    for e in range(len(x)):
        for c in range(channels):
            share = np.float32(1) / (np.float32(1) + exponential(-number(gates[e, c])))  # type: ignore[call-arg]
            row[c] = number(x[e, c]) + share * number(residual[e, c])
        if len(weight):
            _normalise(row, weight, bias, eps, np.float32(-np.inf), x[e])
        else:
            for c in range(channels):
                x[e, c] = stored(row[c], x[e, c])  # type: ignore[call-arg]
