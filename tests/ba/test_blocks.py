"""Further state blocks: unknowns that only factors from outside concern."""

from collections.abc import Mapping
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from dvo.ba.blocks import POSES, vector_block
from dvo.ba.layer import BADamping, BAOptions, bundle_adjust
from dvo.ba.problem import Factor, Linearisation
from dvo.geometry import se3, so3
from dvo.geometry.projection import reproject
from dvo.nets.patchifier import patch_coordinates

N, M = 5, 8


@dataclass(frozen=True)
class ConstantVelocity(Factor):
    """Residual ``(c_j - c_i) / dt - v`` of the camera centres of frames i and j = i + 1, and one velocity.

    Attributes:
        weight: ``(B, N - 1)``.
        dt: seconds between frames.
    """

    weight: Tensor
    dt: float

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        poses, velocity = values[POSES], values["velocity"]
        centres, turn = se3.inverse(poses)[..., :3], so3.matrix(poses[..., 3:]).mT
        i = torch.arange(poses.shape[1] - 1)
        residual = (centres[:, 1:] - centres[:, :-1]) / self.dt - velocity
        zero = torch.zeros_like(turn[:, 1:])
        # A left perturbation tau of a pose moves its centre by -R^T tau; J is minus the derivative of the residual.
        of_j, of_i = torch.cat([turn[:, 1:], zero], -1) / self.dt, torch.cat([-turn[:, :-1], zero], -1) / self.dt
        of_v = torch.eye(3, dtype=poses.dtype).expand(*residual.shape, 3)
        weight = self.weight[..., None].expand_as(residual)
        return Linearisation(
            residual, weight, (POSES, POSES, "velocity"), (i + 1, i, torch.zeros_like(i)), (of_j, of_i, of_v)
        )


def moving_camera():
    """A camera at constant velocity that turns, and noise-free measurements."""
    g = torch.Generator().manual_seed(2)
    turns = 0.05 * torch.randn(1, N, 3, generator=g, dtype=torch.float64)
    turns[:, 0] = 0
    rotation = so3.exp(turns)
    centres = torch.arange(N, dtype=torch.float64)[None, :, None] * torch.tensor([0.05, -0.02, 0.08]).double()
    poses = se3.inverse(torch.cat([centres, rotation], -1))
    depth = 0.4 + 0.4 * torch.rand(1, N * M, generator=g, dtype=torch.float64)
    patches = patch_coordinates(torch.randint(6, 34, (1, N, M, 2), generator=g), depth, 3)
    intrinsics = torch.tensor([40.0, 40, 20, 20], dtype=torch.float64).expand(1, N, 4)
    kk = torch.arange(N * M).repeat_interleave(N)
    jj = torch.arange(N).repeat(N * M)
    keep = kk // M != jj
    ii, jj, kk = (kk // M)[keep], jj[keep], kk[keep]
    targets = reproject(poses, patches, intrinsics, ii, jj, kk).coords[:, :, 1, 1]
    return poses, patches, intrinsics, targets, ii, jj, kk


@pytest.mark.parametrize("refine", ["none", "focal"])
def test_a_velocity_is_found_beside_poses_and_depths(refine):
    """Through the fast path and through the generic one, with and without the intrinsics as unknowns."""
    poses, patches, intrinsics, targets, *edges = moving_camera()
    g = torch.Generator().manual_seed(0)
    start = poses.clone()
    start[:, 2:] = se3.retract(poses[:, 2:], 0.01 * torch.randn(1, N - 2, 6, generator=g, dtype=torch.float64))
    velocity = vector_block(torch.zeros(1, 1, 3, dtype=torch.float64))
    factor = ConstantVelocity(torch.full((1, N - 1), 10.0, dtype=torch.float64), 0.5)
    options = BAOptions(
        fixed=2, iterations=15, damping=BADamping(1e-9, 1e-9, 1e-9), refine_intrinsics=refine, report=True
    )
    weights = torch.ones_like(targets)
    found = bundle_adjust(start, patches, intrinsics, targets, weights, *edges, options, factors=[factor],
                          blocks={"velocity": velocity})  # fmt: skip
    expected = torch.tensor([0.1, -0.04, 0.16], dtype=torch.float64)
    torch.testing.assert_close(found.blocks["velocity"][0, 0], expected, atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(found.poses_cw, poses, atol=1e-4, rtol=1e-3)
    assert found.cost is not None and found.cost < 1e-6


def test_gradients_pass_through_a_further_block():
    """The velocity depends on the measurements, and on its own start only while it has not converged."""
    poses, patches, intrinsics, targets, *edges = moving_camera()
    begin = torch.zeros(1, 1, 3, dtype=torch.float64, requires_grad=True)
    weight = torch.full((1, N - 1), 10.0, dtype=torch.float64, requires_grad=True)
    measured = targets.clone().requires_grad_()

    def velocity(start, seen, strength):
        options = BAOptions(fixed=2, iterations=1)
        return bundle_adjust(poses, patches, intrinsics, seen, torch.ones_like(seen), *edges, options,
                             factors=[ConstantVelocity(strength, 0.5)],
                             blocks={"velocity": vector_block(start)}).blocks["velocity"]  # fmt: skip

    assert torch.autograd.gradcheck(
        lambda start, strength: velocity(start, measured.detach(), strength), (begin, weight)
    )
    (gradient,) = torch.autograd.grad(velocity(begin, measured, weight).sum(), measured)
    assert gradient.abs().max() > 0
