"""Kernels of :func:`dvo.ba.points.solve_points`. All float64.

Shapes: ``C`` cameras, ``K`` points, ``O`` observations, ``P`` unknowns of the cameras that are not fixed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dvo.core.compiled import compiled, part

Array = np.ndarray[Any, Any]


@compiled
def by_point(camera: Array, point: Array, cameras: int, points: int) -> tuple[bool, Array, Array]:
    """Sort observations by their points.

    Args:
        camera, point: ``(O,)`` of each observation.
        cameras, points: their numbers.

    Returns:
        False if an index is out of range; observations in the order of the points ``(O,)``; first of each point, and
        their number at last, ``(K + 1,)``.
    """
    order, start = np.empty(len(point), np.int64), np.zeros(points + 1, np.int64)
    for o in range(len(point)):
        if not (0 <= camera[o] < cameras and 0 <= point[o] < points):
            return False, order, start
        start[point[o] + 1] += 1
    for k in range(points):
        start[k + 1] += start[k]
    at = start.copy()
    for o in range(len(point)):
        order[at[point[o]]] = o
        at[point[o]] += 1
    return True, order, start


@part
def _observed(
    rotations: Array, poses: Array, intrinsics: Array, radial: Array, points: Array, pixels: Array, c: int, k: int,
    o: int, jacobian: Array,
) -> tuple[float, float]:  # fmt: skip
    """Residual of observation ``o``; ``jacobian (2, 9)`` by camera and point is filled if it has a row."""
    x0, x1, x2 = points[k, 0], points[k, 1], points[k, 2]
    sx = rotations[c, 0, 0] * x0 + rotations[c, 0, 1] * x1 + rotations[c, 0, 2] * x2 + poses[c, 0]
    sy = rotations[c, 1, 0] * x0 + rotations[c, 1, 1] * x1 + rotations[c, 1, 2] * x2 + poses[c, 1]
    z = rotations[c, 2, 0] * x0 + rotations[c, 2, 1] * x1 + rotations[c, 2, 2] * x2 + poses[c, 2]
    k1, k2 = radial[c, 0], radial[c, 1]
    sz = z
    if abs(z) < 1e-12:
        z = 1e-12
    u, v = sx / z, sy / z
    r2 = u * u + v * v
    scale = 1 + r2 * (k1 + r2 * k2)
    if len(jacobian):
        bend = 2 * (k1 + 2 * k2 * r2)
        xx, xy, yy = bend * u * u + scale, bend * u * v, bend * v * v + scale
        for row in range(2):
            along, across = (xx, xy) if row == 0 else (xy, yy)
            b0, b1 = intrinsics[c, row] * along / z, intrinsics[c, row] * across / z
            b2 = -(b0 * u + b1 * v)
            jacobian[row, 0], jacobian[row, 1], jacobian[row, 2] = b0, b1, b2
            jacobian[row, 3], jacobian[row, 4] = b2 * sy - b1 * sz, b0 * sz - b2 * sx
            jacobian[row, 5] = b1 * sx - b0 * sy
            for a in range(3):
                jacobian[row, 6 + a] = b0 * rotations[c, 0, a] + b1 * rotations[c, 1, a] + b2 * rotations[c, 2, a]
    x, y = intrinsics[c, 0] * scale * u + intrinsics[c, 2], intrinsics[c, 1] * scale * v + intrinsics[c, 3]
    return pixels[o, 0] - x, pixels[o, 1] - y


@compiled
def half_squares(
    rotations: Array, poses: Array, intrinsics: Array, radial: Array, points: Array, camera: Array, point: Array,
    pixels: Array,
) -> float:  # fmt: skip
    """Half the sum of squared residuals.

    Args:
        rotations: ``(C, 3, 3)`` of the poses.
        poses, intrinsics, radial, points, camera, point, pixels: see :class:`dvo.ba.bal.PointProblem`.
    """
    total, none = 0.0, np.empty((0, 9))
    for o in range(len(camera)):
        c = camera[o]
        x, y = _observed(rotations, poses, intrinsics, radial, points, pixels, c, point[o], o, none)
        total += x * x + y * y
    return total / 2


@part
def _inverse(h: Array, q: Array) -> None:
    """Inverse of a positive definite ``(3, 3)``, of which the lower triangle is read; zero if it is not one."""
    q.fill(0.0)
    if not h[0, 0] > 0:
        return
    a = math.sqrt(h[0, 0])
    b, c = h[1, 0] / a, h[2, 0] / a
    d = h[1, 1] - b * b
    if not d > 0:
        return
    d = math.sqrt(d)
    e = (h[2, 1] - b * c) / d
    f = h[2, 2] - c * c - e * e
    if not (f > 0 and f < math.inf):
        return
    f = math.sqrt(f)
    # L^-1, then L^-T L^-1
    i00, i11, i22 = 1 / a, 1 / d, 1 / f
    i10, i21 = -b * i00 * i11, -e * i11 * i22
    i20 = -(c * i00 + e * i10) * i22
    q[0, 0], q[1, 1], q[2, 2] = i00 * i00 + i10 * i10 + i20 * i20, i11 * i11 + i21 * i21, i22 * i22
    q[1, 0] = q[0, 1] = i10 * i11 + i20 * i21
    q[2, 0] = q[0, 2] = i20 * i22
    q[2, 1] = q[1, 2] = i21 * i22


@compiled
def reduced_points(
    rotations: Array,
    poses: Array,
    intrinsics: Array,
    radial: Array,
    points: Array,
    camera: Array,
    pixels: Array,
    order: Array,
    start: Array,
    fixed: int,
    damping: float,
    low: float,
    high: float,
    s: Array,
    x: Array,
    g_p: Array,
    d_p: Array,
    mixed: Array,
    q: Array,
    g_l: Array,
    d_l: Array,
) -> None:
    """Linearise, damp and eliminate the points.

    Args:
        rotations: ``(C, 3, 3)`` of the poses.
        poses, intrinsics, radial, points, camera, pixels: see :class:`dvo.ba.bal.PointProblem`.
        order, start: of :func:`by_point`.
        fixed: number of leading cameras that stay.
        damping: fraction of the diagonal, which is taken within ``low`` and ``high``.
        s: ``(P, P)`` lower triangle of the reduced system. x, g_p, d_p: ``(P,)`` its right-hand side, the gradient and
            the damping. mixed: ``(O, 3, 6)`` in the order of the points. q: ``(K, 3, 3)`` inverse blocks. g_l, d_l:
            ``(K, 3)``. All are given as zeros and filled.
    """
    jacobian, h, w = np.empty((2, 9)), np.empty((3, 3)), np.empty((6, 3))
    for k in range(len(points)):
        h.fill(0.0)
        for at in range(start[k], start[k + 1]):
            o = order[at]
            c = camera[o]
            rx, ry = _observed(rotations, poses, intrinsics, radial, points, pixels, c, k, o, jacobian)
            jx, jy = jacobian[0], jacobian[1]
            for a in range(3):
                g_l[k, a] += jx[6 + a] * rx + jy[6 + a] * ry
                for b in range(a + 1):
                    h[a, b] += jx[6 + a] * jx[6 + b] + jy[6 + a] * jy[6 + b]
            row = 6 * (c - fixed)
            if row < 0:
                continue
            for a in range(6):
                g_p[row + a] += jx[a] * rx + jy[a] * ry
                for b in range(a + 1):
                    s[row + a, row + b] += jx[a] * jx[b] + jy[a] * jy[b]
                for b in range(3):
                    mixed[at, b, a] = jx[a] * jx[6 + b] + jy[a] * jy[6 + b]
        for a in range(3):
            d_l[k, a] = damping * min(max(h[a, a], low), high)
            h[a, a] += d_l[k, a]
        _inverse(h, q[k])
    for a in range(len(x)):
        x[a] = g_p[a]
        d_p[a] = damping * min(max(s[a, a], low), high)
        s[a, a] += d_p[a]
    for k in range(len(points)):
        inverse = q[k]
        for at in range(start[k], start[k + 1]):
            row = 6 * (camera[order[at]] - fixed)
            if row < 0:
                continue
            for a in range(6):
                m0, m1, m2 = mixed[at, 0, a], mixed[at, 1, a], mixed[at, 2, a]
                for b in range(3):
                    w[a, b] = m0 * inverse[0, b] + m1 * inverse[1, b] + m2 * inverse[2, b]
                x[row + a] -= w[a, 0] * g_l[k, 0] + w[a, 1] * g_l[k, 1] + w[a, 2] * g_l[k, 2]
            for other in range(start[k], start[k + 1]):
                column = 6 * (camera[order[other]] - fixed)
                if column < 0 or column > row:
                    continue
                for a in range(6):
                    w0, w1, w2 = w[a, 0], w[a, 1], w[a, 2]
                    for b in range(6):
                        update = w0 * mixed[other, 0, b] + w1 * mixed[other, 1, b] + w2 * mixed[other, 2, b]
                        s[row + a, column + b] -= update


@compiled
def point_steps(
    camera: Array, order: Array, start: Array, fixed: int, mixed: Array, q: Array, g_l: Array, d_l: Array, dp: Array,
    dl: Array,
) -> float:  # fmt: skip
    """Steps of the points from those of the cameras.

    Args:
        camera, order, start, fixed, mixed, q, g_l, d_l: see :func:`reduced_points`.
        dp: ``(P,)`` steps of the cameras. dl: ``(K, 3)``, filled.

    Returns:
        Sum of ``dl (d_l dl + g_l)``, twice the decrease of the cost that the points are expected to bring.
    """
    total, rest = 0.0, np.empty(3)
    for k in range(len(g_l)):
        for b in range(3):
            rest[b] = g_l[k, b]
        for at in range(start[k], start[k + 1]):
            row = 6 * (camera[order[at]] - fixed)
            if row < 0:
                continue
            for a in range(6):
                for b in range(3):
                    rest[b] -= mixed[at, b, a] * dp[row + a]
        for a in range(3):
            step = q[k, a, 0] * rest[0] + q[k, a, 1] * rest[1] + q[k, a, 2] * rest[2]
            dl[k, a] = step
            total += step * (d_l[k, a] * step + g_l[k, a])
    return total
