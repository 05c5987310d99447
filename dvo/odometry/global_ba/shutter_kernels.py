"""Kernel of :func:`dvo.odometry.global_ba.rolling_shutter.as_global_shutter`."""

from __future__ import annotations

import math

import numpy as np

from dvo.core.compiled import compiled, part


@part
def _undo(x, y, depth, fx, fy, cx, cy, nodes, twists, offset, nearest, out):
    """Position, pixels, and depth at the time of the frame of what was seen at another time, into ``out (3,)``."""
    tau0 = tau1 = tau2 = phi0 = phi1 = phi2 = 0.0
    for k in range(len(nodes)):  # Lagrange's basis polynomials
        basis = 1.0
        for other in range(len(nodes)):
            if other != k:
                basis = basis * (offset - nodes[other]) / (nodes[k] - nodes[other])
        # The inverse of the motion is that of the negative twist.
        tau0, tau1, tau2 = tau0 - basis * twists[k, 0], tau1 - basis * twists[k, 1], tau2 - basis * twists[k, 2]
        phi0, phi1, phi2 = phi0 - basis * twists[k, 3], phi1 - basis * twists[k, 4], phi2 - basis * twists[k, 5]
    square = phi0 * phi0 + phi1 * phi1 + phi2 * phi2
    if square < 1e-4:
        a = 1 - square / 6 * (1 - square / 20 * (1 - square / 42))
        b = 0.5 - square / 24 * (1 - square / 30 * (1 - square / 56))
        c = 1 / 6 - square / 120 * (1 - square / 42 * (1 - square / 72))
    else:
        angle = math.sqrt(square)
        a, half = math.sin(angle) / angle, math.sin(0.5 * angle)
        b, c = 2 * half * half / square, (1 - a) / square
    p0, p1, p2 = (x - cx) / fx * depth, (y - cy) / fy * depth, depth
    u0, u1, u2 = phi1 * p2 - phi2 * p1, phi2 * p0 - phi0 * p2, phi0 * p1 - phi1 * p0
    v0, v1, v2 = phi1 * tau2 - phi2 * tau1, phi2 * tau0 - phi0 * tau2, phi0 * tau1 - phi1 * tau0
    s0, s1, s2 = a * u0 + b * v0, a * u1 + b * v1, a * u2 + b * v2
    d0, d1, d2 = b * u0 + c * v0, b * u1 + c * v1, b * u2 + c * v2
    q0 = p0 + tau0 + s0 + phi1 * d2 - phi2 * d1
    q1 = p1 + tau1 + s1 + phi2 * d0 - phi0 * d2
    q2 = p2 + tau2 + s2 + phi0 * d1 - phi1 * d0
    q2 = nearest if q2 < nearest else q2
    out[0], out[1], out[2] = q0 / q2 * fx + cx, q1 / q2 * fy + cy, q2


@compiled
def global_shutter(
    rotation,
    translation,
    intrinsics,
    centres,
    depth,
    targets,
    ii,
    jj,
    kk,
    frames,
    times,
    twists,
    readout,
    rows,
    nearest,
):
    """Patch centres ``(K, 2)`` and targets ``(E, 2)`` that a global shutter would have seen."""
    k, e = len(centres), len(targets)
    per_frame = max(k // max(len(rotation), 1), 1)
    middle, per_row = (rows - 0.25) / 2, readout / rows
    xy, far, moved = np.empty((k, 2)), np.empty(k), np.empty((e, 2))
    out = np.empty(3)
    for n in range(k):
        i = n // per_frame
        fx, fy, cx, cy = intrinsics[i]
        x, y, f = centres[n, 0], centres[n, 1], frames[i]
        _undo(x, y, 1 / depth[n], fx, fy, cx, cy, times[f], twists[f], (y - middle) * per_row, nearest, out)
        xy[n, 0], xy[n, 1], far[n] = out[0], out[1], out[2]
    for n in range(e):
        i, j, p = ii[n], jj[n], kk[n]
        fx, fy, cx, cy = intrinsics[i]
        a = (xy[p, 0] - cx) / fx * far[p] - translation[i, 0]
        b = (xy[p, 1] - cy) / fy * far[p] - translation[i, 1]
        c = far[p] - translation[i, 2]
        r = rotation[i]
        wx = r[0, 0] * a + r[1, 0] * b + r[2, 0] * c
        wy = r[0, 1] * a + r[1, 1] * b + r[2, 1] * c
        wz = r[0, 2] * a + r[1, 2] * b + r[2, 2] * c
        z = rotation[j, 2, 0] * wx + rotation[j, 2, 1] * wy + rotation[j, 2, 2] * wz + translation[j, 2]
        z = nearest if z < nearest else z
        fx, fy, cx, cy = intrinsics[j]
        x, y, f = targets[n, 0], targets[n, 1], frames[j]
        _undo(x, y, z, fx, fy, cx, cy, times[f], twists[f], (y - middle) * per_row, nearest, out)
        moved[n, 0], moved[n, 1] = out[0], out[1]
    return xy, moved
