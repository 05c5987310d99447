"""Small bundle adjustment problems with a known solution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import pytest
import torch
from torch import Tensor

from dvo.ba.layer.layer import BAOptions, BAResult, bundle_adjust
from dvo.geometry import se3
from dvo.geometry.projection import reproject


@dataclass(frozen=True)
class Problem:
    """A patch graph; ``true_poses`` and ``true_patches`` fit the targets exactly if these have no noise."""

    poses: Tensor
    patches: Tensor
    intrinsics: Tensor
    targets: Tensor
    weights: Tensor
    ii: Tensor
    jj: Tensor
    kk: Tensor
    true_poses: Tensor
    true_patches: Tensor

    def arguments(self) -> tuple[Tensor, ...]:
        """Those of ``bundle_adjust``."""
        names = ("poses", "patches", "intrinsics", "targets", "weights", "ii", "jj", "kk")
        return tuple(getattr(self, name) for name in names)

    def adjust(self, factors: tuple = (), plan: object = None, **options: object) -> BAResult:
        return bundle_adjust(*self.arguments(), BAOptions(**options), factors=factors, plan=plan)  # type: ignore[arg-type]

    def solve(self, **options: object) -> tuple[Tensor, Tensor]:
        """New poses and patches."""
        result = self.adjust(**options)  # type: ignore[arg-type]
        return result.poses_cw, result.patches

    def edges(self, which: Tensor) -> Problem:
        """The same with some edges, or with edges in another order."""
        return replace(self, targets=self.targets[:, which], weights=self.weights[:, which], ii=self.ii[which],
                       jj=self.jj[which], kk=self.kk[which])  # fmt: skip

    def shifted(self, pixels: float) -> Problem:
        """The same in images whose origin is elsewhere."""
        move = torch.zeros(3, 1, 1, dtype=self.patches.dtype)
        move[:2] = pixels
        intrinsics = torch.cat((self.intrinsics[..., :2], self.intrinsics[..., 2:] + pixels), -1)
        return replace(self, patches=self.patches + move, true_patches=self.true_patches + move, intrinsics=intrinsics,
                       targets=self.targets + pixels)  # fmt: skip

    def leaves(self) -> Problem:
        """Copies that gather gradients."""
        floats = ("poses", "patches", "intrinsics", "targets", "weights")
        return replace(self, **{name: getattr(self, name).detach().clone().requires_grad_() for name in floats})

    def element(self, b: int) -> Problem:
        """A batch of one."""
        cut = {f.name: getattr(self, f.name)[b : b + 1] for f in fields(self) if f.name not in ("ii", "jj", "kk")}
        return replace(self, **cut)


def make(
    batch: int = 2,
    frames: int = 4,
    per_frame: int = 6,
    noise: float = 0.0,
    disturbance: float = 0.02,
    depth_error: float = 0.3,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> Problem:
    """Random points seen from frames along a curve in 40x30 feature maps; every patch in every other frame."""
    generator = torch.Generator().manual_seed(seed)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, dtype=torch.float64, generator=generator)

    path = torch.tensor([0.08, 0.02, 0.03, 0.005, 0.01, 0.0], dtype=torch.float64)
    poses = se3.exp(torch.arange(frames, dtype=torch.float64)[:, None] * path + 0.03 * randn(batch, frames, 6))
    count = frames * per_frame
    centres = 2 + rand(batch, count, 2) * torch.tensor([36.0, 26.0], dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(torch.arange(3) - 1, torch.arange(3) - 1, indexing="xy"))
    inverse_depth = (0.3 + rand(batch, count, 1, 1, 1)).expand(-1, -1, 1, 3, 3)
    patches = torch.cat((centres[..., None, None] + grid, inverse_depth), 2)
    intrinsics = torch.tensor([30.0, 32, 20, 15], dtype=torch.float64) + rand(batch, frames, 4)
    kk = torch.arange(count).repeat_interleave(frames)
    ii, jj = kk // per_frame, torch.arange(frames).repeat(count)
    other = ii != jj
    ii, jj, kk = ii[other], jj[other], kk[other]
    targets = reproject(poses, patches, intrinsics, ii, jj, kk).coords[:, :, 1, 1]
    start = se3.retract(poses, disturbance * randn(batch, frames, 6))
    start = torch.cat((poses[:, :1], start[:, 1:]), 1)
    wrong = torch.cat((patches[:, :, :2], inverse_depth * (1 + depth_error * (2 * rand(batch, count, 1, 1, 1) - 1))), 2)
    floats = (start, wrong, intrinsics, targets + noise * randn(*targets.shape), 0.2 + rand(*targets.shape))
    return Problem(*(x.to(dtype) for x in floats), ii, jj, kk, poses.to(dtype), patches.to(dtype))


@pytest.fixture(scope="session")
def problem() -> Callable[..., Problem]:
    return make
