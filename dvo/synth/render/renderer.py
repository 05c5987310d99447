"""Renderer of flat surfaces, rasterised exactly, textured and lit, in plain torch.

In the camera of frame n a plane has an inverse depth that is linear in the pixel, and so are u / Z and v / Z of its
surface coordinates and Z-scaled distances to its edges. So per frame and surface there are a few 3-vectors (computed in
float64), a pixel (x, y, 1) is covered where all edge functions are positive, and the surface of largest inverse depth
wins. Depth, identity and surface coordinates are exact; nothing is interpolated over pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dvo.core.context import use_threads
from dvo.core.errors import DvoError
from dvo.synth.meshes.mesh import MeshScene
from dvo.synth.render.antialias import smooth_outlines
from dvo.synth.render.meshes import mesh_depth, render_mesh, trace_mesh
from dvo.synth.render.quality import STANDARD, Quality
from dvo.synth.render.shading import coordinates_of, functions_of, shade
from dvo.synth.render.view import SLACK, View, look, look_at_stage
from dvo.synth.scenes.bodies import Stage
from dvo.synth.scenes.scene import Scene

PIECE = 9600  # pixels shaded at once on a CPU
Array = np.ndarray


@dataclass
class Rendering:
    """Images of N cameras with ground truth.

    Attributes:
        images: ``(N, 3, H, W)`` float32 RGB in [0, 1].
        depth: ``(N, H, W)`` float32 Z along the optical axis, world units; 0 where no surface is hit.
        surface: ``(N, H, W)`` int64 index of the surface, -1 where none is hit.
        uv: ``(N, H, W, 2)`` float32 coordinates in the surface, world units (see :class:`dvo.synth.Scene`).
    """

    images: Tensor
    depth: Tensor
    surface: Tensor
    uv: Tensor


def cast(view: View, height: int, width: int, device: torch.device | str) -> tuple[Tensor, Tensor, Tensor]:
    """Visible surface at every pixel centre.

    Args:
        view: the surfaces as N cameras see them.
        height, width: image size, pixels.
        device: where to compute.

    Returns:
        Largest inverse depth ``(N, H, W)``; the position in ``view.index`` of its surface, int32, -1 for none; the
        functions ``(N, Q, 5, 3)`` that decided it: inverse depth and edges.
    """
    n = len(view.seen)
    slack = 0.02  # pixels; the windows are exact but for rounding and SLACK
    x0, y0 = (np.clip(np.ceil(view.window[..., i] - slack), 0, m).astype(int) for i, m in ((0, width), (1, height)))
    x1, y1 = (
        np.clip(np.floor(view.window[..., i] + slack) + 1, 0, m).astype(int) for i, m in ((2, width), (3, height))
    )
    seen = view.seen & (x1 > x0) & (y1 > y0)
    functions = np.concatenate([view.basis[:, :, 2:], view.edges], 2)  # (N, Q, 5, 3)
    functions[~seen] = [0.0, 0.0, -1.0]  # hidden from this camera, but seen by another one of the batch
    table = torch.from_numpy(functions.astype(np.float32)).to(device)
    nearest = torch.full((n, height, width), 1e-12, device=device)
    surface = torch.full((n, height, width), -1, dtype=torch.int32, device=device)
    xs = torch.arange(width, dtype=torch.float32, device=device)
    ys = torch.arange(height, dtype=torch.float32, device=device)
    big = np.iinfo(np.int64).max
    left, top = np.where(seen, x0, big).min(0), np.where(seen, y0, big).min(0)
    right, bottom = np.where(seen, x1, 0).max(0), np.where(seen, y1, 0).max(0)
    for q in np.flatnonzero(seen.any(0)).tolist():
        a, b, c, d = int(left[q]), int(right[q]), int(top[q]), int(bottom[q])
        which = np.flatnonzero(seen[:, q])
        n0, n1 = int(which[0]), int(which[-1]) + 1
        rows = table[n0:n1, q]
        value = (
            torch.addcmul(rows[..., 2:], rows[..., 1:2], ys[c:d])[..., None] + (rows[..., :1] * xs[a:b])[..., None, :]
        )
        inverse, best = value[:, 0], nearest[n0:n1, c:d, a:b]
        hit = (value[:, 1:].amin(1) >= -SLACK) & (inverse > best)
        best.copy_(torch.where(hit, inverse, best))
        surface[n0:n1, c:d, a:b].masked_fill_(hit, q)
    return nearest, surface, table


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


def view_scene(
    scene: Scene | Stage, poses_wc: Array, intrinsics: Array, size: tuple[int, int] | None, times: object = None
) -> tuple[Scene, View]:
    """Surfaces in view of cameras, and the scene whose textures and light belong to them.

    Args:
        scene: static, or with moving bodies.
        poses_wc: ``(N, 7)`` camera to world.
        intrinsics: ``(N, 4)`` pixels.
        size: height and width of the image, which culls; None culls only what faces away.
        times: ``(N,)`` seconds, for the poses of moving bodies.

    Returns:
        The scene of all surfaces, and the view.

    Raises:
        DvoError: moving bodies and no time for every camera.
    """
    use_threads()
    if not isinstance(scene, Stage):
        return scene, look(scene, poses_wc, intrinsics, size)
    when = np.asarray(times, np.float64) if times is not None else np.zeros(0)
    if when.shape != (len(poses_wc),):
        raise DvoError("a scene with moving bodies needs a time for every pose", field="times")
    return scene.surfaces, look_at_stage(scene, poses_wc, intrinsics, size, when)


def render_depth(
    scene: Scene | Stage | MeshScene, poses_wc: object, intrinsics: object, height: int, width: int, *,
    device: torch.device | str = "cpu", times: object = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Depth and surfaces alone, as path planning needs them, at a fraction of the cost.

    Args:
        scene, poses_wc, intrinsics, height, width, device, times: as for :func:`render`.

    Returns:
        Depth ``(N, H, W)`` and surface ``(N, H, W)``.

    Raises:
        DvoError: as :func:`render`.
    """
    poses, k = _cameras(poses_wc, intrinsics)
    if isinstance(scene, MeshScene):
        return mesh_depth(scene, poses, k, height, width, device)
    _, view = view_scene(scene, poses, k, (height, width), times)
    nearest, local, _ = cast(view, height, width, device)
    return torch.where(local >= 0, 1 / nearest, 0.0), named(view, local)


def named(view: View, local: Tensor) -> Tensor:
    """Surfaces of the scene from positions in ``view.index``.

    Args:
        view: of the cameras.
        local: any shape, int; -1 stays.

    Returns:
        int64, same shape.
    """
    names = torch.from_numpy(np.append(view.index, -1).astype(np.int64)).to(local.device)
    return names[local.long()]


def _colours(scene: Scene, view: View, local: Tensor, taps: int) -> Tensor:
    """Images ``(N, 3, H, W)`` of a cast grid, in pieces that stay in the processor's cache."""
    n, height, width = local.shape
    device = local.device
    images = torch.empty(n, 3, height * width, device=device)
    functions = functions_of(scene, view, device)
    x = torch.arange(width, dtype=torch.float32, device=device).expand(height, width).reshape(-1)
    y = torch.arange(height, dtype=torch.float32, device=device)[:, None].expand(height, width).reshape(-1)
    names = torch.from_numpy(view.index).to(device)
    piece = height * width if torch.device(device).type != "cpu" else PIECE
    for frame in range(n):
        flat = local[frame].reshape(-1).long()
        hit = flat >= 0
        flat.clamp_min_(0)
        for a in range(0, flat.numel(), piece):
            part = slice(a, a + piece)
            row = flat[part] + frame * len(view.index)
            images[frame, :, part] = shade(scene, functions, row, names[flat[part]], x[part], y[part], taps)
        if not hit.all():
            images[frame].masked_fill_(~hit, 0.0)
    return images.view(n, 3, height, width)


def render(
    scene: Scene | Stage | MeshScene, poses_wc: object, intrinsics: object, height: int, width: int, *,
    quality: Quality = STANDARD, device: torch.device | str = "cpu", coordinates: bool = True, times: object = None,
) -> Rendering:  # fmt: skip
    """Render N frames.

    Args:
        scene: a static scene, a :class:`Stage` with moving bodies, or a mesh (``surface`` is then the triangle and
            ``uv`` the barycentric weights of its second and third corner).
        poses_wc: ``(N, 7)`` camera to world, tensor or array.
        intrinsics: ``(N, 4)`` or ``(4,)`` fx fy cx cy in pixels of the ``height`` x ``width`` image.
        height, width: image size, pixels.
        quality: rays and texture samples per pixel; depth, surface and uv do not depend on it.
        device: where to render.
        coordinates: fill ``uv`` too; without, it is empty ``(N, 0, 0, 2)``.
        times: ``(N,)`` seconds, for the poses of moving bodies.

    Returns:
        Images, depth, surfaces and texture coordinates.

    Raises:
        DvoError: poses or intrinsics of the wrong shape or not finite, or bodies without times.

    Example:
        >>> scene = random_scene(0, "room")
        >>> pose_wc = random_path(scene, 0).poses_wc([0.0])
        >>> rendering = render(scene, pose_wc, [160.0, 160.0, 79.5, 59.5], 120, 160)
        >>> rendering.images.shape, rendering.depth.shape
        (torch.Size([1, 3, 120, 160]), torch.Size([1, 120, 160]))
    """
    poses, k = _cameras(poses_wc, intrinsics)
    if isinstance(scene, MeshScene):
        rays = max(quality.supersample, 2 if quality.antialias else 1)
        fine = replace(quality, supersample=rays)
        parts = render_mesh(scene, poses, k, height, width, quality=fine, device=device, coordinates=coordinates)
        return Rendering(*parts)
    painted, view = view_scene(scene, poses, k, (height, width), times)
    nearest, local, functions = cast(view, height, width, device)
    depth = torch.where(local >= 0, 1 / nearest, 0.0)
    if quality.supersample == 1:
        images = _colours(painted, view, local, quality.taps)
        if quality.antialias:
            smooth_outlines(images, local, functions, SLACK)
    else:
        m = quality.supersample
        fine_k = k * [m, m, m, m] + [0, 0, 0.5 * m - 0.5, 0.5 * m - 0.5]
        _, fine_view = view_scene(scene, poses, fine_k, (height * m, width * m), times)
        _, fine_local, _ = cast(fine_view, height * m, width * m, device)
        images = torch.nn.functional.avg_pool2d(_colours(painted, fine_view, fine_local, quality.taps), m)
    uv = coordinates_of(view, local, depth) if coordinates else torch.zeros(len(poses), 0, 0, 2, device=device)
    return Rendering(images, depth, named(view, local), uv)


def trace(
    scene: Scene | Stage | MeshScene, poses_wc: object, intrinsics: object, pixels: Array, times: object = None,
    size: tuple[int, int] | None = None,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Surfaces hit by single rays, in float64: the reference for tests and for tracks.

    Args:
        scene: static, with moving bodies, or a mesh.
        poses_wc: ``(N, 7)`` camera to world.
        intrinsics: ``(N, 4)`` or ``(4,)``.
        pixels: ``(N, M, 2)`` x, y (need not be integers nor inside an image).
        times: ``(N,)`` seconds, for the poses of moving bodies.
        size: height and width of images in which all pixels lie; saves work on surfaces out of view.

    Returns:
        depth ``(N, M)`` (0 for none), surface ``(N, M)`` (-1 for none), uv ``(N, M, 2)``.

    Raises:
        DvoError: as :func:`render`.
    """
    poses, k = _cameras(poses_wc, intrinsics)
    if isinstance(scene, MeshScene):
        return trace_mesh(scene, poses, k, pixels)
    _, view = view_scene(scene, poses, k, size, times)
    homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], -1).swapaxes(1, 2)  # (N, 3, M)
    if not len(view.index):
        nothing = np.zeros(pixels.shape[:2])
        return nothing, np.full(nothing.shape, -1), np.zeros(pixels.shape)
    inverse = view.basis[:, :, 2] @ homogeneous  # (N, Q, M)
    inside = (view.edges @ homogeneous[:, None]).min(2) >= -SLACK
    inverse = np.where(inside & view.seen[..., None] & (inverse > 0), inverse, 0)
    chosen = inverse.argmax(1)
    best = inverse.max(1)
    depth = np.divide(1, best, out=np.zeros_like(best), where=best > 0)
    rows = view.basis[np.arange(len(poses))[:, None], chosen, :2]  # (N, M, 2, 3)
    uv = (rows @ homogeneous.swapaxes(1, 2)[..., None])[..., 0] * depth[..., None]
    return depth, np.where(best > 0, view.index[chosen], -1), uv
