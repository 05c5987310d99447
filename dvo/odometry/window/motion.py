"""Motion of the window: parallax and flow between frames."""

from __future__ import annotations

import torch
from torch import Tensor

from dvo.core.kernels import use_kernels
from dvo.geometry import se3
from dvo.geometry.bounds import MIN_Z_DIVISION
from dvo.geometry.projection import reproject
from dvo.map.window import Window

LONGEST = 1e3
"""Flow of a patch at most, in the mean flow of a frame pair, feature pixels."""


def _displacement(window: Window, i: int, j: int, rotation: bool) -> tuple[Tensor, Tensor]:
    """Patch centres of frame ``i`` reprojected into frame ``j``, and the same with a part of the motion alone.

    Args:
        window: keyframes.
        i, j: positions in the window.
        rotation: the part is the rotation (True) or the translation (False).

    Returns:
        ``(M, 2)`` positions under the whole motion and ``(M, 2)`` under the part, feature pixels.
    """
    m = window.per_frame
    device = window.patches.device
    patches = window.patches[None, i * m : (i + 1) * m]
    motion = se3.relative(window.poses_cw[i], window.poses_cw[j])
    part = motion.clone()
    if rotation:
        part[:3] = 0
    else:
        part[3:6], part[6] = 0, 1
    poses = torch.stack([se3.identity(device=device), motion, part])[None]
    intrinsics = torch.stack([window.frames[k].intrinsics for k in (i, j, j)])[None]
    kk = torch.arange(m, device=device)
    c = patches.shape[-1] // 2
    targets = torch.arange(1, 3, device=device).repeat_interleave(m)
    there = reproject(poses, patches, intrinsics, torch.zeros_like(targets), targets, kk.repeat(2)).coords
    whole, only = there[0, :, c, c].split(m)
    return whole, only


def parallax(window: Window, i: int, j: int, share: float = 0.5) -> float:
    """Parallax of a frame pair: displacement that translation adds to the rotational flow.

    Args:
        window: keyframes.
        i, j: positions of source and target frame in the window.
        share: of the patches that have as much.

    Returns:
        Feature pixels.
    """
    whole, only = _displacement(window, i, j, rotation=True)
    return float((whole - only).norm(dim=-1).quantile(1 - share))


def flow_magnitude(window: Window, i: int, j: int) -> float:
    """Mean flow of a frame pair, half of it without the rotation (``flow_mag`` of DPVO with beta 0.5).

    Args:
        window: keyframes.
        i, j: positions of source and target frame in the window.

    Returns:
        Feature pixels.
    """
    m = window.per_frame
    patches, of_i, of_j = window.patches[i * m : (i + 1) * m], window.frames[i].intrinsics, window.frames[j].intrinsics
    floats = window.poses_cw[i], window.poses_cw[j], of_i, of_j, patches
    if use_kernels(*floats) and len(patches):
        from dvo.odometry.window.window_kernels import mean_flow

        first, second, of_first, of_second, seen = (x.detach().contiguous().numpy() for x in floats)
        return mean_flow(first, second, of_first, of_second, seen, MIN_Z_DIVISION, LONGEST)
    whole, only = _displacement(window, i, j, rotation=False)
    c = window.patches.shape[-1] // 2
    start = patches[:, :2, c, c]
    moved = 0.5 * (whole - start).norm(dim=-1) + 0.5 * (only - start).norm(dim=-1)
    return float(moved.clamp(max=LONGEST).mean())
