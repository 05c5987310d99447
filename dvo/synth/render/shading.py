"""Shading of visible surfaces: texture, light and surface coordinates from linear functions of the pixel."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dvo.synth.render.view import View
from dvo.synth.scenes.scene import CELL, Scene
from dvo.synth.textures.texture import sample


def _linear(rows: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Evaluate functions ``(3, M)`` at pixels ``(M,)``."""
    return torch.addcmul(torch.addcmul(rows[2], rows[0], x), rows[1], y)


def functions_of(scene: Scene, view: View, device: torch.device | str) -> Tensor:
    """Linear functions for shading.

    Args:
        scene: supplies textures and light.
        view: the surfaces as N cameras see them.
        device: where to compute.

    Returns:
        Coefficients ``(N Q, 15)`` of 1/Z, s/Z, t/Z and of the light-map coordinates over Z.
    """
    texture = scene.texture_map[view.index] @ view.basis
    light = scene.light_map[view.index] @ view.basis
    packed = np.concatenate([view.basis[:, :, 2:], texture, light], 2).astype(np.float32)
    return torch.from_numpy(packed.reshape(-1, 15)).to(device)


def shade(scene: Scene, functions: Tensor, row: Tensor, surface: Tensor, x: Tensor, y: Tensor, taps: int) -> Tensor:
    """Colours of single pixels.

    Args:
        scene: supplies textures and light.
        functions: from :func:`functions_of`.
        row: ``(M,)`` rows of the functions.
        surface: ``(M,)`` visible surfaces.
        x, y: ``(M,)`` pixels.
        taps: texture samples along the longer axis of a pixel's footprint.

    Returns:
        ``(3, M)`` in [0, 1].
    """
    tables = scene.tensors(surface.device)
    f = functions.index_select(0, row).t().contiguous().view(5, 3, -1)
    about = tables["surface"].index_select(1, surface)
    z = 1 / _linear(f[0], x, y)
    s, t = _linear(f[1], x, y) * z, _linear(f[2], x, y) * z
    # Jacobian of texel coordinates by pixel, from the quotient rule.
    sx, sy = torch.addcmul(f[1, 0], s, f[0, 0], value=-1) * z, torch.addcmul(f[1, 1], s, f[0, 1], value=-1) * z
    tx, ty = torch.addcmul(f[2, 0], t, f[0, 0], value=-1) * z, torch.addcmul(f[2, 1], t, f[0, 1], value=-1) * z
    along_x, along_y = torch.hypot(sx, tx), torch.hypot(sy, ty)
    major = torch.maximum(along_x, along_y)
    minor = (sx * ty - sy * tx).abs_() / major.clamp_min(1e-9)
    footprint = torch.maximum(minor, major / taps)
    wide = along_x >= along_y
    shift = ((torch.arange(taps, device=x.device) + 0.5) / taps - 0.5)[:, None]
    places_s, places_t = s + shift * torch.where(wide, sx, sy), t + shift * torch.where(wide, tx, ty)
    colour = sample(scene.pool, about[10], about[11], places_s, places_t, footprint)
    colour = torch.addcmul(about[7:10], colour, about[4:7])
    light = tables["light"]
    across, down = light.shape[3], light.shape[2]
    lx = (_linear(f[3], x, y) * z).clamp_(0, CELL - 1).add_(about[12]).mul_(2 / (across - 1)).sub_(1)
    ly = (_linear(f[4], x, y) * z).clamp_(0, CELL - 1).mul_(2 / (down - 1)).sub_(1)
    grid = torch.stack([lx, ly], -1).view(1, 1, -1, 2)
    shine = torch.nn.functional.grid_sample(light, grid, padding_mode="border", align_corners=True)
    return colour.mul_(shine.view(3, -1)).clamp_(0, 1)


def coordinates_of(view: View, local: Tensor, depth: Tensor) -> Tensor:
    """Surface coordinates of visible surfaces.

    Args:
        view: of the cameras.
        local: ``(N, H, W)`` positions in ``view.index``.
        depth: ``(N, H, W)``.

    Returns:
        ``(N, H, W, 2)`` world units.
    """
    n, height, width = local.shape
    device = local.device
    uv = torch.from_numpy(view.basis[:, :, :2].astype(np.float32).reshape(-1, 6)).to(device)
    frame = torch.arange(n, device=device)[:, None, None] * len(view.index)
    chosen = uv[(frame + local.clamp_min(0)).reshape(-1)].view(n, height, width, 2, 3)
    xs = torch.arange(width, dtype=torch.float32, device=device)[:, None]
    ys = torch.arange(height, dtype=torch.float32, device=device)[:, None, None]
    return (chosen[..., 0] * xs + chosen[..., 1] * ys + chosen[..., 2]) * depth[..., None]
