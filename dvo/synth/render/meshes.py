"""Rendering of meshes: depth, colours and single rays, from the visible triangle of each pixel."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dvo.geometry.poses import split
from dvo.synth.meshes.mesh import MeshScene
from dvo.synth.render.quality import Quality
from dvo.synth.render.raster import NEAR, Cover, rasterise

Array = np.ndarray
PIECE = 20_000  # pixels shaded at once on a CPU
SKY = ((0.86, 0.9, 0.94), (0.42, 0.6, 0.86), (0.45, 0.44, 0.42))  # horizon, zenith, below
FAR = 20.0  # scales; depth of the background for path planning


def _covers(
    scene: MeshScene, poses_wc: Array, intrinsics: Array, height: int, width: int, device: torch.device | str
) -> list[Cover]:
    corners = scene.tensors(device)["corners"]
    rotation, centre = (torch.from_numpy(part).to(device) for part in split(poses_wc))
    k = torch.tensor(intrinsics, device=device)
    near = NEAR * scene.scale
    return [rasterise(corners, rotation[n], centre[n], k[n], height, width, near=near) for n in range(len(poses_wc))]


def mesh_depth(
    scene: MeshScene, poses_wc: Array, intrinsics: Array, height: int, width: int, device: torch.device | str
) -> tuple[Tensor, Tensor]:
    """Depth and triangles; the background counts as ``FAR`` scales away.

    Args:
        scene: the mesh.
        poses_wc: ``(N, 7)`` float64.
        intrinsics: ``(N, 4)`` float64 pixels.
        height, width: image size, pixels.
        device: where to render.

    Returns:
        Depth ``(N, H, W)`` float32 and triangle ``(N, H, W)``, -1 for none.
    """
    covers = _covers(scene, poses_wc, intrinsics, height, width, device)
    depth = [torch.where(c.triangle >= 0, 1 / c.inverse_depth, FAR * scene.scale).float() for c in covers]
    return torch.stack(depth), torch.stack([_named(c) for c in covers])


def _named(cover: Cover) -> Tensor:
    names = torch.cat([cover.index, cover.index.new_tensor([-1])])
    return names[cover.triangle]


def _weights(cover: Cover, at: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Functions ``(M, 3, 3)``, 1/Z ``(M,)`` and barycentric weights ``(M, 3)`` of pixels with triangles ``at (M,)``."""
    functions = cover.functions[at]
    share = functions[..., 0] * x[:, None] + functions[..., 1] * y[:, None] + functions[..., 2]
    inverse = share.sum(1)
    return functions, inverse, share / inverse[:, None]


def _colours(scene: MeshScene, cover: Cover, rotation: Tensor, k: Tensor, taps: int) -> Tensor:
    """Image ``(3, H, W)`` of a cast grid: texture times tint, and a pale sky as background."""
    height, width = cover.triangle.shape
    device = cover.triangle.device
    image = torch.empty(height * width, 3, device=device)
    flat = cover.triangle.view(-1)
    piece = PIECE if device.type == "cpu" else len(flat)
    for begin in range(0, len(flat), piece):
        part = flat[begin : begin + piece]
        pixel = torch.arange(begin, begin + len(part), device=device)
        x, y = (pixel % width).double(), (pixel // width).double()
        if bool((part < 0).any()):
            image[begin : begin + piece] = _sky(rotation, k, x, y)
            shown = (part >= 0).nonzero()[:, 0]
            image[begin + shown] = _shade(scene, cover, part[shown], x[shown], y[shown], taps)
        else:
            image[begin : begin + piece] = _shade(scene, cover, part, x, y, taps)
    return image.t().reshape(3, height, width)


def _shade(scene: MeshScene, cover: Cover, at: Tensor, x: Tensor, y: Tensor, taps: int) -> Tensor:
    """Colour ``(M, 3)`` of pixels (x, y) with triangles ``at (M,)``."""
    tables = scene.tensors(at.device)
    functions, inverse, share = _weights(cover, at, x, y)
    triangle = cover.index[at]
    tint = tables["tint"][triangle]
    colour = (share[..., None].float() * tint).sum(1)
    picture = tables["texture"][triangle]
    textured = (picture >= 0).nonzero()[:, 0]
    if len(textured):
        everywhere = len(textured) == len(at)
        if not everywhere:
            functions, inverse, share = functions[textured], inverse[textured], share[textured]
            triangle, picture = triangle[textured], picture[textured]
        uv = tables["uv"][triangle]  # (M, 3, 2)
        place = (share[..., None] * uv).sum(1)
        # Quotient rule: place = (sum b_i/Z uv_i) / (1/Z), both linear in the pixel.
        slope = [(functions[:, :, d, None] * uv).sum(1) for d in (0, 1)]
        whole = [functions[:, :, d].sum(1) for d in (0, 1)]
        jacobian = torch.stack([(slope[d] - place * whole[d][:, None]) / inverse[:, None] for d in (0, 1)], -1)
        texel = scene.textures.sample(picture, place, jacobian, taps)
        if everywhere:
            colour = colour * texel
        else:
            colour[textured] *= texel
    return colour.clamp_(0, 1)


def _sky(rotation: Tensor, k: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """``(M, 3)`` gradient by the elevation of the ray alone, fixed in the world."""
    across, down = (x - k[2]) / k[0], (y - k[3]) / k[1]
    rise = rotation[2, 0] * across + rotation[2, 1] * down + rotation[2, 2]
    rise = (rise / (across**2 + down**2 + 1).sqrt()).float()[:, None]
    pale, blue, earth = (rise.new_tensor(colour) for colour in SKY)
    return torch.where(
        rise > 0, torch.lerp(pale, blue, rise.clamp(0, 1)), torch.lerp(pale, earth, (-3 * rise).clamp(0, 1))
    )


def render_mesh(
    scene: MeshScene, poses_wc: Array, intrinsics: Array, height: int, width: int, *, quality: Quality,
    device: torch.device | str, coordinates: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Fields of a ``Rendering``: images, depth, triangle, barycentric weights of corners 1 and 2.

    Args:
        scene: the mesh.
        poses_wc: ``(N, 7)`` float64.
        intrinsics: ``(N, 4)`` float64 pixels.
        height, width: image size, pixels.
        quality: sampling of the colours.
        device: where to render.
        coordinates: fill the weights too.

    Returns:
        Images ``(N, 3, H, W)``, depth and triangle ``(N, H, W)``, weights ``(N, H, W, 2)``.
    """
    covers = _covers(scene, poses_wc, intrinsics, height, width, device)
    depth = torch.stack([torch.where(c.triangle >= 0, 1 / c.inverse_depth, 0.0).float() for c in covers])
    surface = torch.stack([_named(c) for c in covers])
    m = quality.supersample
    fine = intrinsics * m + [0, 0, 0.5 * m - 0.5, 0.5 * m - 0.5]
    rotation = torch.from_numpy(split(poses_wc)[0]).to(device)
    images = []
    for n, cover in enumerate(covers):
        k = torch.from_numpy(fine[n]).to(device)
        if m > 1:
            cover = _covers(scene, poses_wc[n : n + 1], fine[n : n + 1], height * m, width * m, device)[0]
        image = _colours(scene, cover, rotation[n], k, max(1, quality.taps // m))
        images.append(torch.nn.functional.avg_pool2d(image, m) if m > 1 else image)
    uv = torch.zeros(len(covers), *((height, width) if coordinates else (0, 0)), 2, device=device)
    for n, cover in enumerate(covers if coordinates else []):
        rows, columns = (cover.triangle >= 0).nonzero(as_tuple=True)
        uv[n, rows, columns] = _weights(cover, cover.triangle[rows, columns], columns, rows)[2][:, 1:].float()
    return torch.stack(images), depth, surface, uv


def trace_mesh(scene: MeshScene, poses_wc: Array, intrinsics: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Triangles hit by single rays, in float64.

    Args:
        scene: the mesh.
        poses_wc: ``(N, 7)``.
        intrinsics: ``(N, 4)`` pixels.
        pixels: ``(N, M, 2)`` x, y.

    Returns:
        depth ``(N, M)``, triangle ``(N, M)`` (-1 for none), barycentric weights of corners 1 and 2 ``(N, M, 2)``.
    """
    n, m = pixels.shape[:2]
    depth, surface, uv = np.zeros((n, m)), np.full((n, m), -1), np.zeros((n, m, 2))
    rotation, centre = split(poses_wc)
    for i in range(n):
        fx, fy, cx, cy = intrinsics[i]
        ray = np.stack([(pixels[i, :, 0] - cx) / fx, (pixels[i, :, 1] - cy) / fy, np.ones(m)])
        step = max(1, 4_000_000 // max(m, 1))
        best = np.zeros(m)
        for a in range(0, len(scene), step):
            local = (scene.corners[a : a + step] - centre[i]) @ rotation[i]
            cross = np.cross(np.roll(local, -1, 1), np.roll(local, -2, 1))
            det = (local[:, 0] * cross[:, 0]).sum(-1)
            thick = np.flatnonzero(np.abs(det) > 1e-14 * np.linalg.norm(local, axis=-1).prod(1))
            share = [(cross[thick, c] / det[thick, None]) @ ray for c in range(3)]
            inverse = share[0] + share[1] + share[2]
            inverse[(share[0] < 0) | (share[1] < 0) | (share[2] < 0) | (inverse > 1 / (NEAR * scene.scale))] = 0
            if not len(thick):
                continue
            first = inverse.argmax(0)
            value = inverse[first, np.arange(m)]
            nearer = np.flatnonzero(value > best)
            best[nearer] = value[nearer]
            surface[i, nearer] = a + thick[first[nearer]]
            for c in (0, 1):
                uv[i, nearer, c] = share[c + 1][first[nearer], nearer] / value[nearer]
        depth[i] = np.divide(1, best, out=np.zeros(m), where=best > 0)
    return depth, surface, uv
