"""Kernel of :func:`dvo.odometry.checks.floating_crop.fitted_cost`."""

from __future__ import annotations

import math

import numpy as np

from dvo.core.compiled import compiled, part


@part
def _distances(x, first, second, rotation, towards, aside, out):
    """Sampson distances at ``x (7,)``: turn, direction, shift."""
    square = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
    angle = math.sqrt(square)
    half = math.sin(0.5 * angle)
    s, c = (math.sin(angle) / angle, 2 * half * half / square) if angle > 1e-12 else (1.0, 0.5)
    turn, essential, d = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for k in range(3):  # each column of the rotation, turned
        a, b, e = rotation[0, k], rotation[1, k], rotation[2, k]
        u0, u1, u2 = x[1] * e - x[2] * b, x[2] * a - x[0] * e, x[0] * b - x[1] * a
        turn[0, k] = a + s * u0 + c * (x[1] * u2 - x[2] * u1)
        turn[1, k] = b + s * u1 + c * (x[2] * u0 - x[0] * u2)
        turn[2, k] = e + s * u2 + c * (x[0] * u1 - x[1] * u0)
    for i in range(3):
        d[i] = towards[i] + x[3] * aside[0, i] + x[4] * aside[1, i]
    length = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    for i in range(3):
        d[i] /= length
    for k in range(3):
        essential[0, k] = d[1] * turn[2, k] - d[2] * turn[1, k]
        essential[1, k] = d[2] * turn[0, k] - d[0] * turn[2, k]
        essential[2, k] = d[0] * turn[1, k] - d[1] * turn[0, k]
    for n in range(len(first)):
        ax, ay = first[n, 0], first[n, 1]
        bx, by = second[n, 0] - x[5], second[n, 1] - x[6]
        l0 = essential[0, 0] * ax + essential[0, 1] * ay + essential[0, 2]
        l1 = essential[1, 0] * ax + essential[1, 1] * ay + essential[1, 2]
        l2 = essential[2, 0] * ax + essential[2, 1] * ay + essential[2, 2]
        m0 = essential[0, 0] * bx + essential[1, 0] * by + essential[2, 0]
        m1 = essential[0, 1] * bx + essential[1, 1] * by + essential[2, 1]
        gradient = l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1
        out[n] = (bx * l0 + by * l1 + l2) / math.sqrt(max(gradient, 1e-18))


@part
def _cost(distances, scale, width):
    logarithms, product = 0.0, 1.0  # one logarithm for many distances
    for r in distances:
        product *= 1 + (r / scale) ** 2
        if product > 1e150:
            logarithms, product = logarithms + math.log(product), 1.0
    return width * width * (logarithms + math.log(product))


@compiled
def fit(first, second, rotation, towards, aside, unknowns, scale, width, iterations, delta, tolerance, strongest):
    """Cost of the best ``unknowns`` first numbers (Levenberg-Marquardt)."""
    count = len(first)
    x, step, near = np.zeros(7), np.zeros(7), np.zeros(7)
    now, after, beside = np.empty(count), np.empty(count), np.empty(count)
    jacobian = np.empty((unknowns, count))
    normal, lifted, gradient = np.empty((unknowns, unknowns)), np.empty((unknowns, unknowns)), np.empty(unknowns)
    _distances(x, first, second, rotation, towards, aside, now)
    cost, damping = _cost(now, scale, width), 1e-3
    for _ in range(iterations):
        for i in range(unknowns):
            for k in range(7):
                near[k] = x[k]
            near[i] += delta
            _distances(near, first, second, rotation, towards, aside, beside)
            for n in range(count):
                jacobian[i, n] = (beside[n] - now[n]) / delta
        for n in range(count):
            beside[n] = 1 / (1 + (now[n] / scale) ** 2)
        for i in range(unknowns):
            gradient[i] = 0
            for n in range(count):
                gradient[i] += jacobian[i, n] * beside[n] * now[n]
            for j in range(i + 1):
                total = 0.0
                for n in range(count):
                    total += jacobian[i, n] * beside[n] * jacobian[j, n]
                normal[i, j] = total
        before, better = cost, False
        while damping < strongest and not better:
            solvable = True
            for i in range(unknowns):  # Cholesky, then substitution
                for j in range(i + 1):
                    total = normal[i, j] + (damping * (normal[i, i] + 1e-12) if i == j else 0.0)
                    for k in range(j):
                        total -= lifted[i, k] * lifted[j, k]
                    if i == j:
                        solvable = solvable and total > 0
                        lifted[i, i] = math.sqrt(total) if total > 0 else 1.0
                    else:
                        lifted[i, j] = total / lifted[j, j]
            for i in range(7):
                step[i] = x[i]
            for i in range(unknowns):
                total = gradient[i]
                for k in range(i):
                    total -= lifted[i, k] * near[k]
                near[i] = total / lifted[i, i]
            for i in range(unknowns - 1, -1, -1):
                for k in range(i + 1, unknowns):
                    near[i] -= lifted[k, i] * near[k]
                near[i] /= lifted[i, i]
                step[i] = x[i] - near[i]
            _distances(step, first, second, rotation, towards, aside, after)
            found = _cost(after, scale, width)
            if solvable and found < cost:
                for i in range(7):
                    x[i] = step[i]
                for n in range(count):
                    now[n] = after[n]
                cost, damping, better = found, damping / 5, True
            else:
                damping *= 8
        if not better or before - cost <= tolerance * cost:
            break
    return cost
