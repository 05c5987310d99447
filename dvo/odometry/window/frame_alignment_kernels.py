"""Compiled motion-only adjustment; :func:`dvo.odometry.window.frame_alignment.solve_pose_plain` is its twin."""

from __future__ import annotations

import numpy as np

from dvo.core.compiled import compiled, part


@compiled
def solve_pose_kernel(points, measured, weights, camera, pose, widths, iterations, nearest, tolerance):
    """See the twin; all arrays are float64 and contiguous, ``pose (4, 4)`` is changed in place."""
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    count = len(points)
    h, g, j = np.empty((6, 6)), np.empty(6), np.empty((2, 6))
    for width in widths:
        for _ in range(iterations):
            for k in range(6):
                g[k] = 0.0
                for m in range(6):
                    h[k, m] = 0.0
            closest = 0.0
            for e in range(count):
                p0, p1, p2 = points[e, 0], points[e, 1], points[e, 2]
                x = pose[0, 0] * p0 + pose[0, 1] * p1 + pose[0, 2] * p2 + pose[0, 3]
                y = pose[1, 0] * p0 + pose[1, 1] * p1 + pose[1, 2] * p2 + pose[1, 3]
                z = pose[2, 0] * p0 + pose[2, 1] * p1 + pose[2, 2] * p2 + pose[2, 3]
                q = 1.0 / max(z, nearest)
                closest = max(closest, q)
                if z <= nearest:
                    continue
                a, b = x * q, y * q
                r0, r1 = measured[e, 0] - (a * fx + cx), measured[e, 1] - (b * fy + cy)
                robust = 1.0 / (1.0 + (r0 * r0 + r1 * r1) / (width * width))
                j[0, 0], j[0, 1], j[0, 2] = fx * q, 0.0, -fx * a * q
                j[0, 3], j[0, 4], j[0, 5] = -fx * a * b, fx * (1.0 + a * a), -fx * b
                j[1, 0], j[1, 1], j[1, 2] = 0.0, fy * q, -fy * b * q
                j[1, 3], j[1, 4], j[1, 5] = -fy * (1.0 + b * b), fy * a * b, fy * a
                w0, w1 = weights[e, 0] * robust, weights[e, 1] * robust
                for k in range(6):
                    g[k] += j[0, k] * w0 * r0 + j[1, k] * w1 * r1
                    for m in range(k + 1):
                        h[k, m] += j[0, k] * w0 * j[0, m] + j[1, k] * w1 * j[1, m]
            damping = 0.0
            for k in range(6):
                damping += h[k, k]
            damping = 1e-6 * damping / 6.0 + 1e-12
            # Cholesky in place, and the two substitutions.
            for k in range(6):
                h[k, k] += damping
                for m in range(k + 1):
                    total = h[k, m]
                    for i in range(m):
                        total -= h[k, i] * h[m, i]
                    h[k, m] = np.sqrt(total) if k == m else total / h[m, m]
            for k in range(6):
                for i in range(k):
                    g[k] -= h[k, i] * g[i]
                g[k] /= h[k, k]
            for k in range(5, -1, -1):
                for i in range(k + 1, 6):
                    g[k] -= h[i, k] * g[i]
                g[k] /= h[k, k]
            _move(pose, g)
            turn, shift = 0.0, 0.0
            for k in range(3):
                shift, turn = max(shift, abs(g[k])), max(turn, abs(g[k + 3]))
            if turn < tolerance and shift * closest < tolerance:
                break


@part
def _move(pose, step):
    """``Exp(step) pose`` in place."""
    x, y, z = step[3], step[4], step[5]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < 1e-4:
        a, b, c = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        a, b, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square, (angle - np.sin(angle)) / (square * angle)
    turn, left, w, before = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 4))
    w[0, 0], w[0, 1], w[0, 2] = 0.0, -z, y
    w[1, 0], w[1, 1], w[1, 2] = z, 0.0, -x
    w[2, 0], w[2, 1], w[2, 2] = -y, x, 0.0
    for i in range(3):
        for k in range(3):
            twice = 0.0
            for m in range(3):
                twice += w[i, m] * w[m, k]
            one = 1.0 if i == k else 0.0
            turn[i, k] = one + a * w[i, k] + b * twice
            left[i, k] = one + b * w[i, k] + c * twice
    for i in range(3):
        for k in range(4):
            before[i, k] = pose[i, k]
    for i in range(3):
        for k in range(4):
            total = 0.0
            for m in range(3):
                total += turn[i, m] * before[m, k]
            pose[i, k] = total
        for m in range(3):
            pose[i, 3] += left[i, m] * step[m]
