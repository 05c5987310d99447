"""Edges that are looked up in maps of 24 x 34 pixels, some of them at NaN or far outside."""

import torch


def edges(channels, side, spread, seed, count=40):
    generator = torch.Generator().manual_seed(seed)
    ticks = spread * (torch.arange(side) - side // 2)
    patch = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1)
    coords = torch.rand(count, 1, 1, 2, generator=generator) * torch.tensor([60.0, 50.0]) - 12 + patch
    coords[3, 0, 0, 1] = torch.nan
    coords[5, ..., 0] = 1e6
    features = torch.randn(7, side**2, channels, generator=generator).bfloat16().float()
    kk, frames = (torch.randint(most, (count,), generator=generator) for most in (7, 3))
    return coords, features, kk, frames
