"""Kernel of :func:`dvo.odometry.inertial.preintegration.preintegrate`. All float64.

Shapes: ``K`` intervals, ``S`` steps.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dvo.core.compiled import compiled, part

Array = np.ndarray[Any, Any]


@part
def _hat(v: Array, out: Array) -> None:
    out[0, 0] = out[1, 1] = out[2, 2] = 0.0
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]


@part
def _product(a: Array, b: Array, out: Array) -> None:
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = 0.0
            for k in range(b.shape[0]):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@part
def _turned(v: Array, rotation: Array, right: Array, k: Array, kk: Array) -> None:
    """Rotation of a rotation vector, and right Jacobian; the last two are filled by the way."""
    _hat(v, k)
    _product(k, k, kk)
    s = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if s < 1e-6:
        a, b, c = 1 - s / 6 + s * s / 120, 0.5 - s / 24 + s * s / 720, 1 / 6 - s / 120
    else:
        t = math.sqrt(s)
        a, b = math.sin(t) / t, (1 - math.cos(t)) / s
        c = (1 - a) / s
    for i in range(3):
        for j in range(3):
            one = 1.0 if i == j else 0.0
            rotation[i, j] = one + a * k[i, j] + b * kk[i, j]
            right[i, j] = one - b * k[i, j] + c * kk[i, j]


@compiled
def integrate(
    index: Array, dt: Array, gyro0: Array, gyro1: Array, accel0: Array, accel1: Array, variance: Array,
    rotation: Array, velocity: Array, position: Array, covariance: Array, by_bias: Array,
) -> None:  # fmt: skip
    """Integrate step by step: motion, covariance and derivatives by the biases.

    Args:
        index: ``(K + 1,)`` first step of each interval, and their number at last.
        dt: ``(S,)`` seconds. gyro0, gyro1, accel0, accel1: ``(S, 3)`` at both ends of each step, without bias.
        variance: ``(S, 2)`` of the mean rate and of the mean force of a step.
        rotation, velocity, position, covariance, by_bias: ``(K, 3, 3)``, ``(K, 3)``, ``(K, 3)``, ``(K, 9, 9)`` and
            ``(K, 9, 6)`` are filled.
    """
    scratch = np.empty((10, 3, 3))
    r1, turn, right, k, kk = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    by_rate, hat, arm0, arm1, both = scratch[5], scratch[6], scratch[7], scratch[8], scratch[9]
    w = np.empty(3)
    a, b = np.zeros((9, 9)), np.zeros((9, 6))
    half, jacobian = np.empty((9, 9)), np.empty((9, 6))
    for at in range(len(index) - 1):
        r, v, p, sigma, j = rotation[at], velocity[at], position[at], covariance[at], by_bias[at]
        r[:], v[:], p[:], sigma[:], j[:] = np.eye(3), 0.0, 0.0, 0.0, 0.0
        for step in range(index[at], index[at + 1]):
            t, w0, w1, a0, a1 = dt[step], gyro0[step], gyro1[step], accel0[step], accel1[step]
            coning = t * t / 12
            w[0] = (w0[0] + w1[0]) * t / 2 + coning * (w0[1] * w1[2] - w0[2] * w1[1])
            w[1] = (w0[1] + w1[1]) * t / 2 + coning * (w0[2] * w1[0] - w0[0] * w1[2])
            w[2] = (w0[2] + w1[2]) * t / 2 + coning * (w0[0] * w1[1] - w0[1] * w1[0])
            _turned(w, turn, right, k, kk)
            _hat(w0 - w1, hat)
            for x in range(3):
                for y in range(3):
                    both[x, y] = coning * hat[x, y] + (t if x == y else 0.0)
            _product(right, both, by_rate)
            _product(r, turn, r1)
            # -R hat(a) at both ends
            _hat(a0, hat)
            _product(r, hat, arm0)
            _hat(a1, hat)
            _product(r1, hat, arm1)
            for x in range(3):
                f0 = r[x, 0] * a0[0] + r[x, 1] * a0[1] + r[x, 2] * a0[2]
                f1 = r1[x, 0] * a1[0] + r1[x, 1] * a1[1] + r1[x, 2] * a1[2]
                p[x] += v[x] * t + (2 * f0 + f1) * t * t / 6
                v[x] += (f0 + f1) * t / 2
                for y in range(3):
                    after = after_rate = 0.0
                    for z in range(3):
                        after += arm1[x, z] * turn[y, z]
                        after_rate += arm1[x, z] * by_rate[z, y]
                    a[x, y] = turn[y, x]
                    a[3 + x, y] = -(arm0[x, y] + after) * t / 2
                    a[6 + x, y] = -(2 * arm0[x, y] + after) * t * t / 6
                    b[x, y] = by_rate[x, y]
                    b[3 + x, y], b[6 + x, y] = -after_rate * t / 2, -after_rate * t * t / 6
                    b[3 + x, 3 + y] = (r[x, y] + r1[x, y]) * t / 2
                    b[6 + x, 3 + y] = (2 * r[x, y] + r1[x, y]) * t * t / 6
                a[3 + x, 3 + x] = a[6 + x, 6 + x] = 1.0
                a[6 + x, 3 + x] = t
            _product(a, sigma, half)
            _product(a, j, jacobian)
            for x in range(9):
                for y in range(9):
                    total = 0.0
                    for z in range(9):
                        total += half[x, z] * a[y, z]
                    for z in range(6):
                        total += variance[step, z // 3] * b[x, z] * b[y, z]
                    sigma[x, y] = total
                if x >= 6:  # of the force within the step
                    sigma[x, x] += variance[step, 1] * t * t * t * t / 12
                for y in range(6):
                    j[x, y] = jacobian[x, y] - b[x, y]
            r[:] = r1
