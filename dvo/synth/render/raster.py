"""Rasterisation of triangles: exact coverage and depth at pixel centres, for meshes of 100,000 triangles and more.

With corners ``v0 v1 v2`` in the camera, the ray ``r = (x', y', 1)`` through a pixel meets the triangle's plane at
``Z r = sum_i b_i v_i``. By Cramer's rule ``b_i / Z = (v_j x v_k) . r / det``, with ``det = v0 . (v1 x v2)``: linear in
the pixel. All three are positive inside, and they add up to 1/Z (homogeneous rasterisation, Olano and Greer 1997), so
that triangles which reach behind the camera need no clipping. The edge functions of two triangles that share an edge
are exact negatives of each other, which leaves no crack between them.

Work is laid out flat: triangles, then (triangle, row) pairs with the span of pixels between the edges, then pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

NEAR = 1e-6  # of the mesh's scale; nearer than this nothing is seen
PIECE = 60_000  # pixels tested at once: temporaries that stay in a processor's cache
WIDEN = 1e-6  # pixels by which spans are widened before the exact test


@dataclass
class Cover:
    """Visible triangle of each pixel of one camera.

    Attributes:
        triangle: ``(H, W)`` int64 row of ``index`` and ``functions``, -1 for none.
        inverse_depth: ``(H, W)`` float64, 0 for none.
        index: ``(S,)`` triangles that may be visible.
        functions: ``(S, 3, 3)`` float64: b_i / Z from (x, y, 1).
    """

    triangle: Tensor
    inverse_depth: Tensor
    index: Tensor
    functions: Tensor


def _windows(local: Tensor, k: Tensor, near: float) -> tuple[Tensor, Tensor, Tensor]:
    """Pixel bounds ``low (T, 2)``, ``high (T, 2)``, and ``(T,)`` bool: any part lies in front."""
    z = local[..., 2]
    front = z > near
    scale = 1 / torch.where(front, z, 1.0)[..., None]
    at = local[..., :2] * scale * k[:2] + k[2:]
    far = torch.finfo(at.dtype).max
    low = torch.where(front[..., None], at, far).amin(1)
    high = torch.where(front[..., None], at, -far).amax(1)
    cut = (front.any(1) & ~front.all(1)).nonzero()[:, 0]
    if len(cut):  # these also reach to where their edges cross the near plane
        a, b = local[cut], local[cut].roll(-1, 1)
        crosses = (a[..., 2] > near) != (b[..., 2] > near)
        share = torch.where(crosses, (near - a[..., 2]) / torch.where(crosses, b[..., 2] - a[..., 2], 1.0), 0.0)
        point = (a + share[..., None] * (b - a))[..., :2] / near * k[:2] + k[2:]
        low[cut] = torch.minimum(low[cut], torch.where(crosses[..., None], point, far).amin(1))
        high[cut] = torch.maximum(high[cut], torch.where(crosses[..., None], point, -far).amax(1))
    return low, high, front.any(1)


def _spread(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Owner and rank within it of each of ``counts.sum()`` items, for ``counts (M,)``."""
    owner = torch.repeat_interleave(counts)
    rank = torch.arange(len(owner), device=counts.device) - (counts.cumsum(0) - counts)[owner]
    return owner, rank


def _setup(
    corners: Tensor, rotation: Tensor, centre: Tensor, k: Tensor, height: int, width: int, near: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Triangles in sight: index ``(S,)``, edge functions ``(S, 3, 3)``, det ``(S,)``, window ``(S, 4)`` x0 x1 y0 y1."""
    local = (corners - centre) @ rotation
    low, high, front = _windows(local, k, near)
    size = torch.tensor([width, height], device=corners.device)
    first = (low - WIDEN).ceil().clamp_min(0)
    last = torch.minimum((high + WIDEN).floor(), size - 1.0)
    index = (front & (last >= first).all(1)).nonzero()[:, 0]
    local, window = local[index], torch.cat([first[index], last[index]], 1).long()[:, [0, 2, 1, 3]]
    following, previous = local.roll(-1, 1), local.roll(-2, 1)
    cross = torch.linalg.cross(following, previous)  # (S, 3, 3) row i: v_j x v_k
    det = (local[:, 0] * cross[:, 0]).sum(-1)
    k_inverse = torch.zeros(3, 3, dtype=k.dtype, device=k.device)
    k_inverse[0, 0], k_inverse[0, 2] = 1 / k[0], -k[2] / k[0]
    k_inverse[1, 1], k_inverse[1, 2], k_inverse[2, 2] = 1 / k[1], -k[3] / k[1], 1
    thick = det.abs() > 1e-14 * local.norm(dim=-1).prod(1)  # seen exactly edge-on, a triangle covers nothing
    return index[thick], (cross @ k_inverse)[thick], det[thick], window[thick]


def rasterise(
    corners: Tensor, rotation: Tensor, centre: Tensor, intrinsics: Tensor, height: int, width: int, *, near: float
) -> Cover:
    """Nearest triangle at every pixel centre; triangles are two-sided.

    Args:
        corners: ``(T, 3, 3)`` float64 corners in the world (triangle, corner, coordinate).
        rotation, centre: ``(3, 3)``, ``(3,)`` float64 camera to world.
        intrinsics: ``(4,)`` float64 fx fy cx cy, pixels.
        height, width: of the image, pixels.
        near: smallest visible depth, world units.

    Returns:
        The visible triangles.
    """
    device = corners.device
    index, edges, det, window = _setup(corners, rotation, centre, intrinsics, height, width, near)
    nearest = torch.zeros(height * width, dtype=torch.float64, device=device)
    chosen = torch.full((height * width,), -1, dtype=torch.int64, device=device)
    sign = torch.sign(det)
    # Rows of all triangles, each with the span of x where no edge function is negative.
    owner, rank = _spread(window[:, 3] - window[:, 2] + 1)
    y = window[owner, 2] + rank
    x0, x1 = window[owner, 0].double(), window[owner, 1].double()
    for i in range(3):
        slope = edges[owner, i, 0] * sign[owner]
        rest = (edges[owner, i, 1] * y + edges[owner, i, 2]) * sign[owner]
        root = -rest / slope  # an infinity or NaN where the edge is level: fmin and fmax pass NaN over
        x0 = torch.where(slope > 0, torch.fmax(x0, root - WIDEN), x0)
        x1 = torch.where(slope < 0, torch.fmin(x1, root + WIDEN), x1)
    x0, x1 = x0.ceil(), x1.floor()
    some = (x1 >= x0).nonzero()[:, 0]
    owner, y, x0, counts = owner[some], y[some], x0[some].long(), (x1 - x0)[some].long() + 1
    total = counts.cumsum(0)
    begin = 0
    while begin < len(owner):
        reach = total[begin - 1] + PIECE if begin else torch.tensor(PIECE, device=device)
        end = max(int(torch.searchsorted(total, reach, right=True)), begin + 1)
        row, step = _spread(counts[begin:end])
        triangle, x, at_y = owner[begin:end][row], x0[begin:end][row] + step, y[begin:end][row]
        value = [_linear(edges[:, i], triangle, x, at_y) for i in range(3)]
        inverse = (value[0] + value[1] + value[2]) / det[triangle]
        side = sign[triangle]
        inside = (value[0] * side >= 0) & (value[1] * side >= 0) & (value[2] * side >= 0)
        keep = (inside & (inverse > 0) & (inverse <= 1 / near)).nonzero()[:, 0]
        _resolve(nearest, chosen, (at_y * width + x)[keep], inverse[keep], triangle[keep])
        begin = end
    functions = edges / det[:, None, None]
    return Cover(chosen.view(height, width), nearest.view(height, width), index, functions)


def _linear(functions: Tensor, triangle: Tensor, x: Tensor, y: Tensor) -> Tensor:
    rows = functions[triangle]
    return rows[:, 0] * x + rows[:, 1] * y + rows[:, 2]


def _resolve(nearest: Tensor, chosen: Tensor, pixel: Tensor, inverse: Tensor, triangle: Tensor) -> None:
    """Depth test in place; of equally near triangles the first wins, independent of the order of work."""
    before = nearest[pixel]
    nearest.scatter_reduce_(0, pixel, inverse, "amax")
    wins = inverse == nearest[pixel]
    chosen[pixel[wins & (inverse > before)]] = torch.iinfo(torch.int64).max
    chosen.scatter_reduce_(0, pixel[wins], triangle[wins], "amin")
