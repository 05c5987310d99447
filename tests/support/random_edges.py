"""Graphs with any edges, and what is computed of them with kernels and without."""

from __future__ import annotations

import pytest
import torch

from dvo.ba.kernels import Kernel
from dvo.ba.patch_problem import PatchProblem
from dvo.core.kernels import VARIABLE, available
from dvo.geometry import se3

KERNELS = [Kernel("none"), Kernel("huber", 0.5), Kernel("cauchy", 0.3)]


def graph(seed, frames, per_frame, edges, dtype=torch.float64):
    """Any edges, several times the same, into their own frame, behind the camera, without weight, or far off."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    patches = frames * per_frame
    poses = se3.exp(torch.cat([0.3 * normal(frames, 3), 0.1 * normal(frames, 3)], 1))
    poses[0, 2] -= 3.0  # nearer than the points: what it sees may lie behind it
    depth = 0.2 + torch.rand(patches, generator=g, dtype=torch.float64)
    xy = 40 + 12 * normal(patches, 2)
    cut = torch.cat([xy, depth[:, None]], 1)[:, :, None, None]
    kk = torch.randint(patches, (edges,), generator=g)
    jj = torch.randint(frames, (edges,), generator=g)
    targets = xy[kk] + 6 * normal(edges, 2)
    targets[torch.rand(edges, generator=g) < 0.05] = torch.nan
    weights = torch.rand(edges, 2, generator=g, dtype=torch.float64) * (torch.rand(edges, 1, generator=g) < 0.9)
    intrinsics = torch.tensor([[40.0, 42.0, 39.0, 41.0]], dtype=torch.float64).expand(frames, 4)
    values = [x.to(dtype) for x in (poses, cut, intrinsics, targets, weights)]
    return PatchProblem(*values, kk // per_frame, jj, kk)


def both(make):
    """What a function gives with kernels, and without."""
    found = []
    for choice in ("numba", "torch"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(VARIABLE, choice)
            assert available() == (choice == "numba")
            found.append(make())
    return found
