"""Motion in the window: prediction of the next pose, and how much frames differ."""

from __future__ import annotations

import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.graph.window import Window


def predict_pose(poses_cw: Tensor, times: list[float], time: float, damping: float) -> Tensor:
    """Damped constant velocity: ``Exp(damping * dt / dt_last * Log(P1 P2^-1)) P1`` (DPVO's motion model).

    Args:
        poses_cw: ``(n, 7)`` of the window; with none the pose is the identity, with one it is repeated.
        times: their seconds.
        time: seconds of the new frame.
    """
    if len(times) == 0:
        return se3.identity(device=poses_cw.device)
    if len(times) == 1:
        return poses_cw[-1]
    # A dropped keyframe or a gap in the video must not throw the guess far away.
    ratio = min(2.0, max(0.0, (time - times[-1]) / (times[-1] - times[-2])))
    step = se3.log(se3.relative(poses_cw[-2], poses_cw[-1]))
    return se3.retract(poses_cw[-1], damping * ratio * step)


def _displacement(window: Window, i: int, j: int, rotation: bool) -> tuple[Tensor, Tensor]:
    """Where the patches of frame ``i`` go in frame ``j``, and where rotation (or translation) alone takes them."""
    m = window.per_frame
    device = window.patches.device
    patches = window.patches[None, i * m : (i + 1) * m]
    motion = se3.relative(window.poses_cw[i], window.poses_cw[j])
    part = motion.clone()
    if rotation:
        part[:3] = 0
    else:
        part[3:] = torch.tensor([0.0, 0, 0, 1], device=device)
    poses = torch.stack([se3.identity(device=device), motion, part])[None]
    intrinsics = window.intrinsics[[i, j, j]][None]
    kk = torch.arange(m, device=device)
    c = patches.shape[-1] // 2
    targets = torch.tensor([1, 2], device=device).repeat_interleave(m)
    there = reproject(poses, patches, intrinsics, torch.zeros_like(targets), targets, kk.repeat(2)).coords
    whole, only = there[0, :, c, c].split(m)
    return whole, only


def parallax(window: Window, i: int, j: int) -> float:
    """Median displacement, in feature pixels, that translation adds to the patches of frame ``i`` seen in ``j``."""
    whole, only = _displacement(window, i, j, rotation=True)
    return float((whole - only).norm(dim=-1).median())


def flow_magnitude(window: Window, i: int, j: int) -> float:
    """Mean flow of the patches of frame ``i`` seen in ``j``, half of it taken without the rotation (DPVO's
    ``flow_mag`` with beta 0.5), feature pixels."""
    whole, only = _displacement(window, i, j, rotation=False)
    m = window.per_frame
    c = window.patches.shape[-1] // 2
    start = window.patches[i * m : (i + 1) * m, :2, c, c]
    moved = 0.5 * (whole - start).norm(dim=-1) + 0.5 * (only - start).norm(dim=-1)
    return float(moved.clamp(max=1e3).mean())
