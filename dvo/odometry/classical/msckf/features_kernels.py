"""Kernels of :mod:`dvo.odometry.classical.msckf.features`: triangulation, and projection to null spaces."""

from __future__ import annotations

import math

import numpy as np

from dvo.core.compiled import compiled, part


@part
def _solve(A, b, x):
    """``A x = b`` for a symmetric ``(3, 3)`` matrix; False if it is singular."""
    c00 = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
    c01 = A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
    c02 = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    determinant = A[0, 0] * c00 + A[0, 1] * c01 + A[0, 2] * c02
    size = A[0, 0] + A[1, 1] + A[2, 2]
    if not determinant > 1e-13 * size * size * size:
        return False
    c11 = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]
    c12 = A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]
    c22 = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    x[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant
    x[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / determinant
    x[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / determinant
    return True


@part
def _cost(state, xy, turn, shift, begin, end):
    """Sum of squares of the residuals of a point."""
    total = 0.0
    for k in range(begin, end):
        x = turn[k, 0, 0] * state[0] + turn[k, 0, 1] * state[1] + turn[k, 0, 2] + state[2] * shift[k, 0]
        y = turn[k, 1, 0] * state[0] + turn[k, 1, 1] * state[1] + turn[k, 1, 2] + state[2] * shift[k, 1]
        z = turn[k, 2, 0] * state[0] + turn[k, 2, 1] * state[1] + turn[k, 2, 2] + state[2] * shift[k, 2]
        if z < 1e-3:
            total += 10.0
            z = 1e-3
        total += (xy[k, 0] - x / z) ** 2 + (xy[k, 1] - y / z) ** 2
    return total


@compiled
def triangulate(begins, xy, R, p, nearest, farthest, rounds, points, good):
    """Fill ``points (M, 3)`` and ``good (M,)``; observations of point m are ``begins[m]`` to ``begins[m + 1]``."""
    turn, shift = np.empty(R.shape), np.empty(p.shape)
    A, b, x, state, trial = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    J, damped = np.empty((2, 3)), np.empty((3, 3))
    for m in range(len(begins) - 1):
        begin, end = begins[m], begins[m + 1]
        # Closest point to the rays, then its place in the first camera.
        A[:] = 0.0
        b[:] = 0.0
        for k in range(begin, end):
            d0 = R[k, 0, 0] * xy[k, 0] + R[k, 0, 1] * xy[k, 1] + R[k, 0, 2]
            d1 = R[k, 1, 0] * xy[k, 0] + R[k, 1, 1] * xy[k, 1] + R[k, 1, 2]
            d2 = R[k, 2, 0] * xy[k, 0] + R[k, 2, 1] * xy[k, 1] + R[k, 2, 2]
            n = d0 * d0 + d1 * d1 + d2 * d2
            q0, q1, q2 = p[k, 0] - p[begin, 0], p[k, 1] - p[begin, 1], p[k, 2] - p[begin, 2]
            along = (d0 * q0 + d1 * q1 + d2 * q2) / n
            A[0, 0] += 1 - d0 * d0 / n
            A[1, 1] += 1 - d1 * d1 / n
            A[2, 2] += 1 - d2 * d2 / n
            A[0, 1] -= d0 * d1 / n
            A[0, 2] -= d0 * d2 / n
            A[1, 2] -= d1 * d2 / n
            b[0] += q0 - d0 * along
            b[1] += q1 - d1 * along
            b[2] += q2 - d2 * along
            for i in range(3):
                for j in range(3):
                    turn[k, i, j] = (
                        R[k, 0, i] * R[begin, 0, j] + R[k, 1, i] * R[begin, 1, j] + R[k, 2, i] * R[begin, 2, j]
                    )
                shift[k, i] = -(R[k, 0, i] * q0 + R[k, 1, i] * q1 + R[k, 2, i] * q2)
        state[0], state[1], state[2] = xy[begin, 0], xy[begin, 1], 0.1
        if _solve(A, b, x):
            depth = R[begin, 0, 2] * x[0] + R[begin, 1, 2] * x[1] + R[begin, 2, 2] * x[2]
            if depth > nearest:
                state[0] = (R[begin, 0, 0] * x[0] + R[begin, 1, 0] * x[1] + R[begin, 2, 0] * x[2]) / depth
                state[1] = (R[begin, 0, 1] * x[0] + R[begin, 1, 1] * x[1] + R[begin, 2, 1] * x[2]) / depth
                state[2] = min(max(1 / depth, 1 / farthest), 1 / nearest)
        now, damping = _cost(state, xy, turn, shift, begin, end), 1e-4
        for _ in range(rounds):
            A[:] = 0.0
            b[:] = 0.0
            for k in range(begin, end):
                u = turn[k, 0, 0] * state[0] + turn[k, 0, 1] * state[1] + turn[k, 0, 2] + state[2] * shift[k, 0]
                v = turn[k, 1, 0] * state[0] + turn[k, 1, 1] * state[1] + turn[k, 1, 2] + state[2] * shift[k, 1]
                w = turn[k, 2, 0] * state[0] + turn[k, 2, 1] * state[1] + turn[k, 2, 2] + state[2] * shift[k, 2]
                w = max(w, 1e-3)
                for j in range(3):
                    c0 = turn[k, 0, j] if j < 2 else shift[k, 0]
                    c1 = turn[k, 1, j] if j < 2 else shift[k, 1]
                    c2 = turn[k, 2, j] if j < 2 else shift[k, 2]
                    J[0, j] = (c0 - c2 * u / w) / w
                    J[1, j] = (c1 - c2 * v / w) / w
                e0, e1 = xy[k, 0] - u / w, xy[k, 1] - v / w
                for i in range(3):
                    b[i] += J[0, i] * e0 + J[1, i] * e1
                    for j in range(3):
                        A[i, j] += J[0, i] * J[0, j] + J[1, i] * J[1, j]
            size = (A[0, 0] + A[1, 1] + A[2, 2]) / 3
            damped[:] = A
            for i in range(3):
                damped[i, i] += damping * size + 1e-12
            if not _solve(damped, b, x):
                break
            for i in range(3):
                trial[i] = state[i] + x[i]
            trial[2] = min(max(trial[2], 1 / farthest), 1 / nearest)
            after = _cost(trial, xy, turn, shift, begin, end)
            if after < now:
                gain = now - after
                state[:] = trial
                now, damping = after, 0.1 * damping
                if gain < 1e-6 * now:
                    break
            else:
                damping *= 10
        usable = 1.01 / farthest < state[2] < 0.99 / nearest
        for k in range(begin, end):
            z = turn[k, 2, 0] * state[0] + turn[k, 2, 1] * state[1] + turn[k, 2, 2] + state[2] * shift[k, 2]
            usable = usable and z > nearest * state[2]
        good[m] = usable
        for i in range(3):
            ray = R[begin, i, 0] * state[0] + R[begin, i, 1] * state[1] + R[begin, i, 2]
            points[m, i] = p[begin, i] + ray / state[2]


@compiled
def project(begins, columns, by_pose, by_point, others, residual, places, rows, jacobian, out):
    """Householder reflections that leave the point Jacobian three rows; the rest goes into ``jacobian`` and ``out``.

    ``columns (K,)``: first column of the pose of every observation; ``others (K, 2, E)``: derivatives by the columns
    ``places (E,)``; ``rows (M,)``: first row of every point in ``jacobian`` and ``out``, which are zero.
    """
    extra = len(places)
    for m in range(len(begins) - 1):
        begin, end = begins[m], begins[m + 1]
        count, wide = 2 * (end - begin), 6 * (end - begin) + extra + 1
        A, H = np.empty((count, 3)), np.zeros((count, wide))
        for k in range(end - begin):
            for side in range(2):
                row = 2 * k + side
                for i in range(3):
                    A[row, i] = by_point[begin + k, side, i]
                for i in range(6):
                    H[row, 6 * k + i] = by_pose[begin + k, side, i]
                for i in range(extra):
                    H[row, wide - 1 - extra + i] = others[begin + k, side, i]
                H[row, wide - 1] = residual[begin + k, side]
        for j in range(3):
            square = 0.0
            for i in range(j, count):
                square += A[i, j] * A[i, j]
            if square < 1e-30:
                continue
            alpha = -math.copysign(math.sqrt(square), A[j, j])
            norm = square - alpha * A[j, j]  # half the square of the reflection's vector
            A[j, j] -= alpha
            for c in range(j + 1, 3):
                dot = 0.0
                for i in range(j, count):
                    dot += A[i, j] * A[i, c]
                for i in range(j, count):
                    A[i, c] -= A[i, j] * dot / norm
            for c in range(wide):
                dot = 0.0
                for i in range(j, count):
                    dot += A[i, j] * H[i, c]
                dot /= norm
                for i in range(j, count):
                    H[i, c] -= A[i, j] * dot
        for i in range(3, count):
            row = rows[m] + i - 3
            for k in range(end - begin):
                for c in range(6):
                    jacobian[row, columns[begin + k] + c] += H[i, 6 * k + c]
            for c in range(extra):
                jacobian[row, places[c]] += H[i, wide - 1 - extra + c]
            out[row] = H[i, wide - 1]
