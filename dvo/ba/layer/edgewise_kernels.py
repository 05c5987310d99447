"""Kernels of Gauss-Newton steps on the reprojection of patches by one camera; see :mod:`dvo.ba.layer.edgewise`.

Values are float32, sums and the solution of the equations float64. The formulas are those of
:mod:`dvo.ba.layer.normal_equations` and :mod:`dvo.ba.layer.schur`. All that these kernels call stands in this file:
compiled code on the disk is not renewed when another file changes.

Shapes: ``B`` batch, ``N`` frames, ``K`` patches, ``E`` edges, ``Q`` different pairs of frames, ``P`` unknowns of the
reduced system.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dvo.ba.layer.schur import RETRIES
from dvo.ba.limits import LARGEST
from dvo.core.compiled import compiled, part
from dvo.geometry.so3 import SMALL

Array = np.ndarray[Any, Any]

TINY = float(np.finfo(np.float32).tiny)
NONE, HUBER, CAUCHY = 0, 1, 2


@compiled
def frame_pairs(ii: Array, jj: Array, kk: Array, frames: int, patches: int) -> tuple[bool, Array, Array]:
    """Number the pairs of frames in the order of their first edges.

    Args:
        ii, jj, kk: ``(E,)``.
        frames, patches: their numbers.

    Returns:
        False if an index is out of range; pair of each edge ``(E,)``; frames of each pair ``(Q, 2)``.
    """
    count = len(ii)
    of_edge, ends = np.empty(count, np.int64), np.empty((count, 2), np.int64)
    for e in range(count):
        if not (0 <= ii[e] < frames and 0 <= jj[e] < frames and 0 <= kk[e] < patches):
            return False, of_edge, ends[:0]
    found = 0
    number = np.empty((frames, frames), np.int64)
    for i in range(frames):
        for j in range(frames):
            number[i, j] = -1
    for e in range(count):
        i, j = ii[e], jj[e]
        if number[i, j] < 0:
            number[i, j] = found
            ends[found, 0], ends[found, 1] = i, j
            found += 1
        of_edge[e] = number[i, j]
    return True, of_edge, ends[:found]


@part
def _rotation(x: float, y: float, z: float, w: float, r: Array) -> None:
    """Matrix of a quaternion; its length, 1 to the last digit of float32, does not matter."""
    x, y, z, w = np.float64(x), np.float64(y), np.float64(z), np.float64(w)
    two = 2 / (x * x + y * y + z * z + w * w)
    xx, yy, zz, xy, xz, yz = two * x * x, two * y * y, two * z * z, two * x * y, two * x * z, two * y * z
    xw, yw, zw = two * x * w, two * y * w, two * z * w
    r[0], r[1], r[2] = 1 - yy - zz, xy - zw, xz + yw
    r[3], r[4], r[5] = xy + zw, 1 - xx - zz, yz - xw
    r[6], r[7], r[8] = xz - yw, yz + xw, 1 - xx - yy


@part
def _pair_motions(poses: Array, ends: Array) -> Array:
    """Rotation and translation ``(Q, 3, 4)`` of ``T_j T_i^-1``."""
    rotations = np.empty((len(poses), 9))
    for n in range(len(poses)):
        _rotation(poses[n, 3], poses[n, 4], poses[n, 5], poses[n, 6], rotations[n])
    motions = np.empty((len(ends), 3, 4))
    for p in range(len(ends)):
        i, j = ends[p, 0], ends[p, 1]
        for a in range(3):
            t = np.float64(poses[j, a])
            for b in range(3):
                r = 0.0
                for c in range(3):
                    r += rotations[j, 3 * a + c] * rotations[i, 3 * b + c]
                motions[p, a, b] = r
                t -= r * poses[i, b]
            motions[p, a, 3] = t
    return motions


@compiled
def add_reprojection(
    poses: Array,
    depths: Array,
    centres: Array,
    intrinsics: Array,
    targets: Array,
    weights: Array,
    ii: Array,
    jj: Array,
    kk: Array,
    pairs: Array,
    ends: Array,
    rows: Array,
    depth_part: bool,
    gate: tuple[float, ...],
    robust: int,
    h_pp: Array,
    h_lp: Array,
    h_ll: Array,
    g_p: Array,
    g_l: Array,
) -> None:
    """Add the normal equations of all edges, at the present values, of one element of a batch.

    Args:
        poses: ``(N, 7)``. depths: ``(K,)``. centres: ``(K, 2)``. intrinsics: ``(N, 4)``.
        targets, weights: ``(E, 2)``.
        ii, jj, kk: ``(E,)``.
        pairs, ends: of :func:`frame_pairs`.
        rows: ``(N,)`` first row of each pose in the reduced system, negative for a pose that stays.
        depth_part: inverse depths are unknowns.
        gate: least Z; longest residual, pixels; middle of the feature map (x, y) and farthest distance from it along
            each axis, pixels; width of the robust kernel.
        robust: which kernel.
        h_pp: ``(P, P)``. h_lp: ``(K, P)``. h_ll: ``(K,)``. g_p: ``(P,)``. g_l: ``(K,)``.
    """
    motions = _pair_motions(poses, ends)
    sums = np.empty((len(ends), 27))  # upper triangle of J_j^T W J_j by rows, then J_j^T W r
    for p in range(len(ends)):
        for a in range(27):
            sums[p, a] = 0.0
    jx, jy = np.empty(6), np.empty(6)
    least_z, longest, middle_x, middle_y, reach_x, reach_y, scale = gate
    longest, square = longest * longest, scale * scale
    for edge in range(len(ii)):
        i, j, k, p = ii[edge], jj[edge], kk[edge], pairs[edge]
        target_x, target_y = np.float64(targets[edge, 0]), np.float64(targets[edge, 1])
        weight_x, weight_y = np.float64(weights[edge, 0]), np.float64(weights[edge, 1])
        if not (abs(target_x) <= LARGEST and abs(target_y) <= LARGEST):
            continue
        if not (abs(weight_x) < math.inf and abs(weight_y) < math.inf):
            continue
        m, d = motions[p], np.float64(depths[k])
        u = (np.float64(centres[k, 0]) - intrinsics[i, 2]) / intrinsics[i, 0]
        v = (np.float64(centres[k, 1]) - intrinsics[i, 3]) / intrinsics[i, 1]
        z = m[2, 0] * u + m[2, 1] * v + m[2, 2] + m[2, 3] * d
        if not z > least_z:
            continue
        inv_z = 1 / z
        x = (m[0, 0] * u + m[0, 1] * v + m[0, 2] + m[0, 3] * d) * inv_z
        y = (m[1, 0] * u + m[1, 1] * v + m[1, 2] + m[1, 3] * d) * inv_z
        fx, fy = np.float64(intrinsics[j, 0]), np.float64(intrinsics[j, 1])
        cx, cy = np.float64(intrinsics[j, 2]), np.float64(intrinsics[j, 3])
        rx, ry = (target_x - cx) / fx - x, (target_y - cy) / fy - y
        if not rx * fx * (rx * fx) + ry * fy * (ry * fy) < longest:
            continue
        if not (abs(cx - middle_x + x * fx) < reach_x and abs(cy - middle_y + y * fy) < reach_y):
            continue
        wx, wy = weight_x * fx * fx, weight_y * fy * fy
        if robust != NONE:
            s = (wx * rx * rx + wy * ry * ry) / square
            slope = 1 / (1 + s) if robust == CAUCHY else 1 / math.sqrt(s) if s > 1 else 1.0
            wx, wy = wx * slope, wy * slope
        h = d * inv_z
        jx[0], jx[1], jx[2], jx[3], jx[4], jx[5] = h, 0.0, -h * x, -x * y, x * x + 1, -y
        jy[0], jy[1], jy[2], jy[3], jy[4], jy[5] = 0.0, h, -h * y, -y * y - 1, x * y, x
        apart = i != j  # an edge from a frame into itself moves with no pose
        if apart and (rows[i] >= 0 or rows[j] >= 0):
            total, at = sums[p], 0
            for a in range(6):
                ax, ay = wx * jx[a], wy * jy[a]
                for b in range(a, 6):
                    total[at] += ax * jx[b] + ay * jy[b]
                    at += 1
                total[21 + a] += ax * rx + ay * ry
        if not depth_part:
            continue
        dx, dy = (m[0, 3] - x * m[2, 3]) * inv_z, (m[1, 3] - y * m[2, 3]) * inv_z
        wx, wy = wx * dx, wy * dy
        h_ll[k] += wx * dx + wy * dy
        g_l[k] += wx * rx + wy * ry
        if not apart:
            continue
        e0, e1, e2 = wx * jx[0], wy * jy[1], wx * jx[2] + wy * jy[2]
        e3, e4, e5 = wx * jx[3] + wy * jy[3], wx * jx[4] + wy * jy[4], wx * jx[5] + wy * jy[5]
        to = rows[j]
        if to >= 0:
            row = h_lp[k]
            row[to] += e0
            row[to + 1] += e1
            row[to + 2] += e2
            row[to + 3] += e3
            row[to + 4] += e4
            row[to + 5] += e5
        to = rows[i]
        if to >= 0:  # J_i = -J_j Ad
            row = h_lp[k]
            e3 -= m[1, 3] * e2 - m[2, 3] * e1
            e4 -= m[2, 3] * e0 - m[0, 3] * e2
            e5 -= m[0, 3] * e1 - m[1, 3] * e0
            for a in range(3):
                row[to + a] -= m[0, a] * e0 + m[1, a] * e1 + m[2, a] * e2
                row[to + 3 + a] -= m[0, a] * e3 + m[1, a] * e4 + m[2, a] * e5
    _add_pairs(motions, ends, sums, rows, h_pp, g_p)


@part
def _add_pairs(motions: Array, ends: Array, sums: Array, rows: Array, h_pp: Array, g_p: Array) -> None:
    """Add the blocks of both frames of each pair."""
    minus, block = np.empty((6, 6)), np.empty((6, 6))
    for a in range(6):
        for b in range(6):
            minus[a, b] = 0.0
    across = np.empty((6, 6))
    for p in range(len(ends)):
        i, j = rows[ends[p, 0]], rows[ends[p, 1]]
        if ends[p, 0] == ends[p, 1] or (i < 0 and j < 0):
            continue
        total, at = sums[p], 0
        for a in range(6):
            for b in range(a, 6):
                block[a, b] = block[b, a] = total[at]
                at += 1
        if j >= 0:
            for a in range(6):
                g_p[j + a] += total[21 + a]
                for b in range(6):
                    h_pp[j + a, j + b] += block[a, b]
        if i < 0:
            continue
        m = motions[p]
        for b in range(3):
            for a in range(3):
                minus[a, b] = minus[3 + a, 3 + b] = -m[a, b]
            minus[0, 3 + b] = m[2, 3] * m[1, b] - m[1, 3] * m[2, b]
            minus[1, 3 + b] = m[0, 3] * m[2, b] - m[2, 3] * m[0, b]
            minus[2, 3 + b] = m[1, 3] * m[0, b] - m[0, 3] * m[1, b]
        for a in range(6):
            for b in range(6):
                x = 0.0
                for c in range(6):
                    x += block[a, c] * minus[c, b]
                across[a, b] = x
        for a in range(6):
            for b in range(6):
                x = 0.0
                for c in range(6):
                    x += minus[c, a] * across[c, b]
                h_pp[i + a, i + b] += x
                g_p[i + a] += minus[b, a] * total[21 + b]
                if j >= 0:
                    h_pp[j + a, i + b] += across[a, b]
                    h_pp[i + b, j + a] += across[a, b]


@part
def _cholesky(s: Array, boost: float, factor: Array) -> bool:
    """Lower factor of ``s + boost I``, of which the lower triangle is read. False if that is not positive definite."""
    for a in range(len(s)):
        row = factor[a]
        for b in range(a):
            other, x = factor[b], s[a, b]
            for c in range(b):
                x -= row[c] * other[c]
            row[b] = x / other[b]
        x = s[a, a] + boost
        for c in range(a):
            x -= row[c] * row[c]
        if not (x > 0 and x < math.inf):
            return False
        row[a] = math.sqrt(x)
    return True


@part
def _factorise(s: Array, factor: Array) -> bool:
    """As :func:`dvo.ba.layer.schur.factorise`, of the lower triangle of one matrix."""
    if _cholesky(s, 0.0, factor):
        return True
    largest = TINY
    for a in range(len(s)):
        if abs(s[a, a]) > largest:
            largest = abs(s[a, a])
        for b in range(a + 1):
            if not abs(s[a, b]) < math.inf:
                return False
    boost = largest * 1e-6
    for _ in range(RETRIES):
        if _cholesky(s, boost, factor):
            return True
        boost *= 10
    return False


@part
def _eliminate(h_lp: Array, q: Array, weighted: Array, s: Array, x: Array) -> None:
    """Subtract ``E Q E^T`` from the lower triangle of ``s``, and ``E weighted`` from ``x``; four landmarks at a time.

    Args:
        h_lp: ``(K, P)``, E^T. q: ``(K,)``. weighted: ``(K,)``, Q times the gradient.
    """
    count, size = h_lp.shape
    whole = count - count % 4
    for k in range(0, whole, 4):
        e0, e1, e2, e3 = h_lp[k], h_lp[k + 1], h_lp[k + 2], h_lp[k + 3]
        for a in range(size):
            x0, x1, x2, x3 = e0[a], e1[a], e2[a], e3[a]
            if x0 == 0 and x1 == 0 and x2 == 0 and x3 == 0:
                continue
            x[a] -= x0 * weighted[k] + x1 * weighted[k + 1] + x2 * weighted[k + 2] + x3 * weighted[k + 3]
            x0, x1, x2, x3 = x0 * q[k], x1 * q[k + 1], x2 * q[k + 2], x3 * q[k + 3]
            row = s[a]
            for b in range(a + 1):
                row[b] -= x0 * e0[b] + x1 * e1[b] + x2 * e2[b] + x3 * e3[b]
    for k in range(whole, count):
        for a in range(size):
            y = h_lp[k, a]
            x[a] -= y * weighted[k]
            y *= q[k]
            for b in range(a + 1):
                s[a, b] -= y * h_lp[k, b]


@part
def _solve_factored(factor: Array, x: Array) -> bool:
    """Solve ``L L^T x = x`` in place. False if the result is not finite."""
    size = len(x)
    for a in range(size):
        y = x[a]
        for b in range(a):
            y -= factor[a, b] * x[b]
        x[a] = y / factor[a, a]
    for a in range(size - 1, -1, -1):
        y = x[a] / factor[a, a]
        x[a] = y
        for b in range(a):
            x[b] -= factor[a, b] * y
    total = 0.0
    for a in range(size):
        total += abs(x[a])
    return total < math.inf


@compiled
def solve_reduced(
    h_pp: Array,
    h_lp: Array,
    h_ll: Array,
    g_p: Array,
    g_l: Array,
    absolute: float,
    relative: float,
    longest: Array,
    dp: Array,
    dl: Array,
) -> None:
    """Solve the normal equations, as :func:`dvo.ba.layer.step.solved`.

    Args:
        h_pp: ``(P, P)``, of which the lower triangle is read and lost. h_lp: ``(K, P)``. g_p: ``(P,)``.
        h_ll, g_l: ``(K,)``, with all damping; a landmark without curvature does not move.
        absolute, relative: damping of the reduced system.
        longest: ``(P,)`` largest number of a step in each unknown.
        dp: ``(P,)`` filled with the steps. dl: ``(K,)``, too.
    """
    size, count = len(g_p), len(g_l)
    q, weighted = np.empty(count), np.empty(count)
    for k in range(count):
        q[k] = 1 / h_ll[k] if h_ll[k] > 0 else 0.0
        weighted[k] = q[k] * g_l[k]
    for a in range(size):
        dp[a] = g_p[a]
    _eliminate(h_lp, q, weighted, h_pp, dp)
    for a in range(size):
        h_pp[a, a] += h_pp[a, a] * relative + absolute
    factor = np.empty((size, size))
    good, far = _factorise(h_pp, factor) and _solve_factored(factor, dp), False
    for a in range(size):
        if not good:
            dp[a] = 0.0
        far = far or abs(dp[a]) > longest[a]
    if far:
        for a in range(size):
            dp[a] = 0.0
        for k in range(count):
            dl[k] = 0.0
        return
    for k in range(count):
        rest = g_l[k]
        for a in range(size):
            rest -= h_lp[k, a] * dp[a]
        rest *= q[k]
        dl[k] = rest if abs(rest) <= LARGEST else 0.0


@part
def _retract_pose(pose: Array, step: Array) -> None:
    """Left retraction in place, as :func:`dvo.geometry.se3.retract`."""
    a, b, c = step[3], step[4], step[5]
    s = a * a + b * b + c * c
    if s < SMALL:
        k = 1 / 2 + s * (-1 / 48 + s * (1 / 3840 - s / 645120))
        ow = 1 + s * (-1 / 8 + s * (1 / 384 - s / 46080))
        third = 1 / 6 + s * (-1 / 120 + s * (1 / 5040 - s / 362880))
    else:
        t = math.sqrt(s)
        sine, ow = math.sin(0.5 * t), math.cos(0.5 * t)
        k, third = sine / t, (t - 2 * sine * ow) / (s * t)
    ox, oy, oz, second = k * a, k * b, k * c, 2 * k * k
    r = np.empty(9)
    _rotation(ox, oy, oz, ow, r)
    px, py, pz = np.float64(pose[0]), np.float64(pose[1]), np.float64(pose[2])
    u, v, w = b * step[2] - c * step[1], c * step[0] - a * step[2], a * step[1] - b * step[0]
    pose[0] = r[0] * px + r[1] * py + r[2] * pz + step[0] + second * u + third * (b * w - c * v)
    pose[1] = r[3] * px + r[4] * py + r[5] * pz + step[1] + second * v + third * (c * u - a * w)
    pose[2] = r[6] * px + r[7] * py + r[8] * pz + step[2] + second * w + third * (a * v - b * u)
    x, y, z, h = np.float64(pose[3]), np.float64(pose[4]), np.float64(pose[5]), np.float64(pose[6])
    qx, qy = ow * x + ox * h + oy * z - oz * y, ow * y + oy * h + oz * x - ox * z
    qz, qw = ow * z + oz * h + ox * y - oy * x, ow * h - ox * x - oy * y - oz * z
    length = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if length < 1e-12:
        length = 1e-12
    pose[3], pose[4], pose[5], pose[6] = qx / length, qy / length, qz / length, qw / length


@compiled
def take_steps(
    poses: Array,
    depths: Array,
    centres: Array,
    intrinsics: Array,
    targets: Array,
    weights: Array,
    ii: Array,
    jj: Array,
    kk: Array,
    pairs: Array,
    ends: Array,
    rows: Array,
    size: int,
    depth_part: bool,
    gate: tuple[float, ...],
    robust: int,
    pose_damping: float,
    relative: float,
    depth_damping: float,
    low: float,
    high: float,
    iterations: int,
) -> None:
    """Gauss-Newton steps of a batch whose only factor is the reprojection; see :func:`add_reprojection`.

    Args:
        poses: ``(B, N, 7)``. depths: ``(B, K)``. Both change in place; as all others that are not indices, they have a
            leading batch dimension.
        size: unknowns of the poses.
        pose_damping, relative, depth_damping: see :class:`dvo.ba.options.BADamping`.
        low, high: inverse depths are clamped to it after each step.
        iterations: number of steps.
    """
    count = depths.shape[1]
    longest = np.empty(size)
    h_pp, h_lp = np.empty((size, size)), np.empty((count, size))
    h_ll, g_p, g_l = np.empty(count), np.empty(size), np.empty(count)
    dp, dl = np.empty(size), np.empty(count)
    for b in range(len(poses)):
        for _ in range(iterations):
            for a in range(size):
                longest[a], g_p[a] = LARGEST, 0.0
                for c in range(size):
                    h_pp[a, c] = 0.0
            for k in range(count):
                g_l[k], h_ll[k] = 0.0, depth_damping if depth_part else 0.0
                for a in range(size):
                    h_lp[k, a] = 0.0
            add_reprojection(
                poses[b], depths[b], centres[b], intrinsics[b], targets[b], weights[b], ii, jj, kk, pairs, ends, rows,
                depth_part, gate, robust, h_pp, h_lp, h_ll, g_p, g_l,
            )  # fmt: skip
            solve_reduced(h_pp, h_lp, h_ll, g_p, g_l, pose_damping, relative, longest, dp, dl)
            for n in range(poses.shape[1]):
                if rows[n] >= 0:
                    _retract_pose(poses[b, n], dp[rows[n] : rows[n] + 6])
            if depth_part:
                for k in range(count):
                    d = depths[b, k] + dl[k]
                    d = low if d < low else d
                    depths[b, k] = high if d > high else d
