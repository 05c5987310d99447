"""The renderer: flat surfaces rasterised exactly, textured and lit, in plain torch.

In the camera of frame n a plane has an inverse depth that is linear in the pixel, and so are u / Z and v / Z of its
surface coordinates and Z-scaled distances to its edges. So per frame and surface there are a few 3-vectors (computed in
float64), a pixel (x, y, 1) is covered where all edge functions are positive, and the surface of largest inverse depth
wins. Depth, identity and surface coordinates are exact; nothing is interpolated over pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dvo.errors import DvoError
from dvo.synth.poses import split
from dvo.synth.scene import Scene
from dvo.synth.textures import sample

NEAR = 1e-3  # metres; cameras keep farther away than this from everything
SLACK = 1e-5  # rad by which surfaces are fattened, so that walls sharing an edge leave no crack
Array = np.ndarray


@dataclass
class Rendering:
    """What N cameras see.

    Attributes:
        images: ``(N, 3, H, W)`` float32 RGB in [0, 1].
        depth: ``(N, H, W)`` float32 Z along the optical axis, world units; 0 where no surface is hit.
        surface: ``(N, H, W)`` int64 index of the surface, -1 where none is hit.
        uv: ``(N, H, W, 2)`` float32 coordinates in the surface, world units (see :class:`Scene`).
    """

    images: Tensor
    depth: Tensor
    surface: Tensor
    uv: Tensor


@dataclass
class _View:
    """Linear functions of the pixel (x, y, 1) for N frames and P surfaces, float64.

    ``inverse_depth (N, P, 3)``, ``u, v (N, P, 3)`` (divided by Z), ``edges (N, P, 4, 3)``, ``seen (N, P)`` bool and
    ``window (N, P, 4)`` x0 y0 x1 y1 pixel bounds.
    """

    inverse_depth: Array
    u: Array
    v: Array
    edges: Array
    seen: Array
    window: Array


def _project(scene: Scene, poses_wc: Array, intrinsics: Array) -> _View:
    rotation, centre = split(poses_wc)  # (N, 3, 3) camera to world, (N, 3)
    n = len(poses_wc)
    fx, fy, cx, cy = intrinsics.T
    zero, one = np.zeros(n), np.ones(n)
    # Rows of K^-1: ray direction = K^-1 (x, y, 1).
    k_inverse = np.stack(
        [np.stack([1 / fx, zero, -cx / fx], -1), np.stack([zero, 1 / fy, -cy / fy], -1), np.stack([zero, zero, one], -1)],
        1,
    )
    ray = rotation @ k_inverse  # world direction of a pixel: ray @ (x, y, 1)
    normal = scene.normal
    offset = scene.origin[None] - centre[:, None]  # (N, P, 3)
    height = (offset * normal).sum(-1)  # negative in front of the surface
    safe = np.where(np.abs(height) < 1e-9, 1e-9, height)
    inverse_depth = np.einsum("pi,nij->npj", normal, ray) / safe[..., None]
    u = np.einsum("pi,nij->npj", scene.u_axis, ray) - (offset * scene.u_axis).sum(-1)[..., None] * inverse_depth
    v = np.einsum("pi,nij->npj", scene.v_axis, ray) - (offset * scene.v_axis).sum(-1)[..., None] * inverse_depth
    basis = np.stack([u, v, inverse_depth], 2)  # (N, P, 3 functions, 3)
    edges = scene.edges[None] @ basis
    # Pixel bounds: the corners in front of the camera and the points where the outline crosses the near plane.
    local = np.einsum("npci,nij->npcj", scene.corners[None] - centre[:, None, None], rotation)
    following = np.roll(local, -1, 2)
    z, z_next = local[..., 2], following[..., 2]
    crosses = (z > NEAR) != (z_next > NEAR)
    share = np.where(crosses, (NEAR - z) / np.where(crosses, z_next - z, 1), 0)
    cut = local + share[..., None] * (following - local)
    points = np.concatenate([local, cut], 2)
    usable = np.concatenate([z > NEAR, crosses], 2)
    depth = np.where(usable, np.maximum(points[..., 2], NEAR), 1)
    x = points[..., 0] / depth * fx[:, None, None] + cx[:, None, None]
    y = points[..., 1] / depth * fy[:, None, None] + cy[:, None, None]
    big = 1e9
    low = [np.where(usable, c, big).min(-1) for c in (x, y)]
    high = [np.where(usable, c, -big).max(-1) for c in (x, y)]
    front = np.abs(height) > 1e-9
    seen = front & usable.any(-1) & (scene.two_sided[None] | (height < 0))
    return _View(inverse_depth, u, v, edges, seen, np.stack([*low, *high], -1))


def _cast(view: _View, height: int, width: int, device: torch.device | str) -> tuple[Tensor, Tensor]:
    """Largest inverse depth ``(N, H, W)`` and its surface (int64, -1 for none) over the pixel grid."""
    n = len(view.seen)
    x0 = np.clip(np.floor(view.window[..., 0] - 0.5), 0, width).astype(int)
    y0 = np.clip(np.floor(view.window[..., 1] - 0.5), 0, height).astype(int)
    x1 = np.clip(np.ceil(view.window[..., 2] + 1.5), 0, width).astype(int)
    y1 = np.clip(np.ceil(view.window[..., 3] + 1.5), 0, height).astype(int)
    seen = view.seen & (x1 > x0) & (y1 > y0)
    functions = np.concatenate([view.inverse_depth[:, :, None], view.edges], 2)  # (N, P, 5, 3)
    functions[~seen] = [0.0, 0.0, -1.0]  # a surface behind this camera, but seen by another one of the batch
    table = torch.from_numpy(functions.astype(np.float32)).to(device)
    nearest = torch.full((n, height, width), 1e-12, device=device)
    surface = torch.full((n, height, width), -1, dtype=torch.int32, device=device)
    xs = torch.arange(width, dtype=torch.float32, device=device)
    ys = torch.arange(height, dtype=torch.float32, device=device)
    # Per frame x and y parts of all functions, once: slicing is cheaper than recomputing.
    column = table[..., 0, None] * xs  # (N, P, 5, W)
    row = table[..., 1, None] * ys + table[..., 2, None]
    big = np.iinfo(np.int64).max
    left, top = np.where(seen, x0, big).min(0), np.where(seen, y0, big).min(0)
    right, bottom = np.where(seen, x1, 0).max(0), np.where(seen, y1, 0).max(0)
    for p in np.flatnonzero(seen.any(0)).tolist():
        a, b, c, d = int(left[p]), int(right[p]), int(top[p]), int(bottom[p])
        value = row[:, p, :, c:d, None] + column[:, p, :, None, a:b]  # (N, 5, h, w)
        best = nearest[:, c:d, a:b]
        hit = (value[:, 1:].amin(1) >= -SLACK) & (value[:, 0] > best)
        best.copy_(torch.where(hit, value[:, 0], best))
        surface[:, c:d, a:b].masked_fill_(hit, p)
    return nearest, surface.long()


def _linear(rows: Tensor, x: Tensor, y: Tensor) -> Tensor:
    return rows[..., 0] * x + rows[..., 1] * y + rows[..., 2]


def _shade(
    scene: Scene, view: _View, frame: Tensor, x: Tensor, y: Tensor, surface: Tensor, taps: int
) -> Tensor:
    """Colour ``(M, 3)`` in [0, 1] of M pixels (frame index, x, y) that show ``surface (M,)`` (none negative)."""
    device = surface.device
    p = len(scene)
    tables = scene.tensors(device)
    basis = np.stack([view.u, view.v, view.inverse_depth], 2)
    texture = scene.texture_map[None] @ basis  # (N, P, 2, 3)
    light = scene.light_map[None] @ basis
    packed = np.concatenate([view.inverse_depth[:, :, None], texture, light], 2).astype(np.float32)
    functions = torch.from_numpy(packed.reshape(-1, 15)).to(device)
    f = functions.index_select(0, frame * p + surface).view(-1, 5, 3)
    about = tables["surface"].index_select(0, surface)
    index = tables["index"].index_select(0, surface)
    z = 1 / _linear(f[:, 0], x, y)
    s, t = _linear(f[:, 1], x, y) * z, _linear(f[:, 2], x, y) * z
    # Jacobian of texel coordinates by pixel, from the quotient rule.
    sx, sy = (f[:, 1, 0] - s * f[:, 0, 0]) * z, (f[:, 1, 1] - s * f[:, 0, 1]) * z
    tx, ty = (f[:, 2, 0] - t * f[:, 0, 0]) * z, (f[:, 2, 1] - t * f[:, 0, 1]) * z
    along_x, along_y = (sx * sx + tx * tx).sqrt(), (sy * sy + ty * ty).sqrt()
    major = torch.maximum(along_x, along_y)
    minor = (sx * ty - sy * tx).abs() / major.clamp_min(1e-9)
    footprint = torch.maximum(minor, major / taps)
    wide = along_x >= along_y
    step_s, step_t = torch.where(wide, sx, sy), torch.where(wide, tx, ty)
    colour: Tensor | None = None
    for k in range(taps):
        shift = (k + 0.5) / taps - 0.5
        part = sample(scene.pool, index[:, 0], s + shift * step_s, t + shift * step_t, footprint)
        colour = part if colour is None else colour + part
    assert colour is not None
    colour = colour / taps * about[:, 4:7] + about[:, 7:10]
    columns, rows = about[:, 10], about[:, 11]
    lx = (_linear(f[:, 3], x, y) * z).clamp_min_(0).minimum(columns)
    ly = (_linear(f[:, 4], x, y) * z).clamp_min_(0).minimum(rows)
    x0, y0 = lx.floor().minimum((columns - 1).clamp_min(0)), ly.floor().minimum((rows - 1).clamp_min(0))
    wx, wy = (lx - x0)[:, None], (ly - y0)[:, None]
    corner = index[:, 1] + (y0 * (columns + 1) + x0).long()
    right = (columns >= 1).long()
    below = torch.where(rows >= 1, columns + 1, 0.0).long()
    lights = tables["light"]
    upper = lights[corner] * (1 - wx) + lights[corner + right] * wx
    lower = lights[corner + below] * (1 - wx) + lights[corner + below + right] * wx
    return (colour * (upper * (1 - wy) + lower * wy)).clamp_(0, 1)


def _cameras(poses_wc: object, intrinsics: object) -> tuple[Array, Array]:
    def to_numpy(value: object) -> Array:
        if isinstance(value, Tensor):
            value = value.detach().cpu().numpy()
        return np.asarray(value, np.float64)

    poses, k = to_numpy(poses_wc), to_numpy(intrinsics)
    if poses.ndim != 2 or poses.shape[1] != 7 or not np.isfinite(poses).all():
        raise DvoError(f"expected finite poses of shape (N, 7), got {poses.shape}", field="poses_wc")
    if k.shape not in ((4,), (len(poses), 4)):
        raise DvoError(f"expected shape (4,) or ({len(poses)}, 4), got {k.shape}", field="intrinsics")
    if not np.isfinite(k).all() or (k[..., :2] <= 0).any():
        raise DvoError("focal lengths must be positive and all numbers finite", field="intrinsics")
    return poses, np.broadcast_to(k, (len(poses), 4))


def render_depth(
    scene: Scene, poses_wc: object, intrinsics: object, height: int, width: int, *, device: torch.device | str = "cpu"
) -> tuple[Tensor, Tensor]:
    """Depth ``(N, H, W)`` and surface ``(N, H, W)`` alone: what planning of paths needs, at a fraction of the cost."""
    poses, k = _cameras(poses_wc, intrinsics)
    nearest, surface = _cast(_project(scene, poses, k), height, width, device)
    return torch.where(surface >= 0, 1 / nearest, 0.0), surface


def _colours(scene: Scene, view: _View, surface: Tensor, taps: int) -> Tensor:
    """Images ``(N, 3, H, W)`` of a cast grid."""
    n, height, width = surface.shape
    device = surface.device
    flat = surface.reshape(-1)
    at = torch.arange(flat.numel(), device=device)
    missed = flat < 0
    x, y = (at % width).float(), (at // width % height).float()
    colour = _shade(scene, view, at // (height * width), x, y, flat.clamp_min(0), taps)
    colour.masked_fill_(missed[:, None], 0.0)
    return colour.view(n, height, width, 3).permute(0, 3, 1, 2).contiguous()


def render(
    scene: Scene,
    poses_wc: object,
    intrinsics: object,
    height: int,
    width: int,
    *,
    supersample: int = 1,
    device: torch.device | str = "cpu",
    taps: int = 2,
) -> Rendering:
    """Render N frames.

    Args:
        scene: what to render.
        poses_wc: ``(N, 7)`` camera to world, tensor or array.
        intrinsics: ``(N, 4)`` or ``(4,)`` fx fy cx cy in pixels of the ``height`` x ``width`` image.
        height, width: image size in pixels.
        supersample: rays per pixel edge for the colours (depth, surface and uv are always those of pixel centres).
        device: where to render.
        taps: texture samples along the longer axis of a pixel's footprint (anisotropic filter).

    Raises:
        DvoError: poses or intrinsics of the wrong shape or not finite.
    """
    poses, k = _cameras(poses_wc, intrinsics)
    view = _project(scene, poses, k)
    nearest, surface = _cast(view, height, width, device)
    hit = surface >= 0
    depth = torch.where(hit, 1 / nearest, 0.0)
    if supersample == 1:
        images = _colours(scene, view, surface, taps)
    else:
        m = supersample
        fine = k * [m, m, m, m] + [0, 0, 0.5 * m - 0.5, 0.5 * m - 0.5]
        fine_view = _project(scene, poses, fine)
        _, fine_surface = _cast(fine_view, height * m, width * m, device)
        images = torch.nn.functional.avg_pool2d(_colours(scene, fine_view, fine_surface, taps), m)
    n = len(poses)
    uv = torch.from_numpy(np.stack([view.u, view.v], 2).astype(np.float32).reshape(-1, 6)).to(device)
    frame = torch.arange(n, device=device)[:, None, None] * len(scene)
    chosen = uv[(frame + surface.clamp_min(0)).reshape(-1)].view(n, height, width, 2, 3)
    xs = torch.arange(width, dtype=torch.float32, device=device)[None, None, :, None]
    ys = torch.arange(height, dtype=torch.float32, device=device)[None, :, None, None]
    coordinates = _linear(chosen, xs, ys) * depth[..., None]
    return Rendering(images, depth, surface, coordinates)


def trace(scene: Scene, poses_wc: object, intrinsics: object, pixels: Array) -> tuple[Array, Array, Array]:
    """What single rays hit, in float64: the reference for tests and for tracks.

    Args:
        scene: what to look at.
        poses_wc: ``(N, 7)``; intrinsics: ``(N, 4)`` or ``(4,)``.
        pixels: ``(N, M, 2)`` x, y (need not be integers).

    Returns:
        depth ``(N, M)``, surface ``(N, M)`` (-1 for none), uv ``(N, M, 2)``.
    """
    poses, k = _cameras(poses_wc, intrinsics)
    view = _project(scene, poses, k)
    homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], -1)
    inverse = np.einsum("npk,nmk->nmp", view.inverse_depth, homogeneous)
    inside = np.einsum("npek,nmk->nmpe", view.edges, homogeneous).min(-1) >= -SLACK
    inverse = np.where(inside & view.seen[:, None] & (inverse > 0), inverse, 0)
    surface = inverse.argmax(-1)
    best = np.take_along_axis(inverse, surface[..., None], -1)[..., 0]
    depth = np.divide(1, best, out=np.zeros_like(best), where=best > 0)
    frame = np.arange(len(poses))[:, None]
    uv = np.stack([(f[frame, surface] * homogeneous).sum(-1) * depth for f in (view.u, view.v)], -1)
    return depth, np.where(best > 0, surface, -1), uv
