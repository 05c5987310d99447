"""Further state blocks: unknowns that only factors from outside concern."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from dvo.ba.blocks import INVERSE_DEPTHS, POSES, vector_block
from dvo.ba.kernels import Kernel
from dvo.ba.layer.layer import BADamping, BAOptions, bundle_adjust
from dvo.ba.layer.reference import bundle_adjust_reference
from dvo.ba.problem import Factor, Linearisation
from dvo.ba.sparse.global_adjust import GlobalBAOptions, global_bundle_adjust
from dvo.ba.sparse.levenberg import LMOptions
from dvo.geometry import se3, so3
from dvo.geometry.projection import reproject
from dvo.nets.patch.patchifier import patch_coordinates

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


@dataclass(frozen=True)
class Motion(Factor):
    """Unknowns of nine numbers for each frame, a velocity and two biases, and one scale of what was measured.

    Attributes:
        steps: ``(B, N - 1, 3)`` measured ways of the camera, to be multiplied by the scale.
        biases: ``(B, N - 1, 6)`` measured.
        dt: seconds between frames.
    """

    steps: Tensor
    biases: Tensor
    dt: float = 0.5

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        poses, motion, scale = values[POSES], values["motion"], values["scale"]
        centres, turn = se3.inverse(poses)[..., :3], so3.matrix(poses[..., 3:]).mT
        i = torch.arange(poses.shape[1] - 1)
        way = centres[:, 1:] - centres[:, :-1]
        residual = torch.cat(
            [scale * self.steps - way, way / self.dt - motion[:, :-1, :3], self.biases - motion[:, :-1, 3:],
             motion[:, 1:] - motion[:, :-1]], -1,
        )  # fmt: skip
        weight = torch.cat([torch.full_like(residual[..., :12], 10.0), torch.full_like(residual[..., 12:], 0.5)], -1)
        zeros, eye = residual.new_zeros, torch.eye(9, dtype=poses.dtype).expand(*i.shape, 9, 9)
        of_j, of_i, of_scale = zeros(1, len(i), 21, 6), zeros(1, len(i), 21, 6), zeros(1, len(i), 21, 1)
        of_j[..., :3, :3], of_i[..., :3, :3] = -turn[:, 1:], turn[:, :-1]
        of_j[..., 3:6, :3], of_i[..., 3:6, :3] = turn[:, 1:] / self.dt, -turn[:, :-1] / self.dt
        of_scale = torch.cat([-self.steps, zeros(1, len(i), 18)], -1)[..., None]
        of_next = torch.cat([zeros(1, len(i), 12, 9), -eye[None]], 2)
        of_here = torch.cat([zeros(1, len(i), 3, 9), eye[None], eye[None]], 2)
        return Linearisation(
            residual, weight, (POSES, POSES, "motion", "motion", "scale"),
            (i + 1, i, i + 1, i, torch.zeros_like(i)), (of_j, of_i, of_next, of_here, of_scale),
        )  # fmt: skip


@dataclass(frozen=True)
class ScaledDepth(Factor):
    """Inverse depths ``(B, F)`` of the first patches, measured but for the scale."""

    value: Tensor

    def linearise(self, values: Mapping[str, Tensor]) -> Linearisation:
        index = torch.arange(self.value.shape[1])
        residual = (self.value - values[INVERSE_DEPTHS][:, index] * values["scale"][:, :, 0])[..., None]
        of_depth = values["scale"].expand(-1, len(index), -1)[..., None]
        of_scale = values[INVERSE_DEPTHS][:, index, None, None]
        names, elements = (INVERSE_DEPTHS, "scale"), (index, torch.zeros_like(index))
        return Linearisation(residual, torch.full_like(residual, 20.0), names, elements, (of_depth, of_scale))


def measured_motion():
    """The moving camera from a wrong start, with noise, blocks of another size and their factors."""
    poses, patches, intrinsics, targets, *edges = moving_camera()
    g = torch.Generator().manual_seed(1)

    def noise(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    start = torch.cat([poses[:, :2], se3.retract(poses[:, 2:], 0.02 * noise(1, N - 2, 6))], 1)
    centres = se3.inverse(poses)[..., :3]
    steps = (centres[:, 1:] - centres[:, :-1]) / 1.2 + 0.002 * noise(1, N - 1, 3)
    depths = patches[:, :10, 2, 1, 1] * 1.2 + 0.01 * noise(1, 10)
    blocks = {"motion": vector_block(0.1 * noise(1, N, 9)), "scale": vector_block(torch.ones(1, 1, 1).double())}
    factors = (Motion(steps, 0.05 * noise(1, N - 1, 6)), ScaledDepth(depths))
    arguments = (start, patches, intrinsics, targets + 0.2 * noise(*targets.shape), torch.ones_like(targets), *edges)
    return arguments, factors, blocks


def test_dense_and_sparse_solutions_of_any_block_are_one_minimum():
    """Blocks and factors that the library does not know, by the differentiable layer, its dense twin and the sparse
    solver."""
    arguments, factors, blocks = measured_motion()
    options = BAOptions(fixed=2, iterations=25, damping=BADamping(1e-9, 1e-9, 1e-9), report=True)
    layer = bundle_adjust(*arguments, options, factors=factors, blocks=blocks)
    few = replace(options, iterations=3)
    twin, again = (solve(*arguments, few, factors=factors, blocks=blocks) for solve in
                   (bundle_adjust_reference, bundle_adjust))  # fmt: skip
    torch.testing.assert_close(twin.poses_cw, again.poses_cw)
    one = [x[0] for x in arguments[:5]] + [*arguments[5:]]
    exact = LMOptions(max_iterations=100, tolerance=1e-14)
    for solver in ("direct", "cg"):
        settings = GlobalBAOptions(fixed=2, kernel=Kernel(), solver=replace(exact, solver=solver))
        sparse = global_bundle_adjust(*one, settings, factors, blocks)
        assert 2 * sparse.cost == pytest.approx(float(layer.cost), rel=1e-7)
        torch.testing.assert_close(sparse.poses_cw[None], layer.poses_cw, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(sparse.patches[None], layer.patches, atol=1e-4, rtol=1e-3)
        for name, value in layer.blocks.items():
            torch.testing.assert_close(sparse.blocks[name], value, atol=1e-4, rtol=1e-3)
    assert abs(float(layer.blocks["scale"]) - 1) > 0.05 and layer.blocks["motion"].abs().max() > 0.05


def test_gradients_of_any_block_are_those_of_finite_differences():
    arguments, factors, blocks = measured_motion()
    options = BAOptions(fixed=2, iterations=2, damping=BADamping(1e-3, 1e-3, 1e-3))

    def solved(steps, depths, motion, scale, targets):
        given = {"motion": vector_block(motion), "scale": vector_block(scale)}
        found = bundle_adjust(*arguments[:3], targets, *arguments[4:], options, blocks=given,
                              factors=(replace(factors[0], steps=steps), ScaledDepth(depths)))  # fmt: skip
        return found.poses_cw, found.blocks["motion"], found.blocks["scale"], found.patches[:, :, 2, 1, 1]

    leaves = (factors[0].steps, factors[1].value, *(block.value for block in blocks.values()), arguments[3])
    leaves = tuple(x.clone().requires_grad_() for x in leaves)
    assert torch.autograd.gradcheck(solved, leaves, atol=1e-6, rtol=1e-4, fast_mode=True)
