"""Kernels of Gauss-Newton steps on the reprojection of patches by one camera, on an accelerator. Imports triton.

The formulas are those of :mod:`dvo.ba.layer.edgewise_kernels`: values are float32, sums and the solution of the
equations float64. Each sum is taken by one program over edges in a fixed order, so that a result is the same again, and
nothing is waited for. :mod:`dvo.ba.layer.grouped` is the twin.

Shapes: ``B`` batch, ``N`` frames, ``K`` patches, ``E`` edges, ``F`` free poses, ``P = 6 F``. A pair of frames has a row
of ``ROW`` numbers: ``J_j^T W J_j`` by rows, ``J_j^T W r``, the motion ``(3, 4)`` and ``-Ad`` of it by rows.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from dvo.ba.layer.reprojection import MARGIN
from dvo.ba.layer.schur import RETRIES
from dvo.ba.limits import LARGEST
from dvo.ba.options import BAOptions
from dvo.core.device_triton import on_device
from dvo.geometry.projection import MIN_Z_VALID
from dvo.geometry.so3 import SMALL

MOST_FRAMES, MOST_FREE = 64, 10
"""Frames, and of these free ones, of a problem for these kernels: what a program holds in its registers."""
ROW = 96
_ROBUST = {"none": 0, "huber": 1, "cauchy": 2}
_LARGEST, _SMALL, _RETRIES = tl.constexpr(LARGEST), tl.constexpr(SMALL), tl.constexpr(RETRIES)
_TINY = tl.constexpr(torch.finfo(torch.float32).tiny)
_ROW = tl.constexpr(ROW)


@triton.jit
def _number(place, mask):
    return tl.load(place, mask=mask, other=0.0).to(tl.float64)


@triton.jit
def _rotation(x, y, z, w):
    two = 2.0 / (x * x + y * y + z * z + w * w)
    xx, yy, zz, xy, xz, yz = two * x * x, two * y * y, two * z * z, two * x * y, two * x * z, two * y * z
    xw, yw, zw = two * x * w, two * y * w, two * z * w
    return 1 - yy - zz, xy - zw, xz + yw, xy + zw, 1 - xx - zz, yz - xw, xz - yw, yz + xw, 1 - xx - yy


@triton.jit
def _pose(place):
    x, y, z = tl.load(place + 3).to(tl.float64), tl.load(place + 4).to(tl.float64), tl.load(place + 5).to(tl.float64)
    r = _rotation(x, y, z, tl.load(place + 6).to(tl.float64))
    t = tl.load(place).to(tl.float64), tl.load(place + 1).to(tl.float64), tl.load(place + 2).to(tl.float64)
    return r, t


@triton.jit
def _edge_terms(  # type: ignore[no-untyped-def]
    m, i, j, k, e, here, depths, centres, intrinsics, targets, weights,
    least_z, longest, middle_x, middle_y, reach_x, reach_y, scale, robust: tl.constexpr,
):  # fmt: skip
    """Projection, residual and weights of edges; weights are zero for what does not count.

    ``m``: the motion, 12 numbers; ``i, j, k, e``: frames, patch and edge; ``here``: of those that are there.
    """
    tx, ty = _number(targets + 2 * e, here), _number(targets + 2 * e + 1, here)
    wx, wy = _number(weights + 2 * e, here), _number(weights + 2 * e + 1, here)
    use = here & (tl.abs(tx) <= _LARGEST) & (tl.abs(ty) <= _LARGEST)
    use &= (tl.abs(wx) < float("inf")) & (tl.abs(wy) < float("inf"))
    d = _number(depths + k, here)
    fx, fy = tl.where(here, _number(intrinsics + 4 * i, here), 1.0), _number(intrinsics + 4 * i + 1, here)
    u = (_number(centres + 2 * k, here) - _number(intrinsics + 4 * i + 2, here)) / fx
    v = (_number(centres + 2 * k + 1, here) - _number(intrinsics + 4 * i + 3, here)) / tl.where(here, fy, 1.0)
    z = m[8] * u + m[9] * v + m[10] + m[11] * d
    use &= z > least_z
    inv_z = 1.0 / tl.where(use, z, 1.0)
    x, y = (m[0] * u + m[1] * v + m[2] + m[3] * d) * inv_z, (m[4] * u + m[5] * v + m[6] + m[7] * d) * inv_z
    fx, fy = tl.where(here, _number(intrinsics + 4 * j, here), 1.0), _number(intrinsics + 4 * j + 1, here)
    fy = tl.where(here, fy, 1.0)
    cx, cy = _number(intrinsics + 4 * j + 2, here), _number(intrinsics + 4 * j + 3, here)
    rx, ry = (tx - cx) / fx - x, (ty - cy) / fy - y
    use &= rx * fx * (rx * fx) + ry * fy * (ry * fy) < longest * longest
    use &= (tl.abs(cx - middle_x + x * fx) < reach_x) & (tl.abs(cy - middle_y + y * fy) < reach_y)
    # What does not count may be no number: it is left out here, and not by its weight.
    x, y, inv_z = tl.where(use, x, 0.0), tl.where(use, y, 0.0), tl.where(use, inv_z, 0.0)
    rx, ry = tl.where(use, rx, 0.0), tl.where(use, ry, 0.0)
    wx, wy = tl.where(use, wx * fx * fx, 0.0), tl.where(use, wy * fy * fy, 0.0)
    if robust != 0:
        s = (wx * rx * rx + wy * ry * ry) / (scale * scale)
        slope = 1.0 / (1.0 + s)
        if robust == 1:
            slope = tl.where(s > 1.0, 1.0 / tl.sqrt(tl.where(s > 1.0, s, 1.0)), 1.0)
        wx, wy = wx * slope, wy * slope
    return x, y, tl.where(use, d, 0.0) * inv_z, inv_z, rx, ry, wx, wy


@triton.jit(do_not_specialize=["frames", "patches", "edges"])
def sum_pairs(  # type: ignore[no-untyped-def]
    poses, depths, centres, intrinsics, targets, weights, kk, order, starts, table, frames, patches, edges,
    least_z, longest, middle_x, middle_y, reach_x, reach_y, scale, robust: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    """Rows ``table (B, N N, ROW)`` of the pairs of frames; programs ``(N N, B)``.

    ``order (E,)``: edges by pair; ``starts (N N + 1,)``: first of each pair among them.
    """
    pair, b = tl.program_id(0), tl.program_id(1).to(tl.int64)
    i, j = pair // frames, pair % frames
    poses, intrinsics = poses + 7 * b * frames, intrinsics + 4 * b * frames
    depths, centres = depths + b * patches, centres + 2 * b * patches
    targets, weights = targets + 2 * b * edges, weights + 2 * b * edges
    ri, ti = _pose(poses + 7 * i)
    rj, tj = _pose(poses + 7 * j)
    r00 = rj[0] * ri[0] + rj[1] * ri[1] + rj[2] * ri[2]
    r01 = rj[0] * ri[3] + rj[1] * ri[4] + rj[2] * ri[5]
    r02 = rj[0] * ri[6] + rj[1] * ri[7] + rj[2] * ri[8]
    r10 = rj[3] * ri[0] + rj[4] * ri[1] + rj[5] * ri[2]
    r11 = rj[3] * ri[3] + rj[4] * ri[4] + rj[5] * ri[5]
    r12 = rj[3] * ri[6] + rj[4] * ri[7] + rj[5] * ri[8]
    r20 = rj[6] * ri[0] + rj[7] * ri[1] + rj[8] * ri[2]
    r21 = rj[6] * ri[3] + rj[7] * ri[4] + rj[8] * ri[5]
    r22 = rj[6] * ri[6] + rj[7] * ri[7] + rj[8] * ri[8]
    t0 = tj[0] - r00 * ti[0] - r01 * ti[1] - r02 * ti[2]
    t1 = tj[1] - r10 * ti[0] - r11 * ti[1] - r12 * ti[2]
    t2 = tj[2] - r20 * ti[0] - r21 * ti[1] - r22 * ti[2]
    m = r00, r01, r02, t0, r10, r11, r12, t1, r20, r21, r22, t2
    lane, same = tl.arange(0, block), tl.zeros((block,), tl.int64)
    none = tl.zeros((block,), tl.float64)
    s00, s02, s03, s04, s05, s11, s12, s13, s14, s15 = none, none, none, none, none, none, none, none, none, none
    s22, s23, s24, s25, s33, s34, s35, s44, s45, s55 = none, none, none, none, none, none, none, none, none, none
    g0, g1, g2, g3, g4, g5 = none, none, none, none, none, none
    # An edge from a frame into itself moves with no pose.
    end = tl.load(starts + pair + (i != j).to(tl.int32))
    for first in range(tl.load(starts + pair), end, block):
        here = first + lane < end
        e = tl.load(order + first + lane, mask=here, other=0)
        k = tl.load(kk + e, mask=here, other=0)
        here &= (k >= 0) & (k < patches)
        x, y, h, inv_z, rx, ry, wx, wy = _edge_terms(
            m, same + i, same + j, k, e, here, depths, centres, intrinsics, targets, weights,
            least_z, longest, middle_x, middle_y, reach_x, reach_y, scale, robust,
        )  # fmt: skip
        # J_x = (h, 0, -h x, -x y, x x + 1, -y), J_y = (0, h, -h y, -y y - 1, x y, x)
        a2, a3, a4, b2, b3 = -h * x, -x * y, x * x + 1, -h * y, -y * y - 1
        s00 += wx * h * h
        s02 += wx * h * a2
        s03 += wx * h * a3
        s04 += wx * h * a4
        s05 -= wx * h * y
        s11 += wy * h * h
        s12 += wy * h * b2
        s13 += wy * h * b3
        s14 -= wy * h * a3
        s15 += wy * h * x
        s22 += wx * a2 * a2 + wy * b2 * b2
        s23 += wx * a2 * a3 + wy * b2 * b3
        s24 += wx * a2 * a4 - wy * b2 * a3
        s25 += wy * b2 * x - wx * a2 * y
        s33 += wx * a3 * a3 + wy * b3 * b3
        s34 += wx * a3 * a4 - wy * b3 * a3
        s35 += wy * b3 * x - wx * a3 * y
        s44 += wx * a4 * a4 + wy * a3 * a3
        s45 -= wx * a4 * y + wy * a3 * x
        s55 += wx * y * y + wy * x * x
        g0 += wx * h * rx
        g1 += wy * h * ry
        g2 += wx * a2 * rx + wy * b2 * ry
        g3 += wx * a3 * rx + wy * b3 * ry
        g4 += wx * a4 * rx - wy * a3 * ry
        g5 += wy * x * ry - wx * y * rx
    out = table + (b * frames * frames + pair) * _ROW
    zero = tl.sum(none)
    s00, s02, s03, s04, s05 = tl.sum(s00), tl.sum(s02), tl.sum(s03), tl.sum(s04), tl.sum(s05)
    s11, s12, s13, s14, s15 = tl.sum(s11), tl.sum(s12), tl.sum(s13), tl.sum(s14), tl.sum(s15)
    s22, s23, s24, s25 = tl.sum(s22), tl.sum(s23), tl.sum(s24), tl.sum(s25)
    s33, s34, s35, s44, s45, s55 = tl.sum(s33), tl.sum(s34), tl.sum(s35), tl.sum(s44), tl.sum(s45), tl.sum(s55)
    _store6(out, s00, zero, s02, s03, s04, s05)
    _store6(out + 6, zero, s11, s12, s13, s14, s15)
    _store6(out + 12, s02, s12, s22, s23, s24, s25)
    _store6(out + 18, s03, s13, s23, s33, s34, s35)
    _store6(out + 24, s04, s14, s24, s34, s44, s45)
    _store6(out + 30, s05, s15, s25, s35, s45, s55)
    _store6(out + 36, tl.sum(g0), tl.sum(g1), tl.sum(g2), tl.sum(g3), tl.sum(g4), tl.sum(g5))
    _store6(out + 42, r00, r01, r02, t0, r10, r11)
    _store6(out + 48, r12, t1, r20, r21, r22, t2)
    _store6(out + 54, -r00, -r01, -r02, t2 * r10 - t1 * r20, t2 * r11 - t1 * r21, t2 * r12 - t1 * r22)
    _store6(out + 60, -r10, -r11, -r12, t0 * r20 - t2 * r00, t0 * r21 - t2 * r01, t0 * r22 - t2 * r02)
    _store6(out + 66, -r20, -r21, -r22, t1 * r00 - t0 * r10, t1 * r01 - t0 * r11, t1 * r02 - t0 * r12)
    _store6(out + 72, zero, zero, zero, -r00, -r01, -r02)
    _store6(out + 78, zero, zero, zero, -r10, -r11, -r12)
    _store6(out + 84, zero, zero, zero, -r20, -r21, -r22)


@triton.jit
def _store6(place, a, b, c, d, e, f):
    tl.store(place, a)
    tl.store(place + 1, b)
    tl.store(place + 2, c)
    tl.store(place + 3, d)
    tl.store(place + 4, e)
    tl.store(place + 5, f)


@triton.jit
def _to_frames(total, f, to, value):
    """Add values of edges to those of the frames that they belong to."""
    return total + tl.sum(tl.where(to[:, None] == f[None, :], value[:, None], 0.0), 0)


@triton.jit(do_not_specialize=["frames", "patches", "edges", "fixed"])
def sum_patches(  # type: ignore[no-untyped-def]
    depths, centres, intrinsics, targets, weights, ii, jj, order, starts, table, h_lp, h_ll, g_l, frames, patches,
    edges, fixed, damping, least_z, longest, middle_x, middle_y, reach_x, reach_y, scale, robust: tl.constexpr,
    block: tl.constexpr, wide: tl.constexpr,
):  # fmt: skip
    """``h_lp (B, K, P)``, ``h_ll`` and ``g_l (B, K)``; programs ``(K, B)``. ``order``: edges by patch."""
    k, b = tl.program_id(0), tl.program_id(1).to(tl.int64)
    intrinsics, table = intrinsics + 4 * b * frames, table + b * frames * frames * _ROW
    depths, centres = depths + b * patches, centres + 2 * b * patches
    targets, weights = targets + 2 * b * edges, weights + 2 * b * edges
    lane, same, f = tl.arange(0, block), tl.zeros((block,), tl.int64), tl.arange(0, wide)
    none = tl.zeros((wide,), tl.float64)
    a0, a1, a2, a3, a4, a5 = none, none, none, none, none, none
    curvature, gradient = tl.zeros((block,), tl.float64), tl.zeros((block,), tl.float64)
    end = tl.load(starts + k + 1)
    for first in range(tl.load(starts + k), end, block):
        here = first + lane < end
        e = tl.load(order + first + lane, mask=here, other=0)
        i, j = tl.load(ii + e, mask=here, other=0), tl.load(jj + e, mask=here, other=0)
        here &= (i >= 0) & (i < frames) & (j >= 0) & (j < frames)
        i, j = tl.where(here, i, 0), tl.where(here, j, 0)
        row = table + (i * frames + j) * _ROW + 42
        m0, m1, m2, m3 = _number(row, here), _number(row + 1, here), _number(row + 2, here), _number(row + 3, here)
        m4, m5, m6, m7 = _number(row + 4, here), _number(row + 5, here), _number(row + 6, here), _number(row + 7, here)
        m8, m9, m10 = _number(row + 8, here), _number(row + 9, here), _number(row + 10, here)
        m11 = _number(row + 11, here)
        x, y, h, inv_z, rx, ry, wx, wy = _edge_terms(
            (m0, m1, m2, m3, m4, m5, m6, m7, m8, m9, m10, m11), i, j, same + k, e, here, depths, centres, intrinsics,
            targets, weights, least_z, longest, middle_x, middle_y, reach_x, reach_y, scale, robust,
        )  # fmt: skip
        dx, dy = (m3 - x * m11) * inv_z, (m7 - y * m11) * inv_z
        wx, wy = wx * dx, wy * dy
        curvature += wx * dx + wy * dy
        gradient += wx * rx + wy * ry
        apart = i != j
        wx, wy = tl.where(apart, wx, 0.0), tl.where(apart, wy, 0.0)
        e0, e1, e2 = wx * h, wy * h, -h * (wx * x + wy * y)
        e3, e4, e5 = -wx * x * y - wy * (y * y + 1), wx * (x * x + 1) + wy * x * y, wy * x - wx * y
        a0, a1, a2 = _to_frames(a0, f, j, e0), _to_frames(a1, f, j, e1), _to_frames(a2, f, j, e2)
        a3, a4, a5 = _to_frames(a3, f, j, e3), _to_frames(a4, f, j, e4), _to_frames(a5, f, j, e5)
        # J_i = -J_j Ad
        e3 -= m7 * e2 - m11 * e1
        e4 -= m11 * e0 - m3 * e2
        e5 -= m3 * e1 - m7 * e0
        a0 = _to_frames(a0, f, i, -m0 * e0 - m4 * e1 - m8 * e2)
        a1 = _to_frames(a1, f, i, -m1 * e0 - m5 * e1 - m9 * e2)
        a2 = _to_frames(a2, f, i, -m2 * e0 - m6 * e1 - m10 * e2)
        a3 = _to_frames(a3, f, i, -m0 * e3 - m4 * e4 - m8 * e5)
        a4 = _to_frames(a4, f, i, -m1 * e3 - m5 * e4 - m9 * e5)
        a5 = _to_frames(a5, f, i, -m2 * e3 - m6 * e4 - m10 * e5)
    row = b * patches + k
    place, free = h_lp + 6 * (row * (frames - fixed) + f - fixed), (f >= fixed) & (f < frames)
    tl.store(place, a0, mask=free)
    tl.store(place + 1, a1, mask=free)
    tl.store(place + 2, a2, mask=free)
    tl.store(place + 3, a3, mask=free)
    tl.store(place + 4, a4, mask=free)
    tl.store(place + 5, a5, mask=free)
    tl.store(h_ll + row, tl.sum(curvature) + damping)
    tl.store(g_l + row, tl.sum(gradient))


@triton.jit
def _product(a, b):
    """Product of two matrices ``(8, 8)``."""
    return tl.sum(a[:, :, None] * b[None, :, :], 1)


@triton.jit(do_not_specialize=["frames", "patches", "fixed"])
def eliminate(table, h_lp, h_ll, g_l, system, rest, frames, patches, fixed, block: tl.constexpr):  # type: ignore[no-untyped-def]
    """Reduced system ``system (B, P, P)`` and right-hand side ``rest (B, P)``; programs ``(F, F, B)``, a block each."""
    row, column, b = tl.program_id(0), tl.program_id(1), tl.program_id(2).to(tl.int64)
    free, p, q = frames - fixed, row + fixed, column + fixed
    table = table + b * frames * frames * _ROW
    c = tl.arange(0, 8)
    whole, inside = c[:, None] * 6 + c[None, :], (c < 6)[:, None] & (c < 6)[None, :]
    total, g = tl.zeros((8, 8), tl.float64), tl.zeros((8,), tl.float64)
    if p == q:
        for other in range(0, frames):
            if other != p:
                into, outof = table + (other * frames + p) * _ROW, table + (p * frames + other) * _ROW
                total += tl.load(into + whole, mask=inside, other=0.0)
                g += tl.load(into + 36 + c, mask=c < 6, other=0.0)
                minus = tl.load(outof + 54 + whole, mask=inside, other=0.0)
                turned = tl.trans(minus)
                total += _product(turned, _product(tl.load(outof + whole, mask=inside, other=0.0), minus))
                g += tl.sum(turned * tl.load(outof + 36 + c, mask=c < 6, other=0.0)[None, :], 1)
    else:
        there, back = table + (q * frames + p) * _ROW, table + (p * frames + q) * _ROW
        minus = tl.load(there + 54 + whole, mask=inside, other=0.0)
        total += _product(tl.load(there + whole, mask=inside, other=0.0), minus)
        minus = tl.load(back + 54 + whole, mask=inside, other=0.0)
        total += tl.trans(_product(tl.load(back + whole, mask=inside, other=0.0), minus))
    lane = tl.arange(0, block)
    for first in range(0, patches, block):
        k = first + lane
        here = k < patches
        place = h_lp + 6 * (b * patches + k) * free
        mask = (c < 6)[:, None] & here[None, :]
        left = tl.load(place[None, :] + 6 * row + c[:, None], mask=mask, other=0.0)
        right = tl.load(place[None, :] + 6 * column + c[:, None], mask=mask, other=0.0)
        curvature = tl.load(h_ll + b * patches + k, mask=here, other=0.0)
        inverse = tl.where(curvature > 0, 1.0 / tl.where(curvature > 0, curvature, 1.0), 0.0)
        left *= inverse[None, :]
        total -= tl.sum(left[:, None, :] * right[None, :, :], 2)
        g -= tl.sum(left * tl.load(g_l + b * patches + k, mask=here, other=0.0)[None, :], 1)
    size = 6 * free
    place = (b * size + 6 * row + c[:, None]) * size + 6 * column + c[None, :]
    tl.store(system + place, total, mask=inside)
    if p == q:
        tl.store(rest + b * size + 6 * row + c, g, mask=c < 6)


@triton.jit(do_not_specialize=["size"])
def solve(system, rest, steps, size, absolute, relative, wide: tl.constexpr):  # type: ignore[no-untyped-def]
    """Steps ``(B, P + 1)`` of the damped system; the last number is 0 if the step is too long. Programs ``(B,)``."""
    b = tl.program_id(0).to(tl.int64)
    c = tl.arange(0, wide)
    inside = (c < size)[:, None] & (c < size)[None, :]
    own = c[:, None] == c[None, :]
    given = tl.load(system + (b * size + c[:, None]) * size + c[None, :], mask=inside, other=0.0)
    given += tl.where(own & inside, given * relative + absolute, 0.0)
    x = tl.load(rest + b * size + c, mask=c < size, other=0.0)
    boost = tl.maximum(tl.max(tl.where(own, tl.abs(given), 0.0)), _TINY) * 1e-7
    factor, y = tl.zeros((wide, wide), tl.float64), tl.zeros((wide,), tl.float64)
    good = 0
    for attempt in range(0, _RETRIES + 1):
        if good == 0:
            good = 1
            left = given + tl.where(own, tl.where(attempt > 0, boost, 0.0), 0.0)
            right = x
            for a in range(0, size):
                column = tl.sum(tl.where(c[None, :] == a, left, 0.0), 1)
                pivot = tl.sum(tl.where(c == a, column, 0.0), 0)
                if (pivot > 0) & (pivot < float("inf")):
                    root = tl.sqrt(pivot)
                else:
                    root, good = pivot * 0 + 1, 0
                column = tl.where(c >= a, column / root, 0.0)
                left -= column[:, None] * column[None, :]
                factor = tl.where(c[None, :] == a, column[:, None], factor)
                value = tl.sum(tl.where(c == a, right, 0.0), 0) / root
                y = tl.where(c == a, value, y)
                right -= column * value
            boost *= 10
    for back in range(0, size):
        a = size - 1 - back
        column = tl.sum(tl.where(c[None, :] == a, factor, 0.0), 1)
        root = tl.sum(tl.where(c == a, column, 0.0), 0)
        known = tl.sum(tl.where((c > a) & (c < size), column * y, 0.0), 0)
        y = tl.where(c == a, (y - known) / root, y)
    y = tl.where(c < size, y, 0.0)
    finite = tl.sum(tl.abs(y), 0) < float("inf")
    y = tl.where((good == 1) & finite, y, 0.0)
    short = tl.where(tl.max(tl.abs(y), 0) > _LARGEST, 0.0, 1.0)
    tl.store(steps + b * (size + 1) + c, tl.where(short > 0, y, 0.0), mask=c < size)
    tl.store(steps + b * (size + 1) + size, short)


@triton.jit(do_not_specialize=["patches", "size"])
def move_depths(depths, h_lp, h_ll, g_l, steps, patches, size, low, high, block: tl.constexpr):  # type: ignore[no-untyped-def]
    """Step of the inverse depths ``(B, K)`` in place; programs ``(K / block, B)``."""
    k, b = tl.program_id(0) * block + tl.arange(0, block), tl.program_id(1).to(tl.int64)
    here, row = k < patches, b * patches + k
    steps += b * (size + 1)
    rest = tl.load(g_l + row, mask=here, other=0.0)
    for a in range(0, size):
        rest -= tl.load(h_lp + row * size + a, mask=here, other=0.0) * tl.load(steps + a)
    curvature = tl.load(h_ll + row, mask=here, other=0.0)
    rest = tl.where(curvature > 0, rest / tl.where(curvature > 0, curvature, 1.0), 0.0)
    rest = tl.where(tl.abs(rest) <= _LARGEST, rest, 0.0) * tl.load(steps + size)
    depth = tl.load(depths + row, mask=here, other=0.0).to(tl.float64) + rest
    depth = tl.where(depth < low, low, depth)
    tl.store(depths + row, tl.where(depth > high, high, depth).to(tl.float32), mask=here)


@triton.jit(do_not_specialize=["frames", "fixed"])
def move_poses(poses, steps, frames, fixed, wide: tl.constexpr):  # type: ignore[no-untyped-def]
    """Left retraction of the free poses ``(B, N, 7)`` in place; programs ``(B,)``."""
    n, b = tl.arange(0, wide), tl.program_id(0).to(tl.int64)
    free = (n >= fixed) & (n < frames)
    size = 6 * (frames - fixed)
    place, step = poses + 7 * (b * frames + n), steps + b * (size + 1) + 6 * (n - fixed)
    u, v, w = _number(step, free), _number(step + 1, free), _number(step + 2, free)
    a, d, c = _number(step + 3, free), _number(step + 4, free), _number(step + 5, free)
    s = a * a + d * d + c * c
    small = s < _SMALL
    low, safe = tl.where(small, s, 0.0), tl.where(small, 1.0, s)
    t = tl.sqrt(safe)
    sine, cosine = tl.sin(0.5 * t), tl.cos(0.5 * t)
    near = 0.5 + low * (-1.0 / 48 + low * (1.0 / 3840 - low / 645120))
    k = tl.where(small, near, sine / t)
    ow = tl.where(small, 1.0 + low * (-1.0 / 8 + low * (1.0 / 384 - low / 46080)), cosine)
    third = 1.0 / 6 + low * (-1.0 / 120 + low * (1.0 / 5040 - low / 362880))
    third = tl.where(small, third, (t - 2 * sine * cosine) / (safe * t))
    ox, oy, oz, second = k * a, k * d, k * c, 2 * k * k
    r = _rotation(ox, oy, oz, ow)
    px, py, pz = _number(place, free), _number(place + 1, free), _number(place + 2, free)
    cu, cv, cw = d * w - c * v, c * u - a * w, a * v - d * u
    tl.store(place, r[0] * px + r[1] * py + r[2] * pz + u + second * cu + third * (d * cw - c * cv), mask=free)
    tl.store(place + 1, r[3] * px + r[4] * py + r[5] * pz + v + second * cv + third * (c * cu - a * cw), mask=free)
    tl.store(place + 2, r[6] * px + r[7] * py + r[8] * pz + w + second * cw + third * (a * cv - d * cu), mask=free)
    x, y, z, h = _number(place + 3, free), _number(place + 4, free), _number(place + 5, free), _number(place + 6, free)
    qx, qy = ow * x + ox * h + oy * z - oz * y, ow * y + oy * h + oz * x - ox * z
    qz, qw = ow * z + oz * h + ox * y - oy * x, ow * h - ox * x - oy * y - oz * z
    length = tl.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    length = tl.where(length < 1e-12, 1e-12, length)
    tl.store(place + 3, qx / length, mask=free)
    tl.store(place + 4, qy / length, mask=free)
    tl.store(place + 5, qz / length, mask=free)
    tl.store(place + 6, qw / length, mask=free)


def take_steps(
    poses_cw: Tensor,
    depths: Tensor,
    centres: Tensor,
    intrinsics: Tensor,
    targets: Tensor,
    weights: Tensor,
    ii: Tensor,
    jj: Tensor,
    kk: Tensor,
    fixed: int,
    options: BAOptions,
) -> tuple[Tensor, Tensor]:
    """Gauss-Newton steps of a batch whose only factor is the reprojection, and whose poses and depths move.

    Args:
        poses_cw: ``(B, N, 7)``. depths: ``(B, K)``. centres: ``(B, K, 2)``. intrinsics: ``(B, N, 4)``.
        targets, weights: ``(B, E, 2)``.
        ii, jj, kk: ``(E,)`` int64; an edge with an index out of range does not count.
        fixed: number of leading poses that stay.
        options: bounds, kernel, damping, number of steps.

    Returns:
        New poses and inverse depths.
    """
    (b, n, _), patches, edges, free = poses_cw.shape, depths.shape[1], len(ii), poses_cw.shape[1] - fixed
    poses, depths = poses_cw.contiguous().clone(), depths.contiguous().clone()
    centres, intrinsics, targets, weights = (x.contiguous() for x in (centres, intrinsics, targets, weights))
    pairs, by_pair = (ii * n + jj).masked_fill((ii < 0) | (ii >= n) | (jj < 0) | (jj >= n), n * n).sort(stable=True)
    patch, by_patch = kk.sort(stable=True)
    starts_of_pairs = torch.searchsorted(pairs, torch.arange(n * n + 1, device=ii.device))
    starts_of_patches = torch.searchsorted(patch, torch.arange(patches + 1, device=ii.device))
    ii, jj, kk = (x.contiguous() for x in (ii, jj, kk))

    def made(*shape: int) -> Tensor:
        return torch.empty(b, *shape, dtype=torch.float64, device=poses.device)

    size = 6 * free
    table, h_lp, h_ll, g_l = made(n * n, ROW), made(patches, size), made(patches), made(patches)
    system, rest, steps = made(size, size), made(size), made(size + 1)
    width, height = options.bounds or (0.0, 0.0)
    margin = math.inf if options.bounds is None else MARGIN
    middle = width / 2, height / 2
    gate = (
        MIN_Z_VALID, float(options.max_residual), *middle, middle[0] + margin, middle[1] + margin,
        float(options.kernel.width), _ROBUST[options.kernel.name],
    )  # fmt: skip
    measured = centres, intrinsics, targets, weights
    damping, (low, high) = options.damping, options.depth_range
    wide = triton.next_power_of_2(n)
    with on_device(poses):
        for _ in range(options.iterations):
            sum_pairs[(n * n, b)](
                poses, depths, *measured, kk, by_pair, starts_of_pairs, table, n, patches, edges, *gate, 32,
                num_warps=1,
            )  # fmt: skip
            sum_patches[(patches, b)](
                depths, *measured, ii, jj, by_patch, starts_of_patches, table, h_lp, h_ll, g_l, n, patches, edges,
                fixed, float(damping.depth), *gate, 16, wide, num_warps=1,
            )  # fmt: skip
            eliminate[(free, free, b)](table, h_lp, h_ll, g_l, system, rest, n, patches, fixed, 32, num_warps=2)
            numbers = float(damping.pose), float(damping.relative)
            solve[(b,)](system, rest, steps, size, *numbers, triton.next_power_of_2(size), num_warps=8)
            move_depths[(triton.cdiv(patches, 64), b)](
                depths, h_lp, h_ll, g_l, steps, patches, size, float(low), float(high), 64, num_warps=2
            )  # fmt: skip
            move_poses[(b,)](poses, steps, n, fixed, wide, num_warps=2)
    return poses, depths
