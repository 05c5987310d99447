"""Kernels of :mod:`dvo.ba.sparse.global_edges`: cost and normal equations of reprojection edges in one pass."""

from __future__ import annotations

import math

import numpy as np

from dvo.core.compiled import compiled, part
from dvo.geometry.bounds import MIN_Z_VALID

NONE, HUBER, CAUCHY = 0, 1, 2
"""Names of robust kernels as numbers."""
_MOST = 1e150  # product of which the logarithm is taken


@part
def _slope(s, name, width):
    square = width * width
    if name == HUBER:
        return width / math.sqrt(max(s, square))
    if name == CAUCHY:
        return 1 / (1 + s / square)
    return 1.0


@part
def _relative(rotation, translation, i, j, r, move):
    """Rotation and translation of ``T_j T_i^-1``, into the last two arguments."""
    for a in range(3):
        for b in range(3):
            r[a, b] = (
                rotation[j, a, 0] * rotation[i, b, 0]
                + rotation[j, a, 1] * rotation[i, b, 1]
                + rotation[j, a, 2] * rotation[i, b, 2]
            )
    for a in range(3):
        turned = r[a, 0] * translation[i, 0] + r[a, 1] * translation[i, 1] + r[a, 2] * translation[i, 2]
        move[a] = translation[j, a] - turned


@compiled
def cost(
    rotation, translation, depth, source, target, weight, focal, group_pair, pair_i, pair_j, order, filled, kk,
    name, width, max_residual,
):  # fmt: skip
    """Half the sum of robust squared residuals, see :meth:`ReprojectionEdges.cost`, in double precision."""
    groups, size = filled.shape
    r, move = np.empty((3, 3), rotation.dtype), np.empty(3, rotation.dtype)
    limit, total = max_residual * max_residual, 0.0
    square, product, logarithms = width * width, 1.0, 0.0  # of Cauchy's kernel: one logarithm for many edges
    for g in range(groups):
        pair = group_pair[g]
        fx, fy = focal[pair_j[pair], 0], focal[pair_j[pair], 1]
        _relative(rotation, translation, pair_i[pair], pair_j[pair], r, move)
        for m in range(size):
            if not filled[g, m]:
                continue
            place = g * size + m
            k, e = kk[place], order[place]
            a, b, d, wx, wy = source[k, 0], source[k, 1], depth[k], weight[e, 0], weight[e, 1]
            z = r[2, 0] * a + r[2, 1] * b + r[2, 2] + move[2] * d
            s = max(wx, wy) * limit
            if z > MIN_Z_VALID:
                x = (r[0, 0] * a + r[0, 1] * b + r[0, 2] + move[0] * d) / z
                y = (r[1, 0] * a + r[1, 1] * b + r[1, 2] + move[1] * d) / z
                u, v = (target[e, 0] - x) * fx, (target[e, 1] - y) * fy
                if u * u + v * v < limit:
                    s = wx * u * u + wy * v * v
            if name == CAUCHY:
                product *= 1 + s / square
                if product > _MOST:
                    logarithms, product = logarithms + math.log(product), 1.0
            elif name == HUBER and s > square:
                total += 2 * width * math.sqrt(s) - square
            else:
                total += s
    if name == CAUCHY:
        total = square * (logarithms + math.log(product))
    return 0.5 * total


@compiled
def inliers(
    rotation, translation, depth, source, target, weight, focal, group_pair, pair_i, pair_j, order, filled, kk,
    max_residual,
):  # fmt: skip
    """``(E,)`` bool, see :meth:`ReprojectionEdges.inliers`."""
    groups, size = filled.shape
    r, move = np.empty((3, 3), rotation.dtype), np.empty(3, rotation.dtype)
    limit, out = max_residual * max_residual, np.zeros(len(target), np.bool_)
    for g in range(groups):
        pair = group_pair[g]
        fx, fy = focal[pair_j[pair], 0], focal[pair_j[pair], 1]
        _relative(rotation, translation, pair_i[pair], pair_j[pair], r, move)
        for m in range(size):
            if not filled[g, m]:
                continue
            place = g * size + m
            k, e = kk[place], order[place]
            a, b, d = source[k, 0], source[k, 1], depth[k]
            z = r[2, 0] * a + r[2, 1] * b + r[2, 2] + move[2] * d
            if z > MIN_Z_VALID:
                x = (r[0, 0] * a + r[0, 1] * b + r[0, 2] + move[0] * d) / z
                y = (r[1, 0] * a + r[1, 1] * b + r[1, 2] + move[1] * d) / z
                u, v = (target[e, 0] - x) * fx, (target[e, 1] - y) * fy
                out[e] = u * u + v * v < limit and (weight[e, 0] > 0 or weight[e, 1] > 0)
    return out


@compiled
def accumulate(
    rotation, translation, depth, source, target, weight, focal, group_pair, pair_i, pair_j, order, filled, kk,
    name, width, max_residual, slot, at_target, at_source, diagonal, off_diagonal, h_pp, h_pl, h_ll, g_p, g_l,
):  # fmt: skip
    """Sums over the edges, see :meth:`ReprojectionEdges.accumulate`, added to the last five arguments.

    ``off_diagonal (P,)`` is the block of each pair of two free frames. ``h_pl`` and ``g_p`` have one row more, for
    fixed frames.
    """
    groups, size = filled.shape
    r, move = np.empty((3, 3), rotation.dtype), np.empty(3, rotation.dtype)
    free = len(g_p) - 1
    limit, real = max_residual * max_residual, h_pp.dtype.type
    h, sums = np.empty((6, 6), h_pp.dtype), np.empty(6, h_pp.dtype)
    jx, jy, row = np.empty(6, h_pp.dtype), np.empty(6, h_pp.dtype), np.empty(6, h_pp.dtype)
    ji, adjoint = np.empty((6, 6), h_pp.dtype), np.empty((6, 6), h_pp.dtype)
    for i in range(6):
        jx[i], jy[i] = real(0), real(0)
        for c in range(6):
            adjoint[i, c] = real(0)
    for g in range(groups):
        pair = group_pair[g]
        fx, fy = focal[pair_j[pair], 0], focal[pair_j[pair], 1]
        _relative(rotation, translation, pair_i[pair], pair_j[pair], r, move)
        if g == 0 or group_pair[g - 1] != pair:
            for i in range(6):
                sums[i] = real(0)
                for c in range(6):
                    h[i, c] = real(0)
            # -Ad(G_ij); J_i = -J_j Ad(G_ij)
            for c in range(3):
                for i in range(3):
                    adjoint[i, c] = adjoint[3 + i, 3 + c] = -r[i, c]
                adjoint[0, 3 + c] = move[2] * r[1, c] - move[1] * r[2, c]
                adjoint[1, 3 + c] = move[0] * r[2, c] - move[2] * r[0, c]
                adjoint[2, 3 + c] = move[1] * r[0, c] - move[0] * r[1, c]
        for m in range(size):
            if not filled[g, m]:
                continue
            place = g * size + m
            k, e = kk[place], order[place]
            a, b, d = source[k, 0], source[k, 1], depth[k]
            z = r[2, 0] * a + r[2, 1] * b + r[2, 2] + move[2] * d
            if not z > MIN_Z_VALID:
                continue
            inv_z = real(1) / z
            x = (r[0, 0] * a + r[0, 1] * b + r[0, 2] + move[0] * d) * inv_z
            y = (r[1, 0] * a + r[1, 1] * b + r[1, 2] + move[1] * d) * inv_z
            ex, ey = target[e, 0] - x, target[e, 1] - y
            if not (ex * fx) * (ex * fx) + (ey * fy) * (ey * fy) < limit:
                continue
            wx, wy = weight[e, 0] * fx * fx, weight[e, 1] * fy * fy
            factor = real(_slope(wx * ex * ex + wy * ey * ey, name, width))
            wx, wy = wx * factor, wy * factor
            near, xy = d * inv_z, x * y
            jx[0], jx[2], jx[3], jx[4], jx[5] = near, -near * x, -xy, 1 + x * x, -y
            jy[1], jy[2], jy[3], jy[4], jy[5] = near, -near * y, -(1 + y * y), xy, x
            dx, dy = (move[0] - x * move[2]) * inv_z, (move[1] - y * move[2]) * inv_z
            wdx, wdy, wex, wey = wx * dx, wy * dy, wx * ex, wy * ey
            h_ll[k] += wdx * dx + wdy * dy
            g_l[k] += wdx * ex + wdy * ey
            for i in range(6):
                lx, ly = wx * jx[i], wy * jy[i]
                sums[i] += jx[i] * wex + jy[i] * wey
                row[i] = jx[i] * wdx + jy[i] * wdy
                for c in range(i + 1):
                    h[i, c] += lx * jx[c] + ly * jy[c]
            o, p = at_target[place], at_source[place]
            for c in range(6):
                h_pl[o, c] += row[c]
            for c in range(3):
                h_pl[p, c] -= row[0] * r[0, c] + row[1] * r[1, c] + row[2] * r[2, c]
                h_pl[p, 3 + c] += (
                    row[0] * adjoint[0, 3 + c] + row[1] * adjoint[1, 3 + c] + row[2] * adjoint[2, 3 + c]
                    - row[3] * r[0, c] - row[4] * r[1, c] - row[5] * r[2, c]
                )  # fmt: skip
        if g + 1 < groups and group_pair[g + 1] == pair:
            continue
        for i in range(6):
            for c in range(i):
                h[c, i] = h[i, c]
        sj, si = slot[pair_j[pair]], slot[pair_i[pair]]
        for c in range(6):
            g_p[sj, c] += sums[c]
            part = real(0)
            for i in range(6):
                part += adjoint[i, c] * sums[i]
            g_p[si, c] += part
        if sj < free:
            here = h_pp[diagonal[sj]]
            for i in range(6):
                for c in range(6):
                    here[i, c] += h[i, c]
        if si >= free:
            continue
        for i in range(6):
            for c in range(6):
                part = real(0)
                for n in range(6):
                    part += h[i, n] * adjoint[n, c]
                ji[i, c] = part
        here = h_pp[diagonal[si]]
        for i in range(6):
            for c in range(6):
                part = real(0)
                for n in range(6):
                    part += adjoint[n, i] * ji[n, c]
                here[i, c] += part
        if sj >= free:
            continue
        here = h_pp[off_diagonal[pair]]
        for i in range(6):
            for c in range(6):
                if sj > si:
                    here[i, c] += ji[i, c]
                elif sj < si:
                    here[i, c] += ji[c, i]
                else:
                    here[i, c] += ji[i, c] + ji[c, i]
