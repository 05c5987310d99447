"""A bundle adjustment problem like that of a tracker's window."""

from __future__ import annotations

import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.geometry.projection import reproject

FRAMES, PATCHES = 6, 8


def window_problem(seed: int = 0, frames: int = FRAMES, per_frame: int = PATCHES) -> tuple[Tensor, ...]:
    """Poses, patches, intrinsics, targets, weights, ii, jj, kk: every patch with an edge into every frame.

    Targets are exact but for noise; poses and depths are not. One edge has no weight, and one a wrong target.
    """
    g = torch.Generator().manual_seed(seed)
    count = frames * per_frame
    true = se3.exp(0.05 * torch.arange(frames)[:, None] * (torch.randn(6, generator=g) + torch.tensor([1.0] + [0] * 5)))
    place = torch.rand(1, count, 2, 1, 1, generator=g) * torch.tensor([70.0, 50.0])[:, None, None] + 5
    depth = 0.3 + torch.rand(1, count, 1, 1, 1, generator=g)
    patches = torch.cat([place, depth], 2)
    intrinsics = torch.tensor([60.0, 62.0, 40.0, 30.0]).expand(1, frames, 4).contiguous()
    kk = torch.arange(count).repeat_interleave(frames)
    jj, ii = torch.arange(frames).repeat(count), kk // per_frame
    there = reproject(true[None], patches, intrinsics, ii, jj, kk).coords[:, :, 0, 0]
    targets = there + 0.2 * torch.randn(there.shape, generator=g)
    weights = torch.rand(there.shape, generator=g)
    weights[:, 3], targets[:, 5, 0] = 0.0, 500.0
    start = se3.retract(true, 0.01 * torch.randn(frames, 6, generator=g))
    start[0] = true[0]
    patches[:, :, 2] *= 1 + 0.1 * torch.randn(1, count, 1, 1, generator=g)
    return start[None], patches, intrinsics, targets, weights, ii, jj, kk
