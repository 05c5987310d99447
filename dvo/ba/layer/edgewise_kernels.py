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

from dvo.ba.limits import LARGEST, RETRIES
from dvo.core.compiled import compiled, part
from dvo.geometry.bounds import SMALL

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
    _solve(h_pp, h_lp, h_ll, g_p, g_l, absolute, relative, longest, dp, dl, np.empty(len(g_l)), np.empty_like(h_pp))


@part
def _solve(
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
    q: Array,
    factor: Array,
) -> bool:
    """As :func:`solve_reduced`; fills the inverse curvatures ``q (K,)``, zero for a step that is too long, and the
    Cholesky factor too. False where poses do not move."""
    size, count = len(g_p), len(g_l)
    for k in range(count):
        q[k] = 1 / h_ll[k] if h_ll[k] > 0 else 0.0
    weighted = q * g_l
    for a in range(size):
        dp[a] = g_p[a]
    _eliminate(h_lp, q, weighted, h_pp, dp)
    for a in range(size):
        h_pp[a, a] += h_pp[a, a] * relative + absolute
    good, far = _factorise(h_pp, factor) and _solve_factored(factor, dp), False
    for a in range(size):
        if not good:
            dp[a] = 0.0
        far = far or abs(dp[a]) > longest[a]
    if far:
        for a in range(size):
            dp[a] = 0.0
        for k in range(count):
            dl[k] = q[k] = 0.0
        return False
    _substitute(h_lp, q, g_l, dp, dl)
    for k in range(count):
        if not abs(dl[k]) <= LARGEST:
            dl[k] = 0.0
    return good


@part
def _substitute(h_lp: Array, q: Array, g_l: Array, dp: Array, dl: Array) -> None:
    """``dl = Q (g_l - E^T dp)``."""
    for k in range(len(dl)):
        rest = g_l[k]
        for a in range(len(dp)):
            rest -= h_lp[k, a] * dp[a]
        dl[k] = q[k] * rest


@part
def _exp_terms(s: float) -> tuple[float, float, float]:
    """Of a squared angle, as :func:`dvo.geometry.so3.exp_terms`: factor of the rotation vector in the quaternion, last
    number of the quaternion, second coefficient of the left Jacobian."""
    if s < SMALL:
        return (
            1 / 2 + s * (-1 / 48 + s * (1 / 3840 - s / 645120)),
            1 + s * (-1 / 8 + s * (1 / 384 - s / 46080)),
            1 / 6 + s * (-1 / 120 + s * (1 / 5040 - s / 362880)),
        )
    t = math.sqrt(s)
    sine, cosine = math.sin(0.5 * t), math.cos(0.5 * t)
    return sine / t, cosine, (t - 2 * sine * cosine) / (s * t)


@part
def _exp_slopes(s: float) -> tuple[float, float, float]:
    """Derivatives of :func:`_exp_terms`."""
    if s < SMALL:
        return (
            -1 / 48 + s * (1 / 1920 - s / 215040),
            -1 / 8 + s * (1 / 192 - s / 15360),
            -1 / 120 + s * (1 / 2520 - s / 120960),
        )
    t = math.sqrt(s)
    sine, cosine = math.sin(0.5 * t), math.cos(0.5 * t)
    third = (2 * sine * sine - 3 * (t - 2 * sine * cosine) / t) / (s * t)
    return (0.5 * cosine - sine / t) / (2 * s), -0.25 * sine / t, third / (2 * t)


@part
def _retract_pose(pose: Array, step: Array) -> None:
    """Left retraction in place, as :func:`dvo.geometry.se3.retract`."""
    a, b, c = step[3], step[4], step[5]
    k, ow, third = _exp_terms(a * a + b * b + c * c)
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


@part
def _clear(depth_damping: float, h_pp: Array, h_lp: Array, h_ll: Array, g_p: Array, g_l: Array) -> None:
    """Equations of nothing but damping of the depths."""
    for a in range(len(g_p)):
        g_p[a] = 0.0
        for c in range(len(g_p)):
            h_pp[a, c] = 0.0
    for k in range(len(g_l)):
        g_l[k], h_ll[k] = 0.0, depth_damping
        for a in range(len(g_p)):
            h_lp[k, a] = 0.0


@part
def _rho(s: float, robust: int, width: float) -> float:
    """Robust cost of a squared residual, as :meth:`dvo.ba.kernels.Kernel.cost`."""
    square = width * width
    if robust == HUBER:
        return s if s <= square else 2 * width * math.sqrt(s) - square
    return square * math.log1p(s / square) if robust == CAUCHY else s


@compiled
def robust_cost(
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
    gate: tuple[float, ...],
    robust: int,
    counted: Array,
) -> float:
    """Half the sum of robust squared residuals, where an edge that does not count costs as the longest residual.

    Args:
        poses, depths, centres, intrinsics, targets, weights, ii, jj, kk, pairs, ends, gate, robust: see
            :func:`add_reprojection`; there are no bounds of the feature map.
        counted: ``(E,)`` filled: edges that count, with a weight.
    """
    motions = _pair_motions(poses, ends)
    least_z, longest, width = gate[0], gate[1] * gate[1], gate[6]
    total = 0.0
    for edge in range(len(ii)):
        i, j, k = ii[edge], jj[edge], kk[edge]
        m, d, wx, wy = motions[pairs[edge]], depths[k], weights[edge, 0], weights[edge, 1]
        u = (centres[k, 0] - intrinsics[i, 2]) / intrinsics[i, 0]
        v = (centres[k, 1] - intrinsics[i, 3]) / intrinsics[i, 1]
        z = m[2, 0] * u + m[2, 1] * v + m[2, 2] + m[2, 3] * d
        s, here = max(wx, wy) * longest, False
        if z > least_z:
            x = (m[0, 0] * u + m[0, 1] * v + m[0, 2] + m[0, 3] * d) / z
            y = (m[1, 0] * u + m[1, 1] * v + m[1, 2] + m[1, 3] * d) / z
            rx = targets[edge, 0] - intrinsics[j, 2] - x * intrinsics[j, 0]
            ry = targets[edge, 1] - intrinsics[j, 3] - y * intrinsics[j, 1]
            if rx * rx + ry * ry < longest:
                s, here = wx * rx * rx + wy * ry * ry, wx > 0 or wy > 0
        counted[edge] = here
        total += _rho(s, robust, width)
    return 0.5 * total


@compiled
def move_poses(poses: Array, rows: Array, steps: Array) -> None:
    """Left retraction of the poses that move, in place.

    Args:
        poses: ``(N, 7)``. rows: ``(N,)`` first row of each in the steps, negative for a pose that stays.
        steps: ``(P,)``.
    """
    for n in range(len(poses)):
        if rows[n] >= 0:
            _retract_pose(poses[n], steps[rows[n] : rows[n] + 6])


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
    longest = np.full(size, LARGEST)
    h_pp, h_lp = np.empty((size, size)), np.empty((count, size))
    h_ll, g_p, g_l = np.empty(count), np.empty(size), np.empty(count)
    dp, dl = np.empty(size), np.empty(count)
    for b in range(len(poses)):
        for _ in range(iterations):
            _clear(depth_damping if depth_part else 0.0, h_pp, h_lp, h_ll, g_p, g_l)
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


@compiled
def take_back_step(
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
    d_poses: Array,
    d_depths: Array,
    d_centres: Array,
    d_intrinsics: Array,
    d_targets: Array,
    d_weights: Array,
) -> None:
    """Adjoint of one of :func:`take_steps`; the formula is that of :mod:`dvo.ba.layer.adjoint`.

    Args:
        poses, depths: before the step.
        d_poses, d_depths: gradients by those after it; they become those before it.
        d_centres, d_intrinsics, d_targets, d_weights: gradients are added to these. All six are float64.
    """
    frames, count = poses.shape[1], depths.shape[1]
    longest = np.full(size, LARGEST)
    h_pp, h_lp, factor = np.empty((size, size)), np.empty((count, size)), np.empty((size, size))
    h_ll, q = np.empty(count), np.empty(count)
    g_p, dp, lp, s = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    g_l, dl, ll, c_l, curve = np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for b in range(len(poses)):
        _clear(depth_damping if depth_part else 0.0, h_pp, h_lp, h_ll, g_p, g_l)
        add_reprojection(
            poses[b], depths[b], centres[b], intrinsics[b], targets[b], weights[b], ii, jj, kk, pairs, ends, rows,
            depth_part, gate, robust, h_pp, h_lp, h_ll, g_p, g_l,
        )  # fmt: skip
        good = _solve(h_pp, h_lp, h_ll, g_p, g_l, pose_damping, relative, longest, dp, dl, q, factor)
        for n in range(frames):
            if rows[n] >= 0:
                own = slice(rows[n], rows[n] + 6)
                _take_back_retraction(poses[b, n], dp[own], d_poses[b, n], lp[own])
        for k in range(count):
            c_l[k] = 0.0
            if depth_part:
                there = depths[b, k] + dl[k]
                if not low <= there <= high:
                    d_depths[b, k] = 0.0
                c_l[k] = d_depths[b, k]
        # H lambda = c, with the factor of the step
        for k in range(count):
            weighted = q[k] * c_l[k]
            for a in range(size):
                lp[a] -= h_lp[k, a] * weighted
        if not (good and _solve_factored(factor, lp)):
            for a in range(size):
                lp[a] = 0.0
        _substitute(h_lp, q, c_l, lp, ll)
        for a in range(size):
            s[a] = -relative * lp[a] * dp[a]
        for k in range(count):
            curve[k] = 0.0
            for a in range(size):
                e = h_lp[k, a] * q[k]
                curve[k] += s[a] * e * e
                h_lp[k, a] = -2 * s[a] * e
        _add_edge_gradients(
            poses[b], depths[b], centres[b], intrinsics[b], targets[b], weights[b], ii, jj, kk, pairs, ends, rows,
            gate, robust, lp, dp, ll, dl, s, h_lp, curve, d_poses[b], d_depths[b], d_centres[b], d_intrinsics[b],
            d_targets[b], d_weights[b],
        )  # fmt: skip


@part
def _add_matrix_gradient(x: float, y: float, z: float, w: float, g: Array, out: Array) -> None:
    """Gradient by a quaternion from that by its rotation matrix ``g (3, 3)``, as of :func:`dvo.geometry.so3.matrix`."""
    x, y, z, w = np.float64(x), np.float64(y), np.float64(z), np.float64(w)
    s01, s02, s12 = g[0, 1] + g[1, 0], g[0, 2] + g[2, 0], g[1, 2] + g[2, 1]
    a, b, c = g[2, 1] - g[1, 2], g[0, 2] - g[2, 0], g[1, 0] - g[0, 1]
    out[0] += 2 * (x * (g[0, 0] - g[1, 1] - g[2, 2]) + y * s01 + z * s02 + w * a)
    out[1] += 2 * (x * s01 + y * (g[1, 1] - g[0, 0] - g[2, 2]) + z * s12 + w * b)
    out[2] += 2 * (x * s02 + y * s12 + z * (g[2, 2] - g[0, 0] - g[1, 1]) + w * c)
    out[3] += 2 * (w * (g[0, 0] + g[1, 1] + g[2, 2]) + x * a + y * b + z * c)


@part
def _take_back_retraction(pose: Array, step: Array, d_pose: Array, d_step: Array) -> None:
    """Adjoint of :func:`_retract_pose`: ``d_pose`` becomes the gradient before it, ``d_step`` is filled."""
    tx, ty, tz, fa, fb, fc = step[0], step[1], step[2], step[3], step[4], step[5]
    square = fa * fa + fb * fb + fc * fc
    k, o, third = _exp_terms(square)
    k_slope, o_slope, third_slope = _exp_slopes(square)
    a, b, c, second = k * fa, k * fb, k * fc, 2 * k * k
    x, y, z, w = np.float64(pose[3]), np.float64(pose[4]), np.float64(pose[5]), np.float64(pose[6])
    qx, qy = o * x + a * w + b * z - c * y, o * y + b * w + c * x - a * z
    qz, qw = o * z + c * w + a * y - b * x, o * w - a * x - b * y - c * z
    length = max(math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw), 1e-12)
    qx, qy, qz, qw = qx / length, qy / length, qz / length, qw / length
    along = qx * d_pose[3] + qy * d_pose[4] + qz * d_pose[5] + qw * d_pose[6]
    gx, gy = (d_pose[3] - along * qx) / length, (d_pose[4] - along * qy) / length
    gz, gw = (d_pose[5] - along * qz) / length, (d_pose[6] - along * qw) / length
    d_q = np.empty(4)  # of the step
    d_q[0], d_q[1] = gx * w - gy * z + gz * y - gw * x, gx * z + gy * w - gz * x - gw * y
    d_q[2], d_q[3] = gy * x - gx * y + gz * w - gw * z, gx * x + gy * y + gz * z + gw * w
    d_pose[3], d_pose[4] = gx * o + gy * c - gz * b - gw * a, gy * o - gx * c + gz * a - gw * b
    d_pose[5], d_pose[6] = gx * b - gy * a + gz * o - gw * c, gx * a + gy * b + gz * c + gw * o
    g0, g1, g2 = d_pose[0], d_pose[1], d_pose[2]
    outer, r = np.empty((3, 3)), np.empty(9)
    for n in range(3):
        t = np.float64(pose[n])
        outer[0, n], outer[1, n], outer[2, n] = g0 * t, g1 * t, g2 * t
    _add_matrix_gradient(a, b, c, o, outer, d_q)
    _rotation(a, b, c, o, r)
    for n in range(3):
        d_pose[n] = r[n] * g0 + r[3 + n] * g1 + r[6 + n] * g2
    # t + second (f x t) + third (f x (f x t)) of the step
    u0, u1, u2 = fb * tz - fc * ty, fc * tx - fa * tz, fa * ty - fb * tx
    v0, v1, v2 = fb * u2 - fc * u1, fc * u0 - fa * u2, fa * u1 - fb * u0
    d_second, d_third = g0 * u0 + g1 * u1 + g2 * u2, g0 * v0 + g1 * v1 + g2 * v2
    h0, h1, h2 = third * g0, third * g1, third * g2
    w0 = second * g0 + h1 * fc - h2 * fb
    w1 = second * g1 + h2 * fa - h0 * fc
    w2 = second * g2 + h0 * fb - h1 * fa
    d_k = d_q[0] * fa + d_q[1] * fb + d_q[2] * fc + 4 * k * d_second
    d_square = 2 * (d_k * k_slope + d_q[3] * o_slope + d_third * third_slope)
    d_step[0], d_step[1], d_step[2] = g0 + w1 * fc - w2 * fb, g1 + w2 * fa - w0 * fc, g2 + w0 * fb - w1 * fa
    d_step[3] = k * d_q[0] + d_square * fa + u1 * h2 - u2 * h1 + ty * w2 - tz * w1
    d_step[4] = k * d_q[1] + d_square * fb + u2 * h0 - u0 * h2 + tz * w0 - tx * w2
    d_step[5] = k * d_q[2] + d_square * fc + u0 * h1 - u1 * h0 + tx * w1 - ty * w0


@part
def _adjoint_of(m: Array, out: Array) -> None:
    """Adjoint ``(6, 6)`` of a motion ``(3, 4)``."""
    for b in range(3):
        for a in range(3):
            out[a, b] = out[3 + a, 3 + b] = m[a, b]
            out[3 + a, b] = 0.0
        out[0, 3 + b] = m[1, 3] * m[2, b] - m[2, 3] * m[1, b]
        out[1, 3 + b] = m[2, 3] * m[0, b] - m[0, 3] * m[2, b]
        out[2, 3 + b] = m[0, 3] * m[1, b] - m[1, 3] * m[0, b]


@part
def _add_edge_gradients(
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
    gate: tuple[float, ...],
    robust: int,
    lambda_p: Array,
    delta_p: Array,
    lambda_l: Array,
    delta_l: Array,
    s: Array,
    e: Array,
    curve: Array,
    d_poses: Array,
    d_depths: Array,
    d_centres: Array,
    d_intrinsics: Array,
    d_targets: Array,
    d_weights: Array,
) -> None:
    """Add the gradients of phi (:mod:`dvo.ba.layer.adjoint`) of one element of a batch; ``e (K, P)``, ``curve (K,)``
    is c there."""
    motions, count = _pair_motions(poses, ends), len(ends)
    adjoints, flows, changes = np.zeros((count, 6, 6)), np.zeros((count, 6)), np.zeros((count, 6))
    diagonals, turned = np.zeros((count, 6, 6)), np.zeros((count, 6, 6))  # J diag(s) J^T of both ends; Ad diag(s_i)
    for p in range(count):
        i, j = rows[ends[p, 0]], rows[ends[p, 1]]
        _adjoint_of(motions[p], adjoints[p])
        if ends[p, 0] == ends[p, 1]:
            continue
        for a in range(6):
            if j >= 0:
                flows[p, a], changes[p, a] = lambda_p[j + a], delta_p[j + a]
                diagonals[p, a, a] = s[j + a]
            if i >= 0:
                for c in range(6):
                    flows[p, a] -= adjoints[p, a, c] * lambda_p[i + c]
                    changes[p, a] -= adjoints[p, a, c] * delta_p[i + c]
                    turned[p, a, c] = adjoints[p, a, c] * s[i + c]
        if i >= 0:
            for a in range(6):
                for b in range(6):
                    for c in range(6):
                        diagonals[p, a, b] += turned[p, a, c] * adjoints[p, b, c]
    d_flows, d_changes = np.zeros((count, 6)), np.zeros((count, 6))
    d_diagonals, d_adjoints, d_motions = np.zeros((count, 6, 6)), np.zeros((count, 6, 6)), np.zeros((count, 3, 4))
    jx, jy, gx, gy = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    e_i, e_here = np.empty(6), np.empty(6)
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
        fix, fiy = np.float64(intrinsics[i, 0]), np.float64(intrinsics[i, 1])
        u = (np.float64(centres[k, 0]) - intrinsics[i, 2]) / fix
        v = (np.float64(centres[k, 1]) - intrinsics[i, 3]) / fiy
        z = m[2, 0] * u + m[2, 1] * v + m[2, 2] + m[2, 3] * d
        if not z > least_z:
            continue
        inv_z = 1 / z
        px = m[0, 0] * u + m[0, 1] * v + m[0, 2] + m[0, 3] * d
        py = m[1, 0] * u + m[1, 1] * v + m[1, 2] + m[1, 3] * d
        x, y = px * inv_z, py * inv_z
        fx, fy = np.float64(intrinsics[j, 0]), np.float64(intrinsics[j, 1])
        cx, cy = np.float64(intrinsics[j, 2]), np.float64(intrinsics[j, 3])
        tx, ty = (target_x - cx) / fx, (target_y - cy) / fy
        rx, ry = tx - x, ty - y
        if not rx * fx * (rx * fx) + ry * fy * (ry * fy) < longest:
            continue
        if not (abs(cx - middle_x + x * fx) < reach_x and abs(cy - middle_y + y * fy) < reach_y):
            continue
        slope = 1.0
        wx, wy = weight_x * fx * fx, weight_y * fy * fy
        if robust != NONE:
            norm = (wx * rx * rx + wy * ry * ry) / square
            slope = 1 / (1 + norm) if robust == CAUCHY else 1 / math.sqrt(norm) if norm > 1 else 1.0
            wx, wy = wx * slope, wy * slope
        h = d * inv_z
        jx[0], jx[1], jx[2], jx[3], jx[4], jx[5] = h, 0.0, -h * x, -x * y, x * x + 1, -y
        jy[0], jy[1], jy[2], jy[3], jy[4], jy[5] = 0.0, h, -h * y, -y * y - 1, x * y, x
        dx, dy = (m[0, 3] - x * m[2, 3]) * inv_z, (m[1, 3] - y * m[2, 3]) * inv_z
        # J lambda, J delta, J diag(s) J^T and J e
        flow_x, flow_y, change_x, change_y = dx * lambda_l[k], dy * lambda_l[k], dx * delta_l[k], dy * delta_l[k]
        bent_x = bent_y = mixed_x = mixed_y = 0.0
        apart = i != j
        if apart:
            to = rows[j]
            for a in range(6):
                e_here[a] = e[k, to + a] if to >= 0 else 0.0
            to = rows[i]
            if to >= 0:
                for a in range(6):
                    e_i[a] = e[k, to + a]
                for a in range(6):
                    for b in range(6):
                        e_here[a] -= adjoints[p, a, b] * e_i[b]
            for a in range(6):
                flow_x, flow_y = flow_x + jx[a] * flows[p, a], flow_y + jy[a] * flows[p, a]
                change_x, change_y = change_x + jx[a] * changes[p, a], change_y + jy[a] * changes[p, a]
                mixed_x, mixed_y = mixed_x + jx[a] * e_here[a], mixed_y + jy[a] * e_here[a]
                gx[a] = gy[a] = 0.0
                for b in range(6):
                    gx[a] += diagonals[p, a, b] * jx[b]
                    gy[a] += diagonals[p, a, b] * jy[b]
                bent_x, bent_y = bent_x + jx[a] * gx[a], bent_y + jy[a] * gy[a]
        # By the weights, the residuals and the two directional derivatives
        cl = curve[k]
        by_wx = flow_x * (rx - change_x) + bent_x + dx * (mixed_x + dx * cl)
        by_wy = flow_y * (ry - change_y) + bent_y + dy * (mixed_y + dy * cl)
        by_rx, by_ry = wx * flow_x, wy * flow_y
        by_flow_x, by_flow_y = wx * (rx - change_x), wy * (ry - change_y)
        by_dx = by_flow_x * lambda_l[k] - by_rx * delta_l[k] + wx * (mixed_x + 2 * dx * cl)
        by_dy = by_flow_y * lambda_l[k] - by_ry * delta_l[k] + wy * (mixed_y + 2 * dy * cl)
        by_x, by_y, by_h = -by_rx, -by_ry, 0.0
        if apart:
            wdx, wdy = wx * dx, wy * dy
            for a in range(6):
                flow, change = flows[p, a], changes[p, a]
                gx[a] = by_flow_x * flow - by_rx * change + 2 * wx * gx[a] + wdx * e_here[a]
                gy[a] = by_flow_y * flow - by_ry * change + 2 * wy * gy[a] + wdy * e_here[a]
                d_flows[p, a] += by_flow_x * jx[a] + by_flow_y * jy[a]
                d_changes[p, a] -= by_rx * jx[a] + by_ry * jy[a]
                ax, ay = wx * jx[a], wy * jy[a]
                for b in range(6):
                    d_diagonals[p, a, b] += ax * jx[b] + ay * jy[b]
            if rows[i] >= 0:
                for a in range(6):
                    by_e = wdx * jx[a] + wdy * jy[a]
                    for b in range(6):
                        d_adjoints[p, a, b] -= by_e * e_i[b]
            by_h = gx[0] - x * gx[2] + gy[1] - y * gy[2]
            by_x += 2 * x * gx[4] - h * gx[2] - y * gx[3] + y * gy[4] + gy[5]
            by_y += x * gy[4] - x * gx[3] - gx[5] - h * gy[2] - 2 * y * gy[3]
        # By the point and the motion
        tz = m[2, 3]
        by_x -= by_dx * tz * inv_z
        by_y -= by_dy * tz * inv_z
        by_inv = by_dx * (m[0, 3] - x * tz) + by_dy * (m[1, 3] - y * tz) + by_h * d + by_x * px + by_y * py
        by_px, by_py, by_pz = by_x * inv_z, by_y * inv_z, -by_inv * inv_z * inv_z
        g = d_motions[p]
        g[0, 3] += by_dx * inv_z + by_px * d
        g[1, 3] += by_dy * inv_z + by_py * d
        g[2, 3] += by_pz * d - (by_dx * x + by_dy * y) * inv_z
        g[0, 0] += by_px * u
        g[0, 1] += by_px * v
        g[0, 2] += by_px
        g[1, 0] += by_py * u
        g[1, 1] += by_py * v
        g[1, 2] += by_py
        g[2, 0] += by_pz * u
        g[2, 1] += by_pz * v
        g[2, 2] += by_pz
        d_depths[k] += by_h * inv_z + by_px * m[0, 3] + by_py * m[1, 3] + by_pz * m[2, 3]
        # By what is measured
        by_u = (m[0, 0] * by_px + m[1, 0] * by_py + m[2, 0] * by_pz) / fix
        by_v = (m[0, 1] * by_px + m[1, 1] * by_py + m[2, 1] * by_pz) / fiy
        d_centres[k, 0] += by_u
        d_centres[k, 1] += by_v
        d_intrinsics[i, 0] -= by_u * u
        d_intrinsics[i, 1] -= by_v * v
        d_intrinsics[i, 2] -= by_u
        d_intrinsics[i, 3] -= by_v
        by_tx, by_ty = by_rx / fx, by_ry / fy
        d_targets[edge, 0] += by_tx
        d_targets[edge, 1] += by_ty
        by_wx, by_wy = by_wx * slope * fx, by_wy * slope * fy
        d_weights[edge, 0] += by_wx * fx
        d_weights[edge, 1] += by_wy * fy
        d_intrinsics[j, 0] += 2 * by_wx * weight_x - by_tx * tx
        d_intrinsics[j, 1] += 2 * by_wy * weight_y - by_ty * ty
        d_intrinsics[j, 2] -= by_tx
        d_intrinsics[j, 3] -= by_ty
    for p in range(count):
        i = rows[ends[p, 0]]
        if ends[p, 0] == ends[p, 1] or i < 0:
            continue
        for a in range(6):
            for b in range(6):
                total = -d_flows[p, a] * lambda_p[i + b] - d_changes[p, a] * delta_p[i + b]
                for c in range(6):
                    total += 2 * d_diagonals[p, a, c] * turned[p, c, b]
                d_adjoints[p, a, b] += total
    _add_motion_gradients(poses, ends, motions, d_motions, d_adjoints, d_poses)


@part
def _add_motion_gradients(
    poses: Array, ends: Array, motions: Array, d_motions: Array, d_adjoints: Array, d_poses: Array
) -> None:
    """From the motions ``(Q, 3, 4)`` of the pairs of frames and their adjoints ``(Q, 6, 6)`` to the poses."""
    frames = len(poses)
    rotations, d_rotations = np.empty((frames, 9)), np.zeros((frames, 3, 3))
    for n in range(frames):
        _rotation(poses[n, 3], poses[n, 4], poses[n, 5], poses[n, 6], rotations[n])
    skew = np.empty((3, 3))
    for p in range(len(ends)):
        i, j, m, g, ad = ends[p, 0], ends[p, 1], motions[p], d_motions[p], d_adjoints[p]
        for a in range(3):
            for b in range(3):
                g[a, b] += ad[a, b] + ad[3 + a, 3 + b]
                x = 0.0
                for c in range(3):
                    x += ad[a, 3 + c] * m[b, c]
                skew[a, b] = x
        for b in range(3):  # minus the skew matrix of t times the upper right block
            g[0, b] += m[2, 3] * ad[1, 3 + b] - m[1, 3] * ad[2, 3 + b]
            g[1, b] += m[0, 3] * ad[2, 3 + b] - m[2, 3] * ad[0, 3 + b]
            g[2, b] += m[1, 3] * ad[0, 3 + b] - m[0, 3] * ad[1, 3 + b]
        g[0, 3] += skew[2, 1] - skew[1, 2]
        g[1, 3] += skew[0, 2] - skew[2, 0]
        g[2, 3] += skew[1, 0] - skew[0, 1]
        for a in range(3):
            d_poses[j, a] += g[a, 3]
            for b in range(3):
                d_poses[i, b] -= m[a, b] * g[a, 3]
                g[a, b] -= g[a, 3] * poses[i, b]
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    d_rotations[j, a, b] += g[a, c] * rotations[i, 3 * c + b]
                    d_rotations[i, a, b] += g[c, a] * rotations[j, 3 * c + b]
    for n in range(frames):
        x, y, z, w = poses[n, 3], poses[n, 4], poses[n, 5], poses[n, 6]
        _add_matrix_gradient(x, y, z, w, d_rotations[n], d_poses[n, 3:])
