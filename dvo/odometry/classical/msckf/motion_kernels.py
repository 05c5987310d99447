"""Kernel of :func:`dvo.odometry.classical.msckf.motion.propagate`."""

from __future__ import annotations

import math

import numpy as np

from dvo.core.compiled import compiled, part


@part
def _exp(x, y, z, out):
    """Rotation ``(3, 3)`` of a rotation vector."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-6:
        half = math.sin(0.5 * angle)
        s, c = math.sin(angle) / angle, 2 * half * half / square
    else:
        s, c = 1.0 - square / 6, 0.5 - square / 24
    out[0, 0], out[0, 1], out[0, 2] = 1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)


@part
def _times(a, b, out):
    """Product of matrices."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@part
def _minus_cross_times(x, y, z, r, out, row, column):
    """``-[x y z]x r`` as a block of a matrix."""
    for j in range(3):
        out[row, column + j] = z * r[1, j] - y * r[2, j]
        out[row + 1, column + j] = x * r[2, j] - z * r[0, j]
        out[row + 2, column + j] = y * r[0, j] - x * r[1, j]


@compiled
def propagate(times, gyro, accel, R, p, v, R_first, p_first, v_first, bg, ba, gravity, densities, longest, unknown):
    """Move ``R, p, v`` (changed in place) through the samples; returns transition and noise ``(15, 15)``.

    The arguments are those of the function of the module ``motion``; ``densities (4,)`` are gyro, its walk, accel, its
    walk; over steps above ``longest`` seconds rate and acceleration are known up to ``unknown (2,)`` only.
    """
    total, noise = np.eye(15), np.zeros((15, 15))
    step, product, turned = np.empty((15, 15)), np.empty((15, 15)), np.empty((15, 15))
    half, third, whole = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    middle, early, after = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    first, p0, v0 = R_first.copy(), p_first.copy(), v_first.copy()
    w, a = np.empty(3), np.empty(3)
    for n in range(len(times) - 1):
        dt = times[n + 1] - times[n]
        if dt <= 0:
            continue
        for i in range(3):
            w[i] = 0.5 * (gyro[n, i] + gyro[n + 1, i]) - bg[i]
            a[i] = 0.5 * (accel[n, i] + accel[n + 1, i]) - ba[i]
        _exp(w[0] * dt, w[1] * dt, w[2] * dt, whole)
        _exp(w[0] * dt / 2, w[1] * dt / 2, w[2] * dt / 2, half)
        _exp(w[0] * dt / 3, w[1] * dt / 3, w[2] * dt / 3, third)
        _times(R, whole, after)
        _times(R, half, middle)
        _times(R, third, early)
        for i in range(3):
            force = early[i, 0] * a[0] + early[i, 1] * a[1] + early[i, 2] * a[2]
            p[i] += v[i] * dt + 0.5 * dt * dt * (gravity[i] + force)
        for i in range(3):
            v[i] += dt * (gravity[i] + middle[i, 0] * a[0] + middle[i, 1] * a[1] + middle[i, 2] * a[2])
        # Transition by the first estimates at the start of the step (Li & Mourikis 2013, eq. 36-38), errors as here.
        step[:] = 0.0
        for i in range(15):
            step[i, i] = 1.0
        for i in range(3):
            step[i, 6 + i] = dt
            for j in range(3):
                step[3 + i, 3 + j] = after[0, i] * first[0, j] + after[1, i] * first[1, j] + after[2, i] * first[2, j]
                # right Jacobian of the turn, to second order: Exp(-w dt / 2)
                step[3 + i, 9 + j] = -dt * half[j, i]
                step[6 + i, 12 + j] = -dt * middle[i, j]
                step[i, 12 + j] = -0.5 * dt * dt * early[i, j]
        dv0, dv1, dv2 = v[0] - v0[0] - gravity[0] * dt, v[1] - v0[1] - gravity[1] * dt, v[2] - v0[2] - gravity[2] * dt
        _minus_cross_times(dv0, dv1, dv2, first, step, 6, 3)
        dp0 = p[0] - p0[0] - v0[0] * dt - 0.5 * gravity[0] * dt * dt
        dp1 = p[1] - p0[1] - v0[1] * dt - 0.5 * gravity[1] * dt * dt
        dp2 = p[2] - p0[2] - v0[2] * dt - 0.5 * gravity[2] * dt * dt
        _minus_cross_times(dp0, dp1, dp2, first, step, 0, 3)
        for j in range(3):  # R [a]x, of the bias of the gyroscope
            x, y = (j + 1) % 3, (j + 2) % 3
            for i in range(3):
                bent = middle[i, x] * a[y] - middle[i, y] * a[x]
                step[6 + i, 9 + j] = bent * dt * dt / 2
                step[i, 9 + j] = bent * dt * dt * dt / 6
        _times(step, total, product)
        total[:] = product
        _times(step, noise, product)
        for i in range(15):
            for j in range(15):
                value = 0.0
                for k in range(15):
                    value += product[i, k] * step[j, k]
                turned[i, j] = value
        noise[:] = turned
        turn, push = densities[0] ** 2 * dt, densities[2] ** 2 * dt
        if dt > longest:
            turn, push = turn + (unknown[0] * dt) ** 2, push + (unknown[1] * dt) ** 2
        for i in range(3):
            noise[3 + i, 3 + i] += turn
            noise[6 + i, 6 + i] += push
            noise[i, i] += push * dt * dt / 3
            noise[i, 6 + i] += push * dt / 2
            noise[6 + i, i] += push * dt / 2
            noise[9 + i, 9 + i] += densities[1] ** 2 * dt
            noise[12 + i, 12 + i] += densities[3] ** 2 * dt
        R[:] = after
        first[:] = after
        p0[:] = p
        v0[:] = v
    return total, noise
