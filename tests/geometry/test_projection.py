"""Reprojection: against the formula written out, its Jacobians against finite differences and autograd."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from dvo.core.kernels import CHOICES, VARIABLE
from dvo.geometry import se3
from dvo.geometry.projection import Reprojection, by_kernel, reproject

F64 = torch.float64
B, N, M, P = 2, 4, 5, 3


def scene(seed: int = 0, motion: float = 0.1) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    poses = se3.exp(motion * torch.randn(B, N, 6, dtype=F64, generator=generator))
    centres = 4 + torch.rand(B, N * M, 2, dtype=F64, generator=generator) * torch.tensor([32.0, 22.0], dtype=F64)
    grid = torch.stack(torch.meshgrid(torch.arange(P) - 1, torch.arange(P) - 1, indexing="xy")).to(F64)
    xy = centres[..., None, None] + grid
    inverse_depth = 0.2 + torch.rand(B, N * M, 1, P, P, dtype=F64, generator=generator)
    intrinsics = torch.tensor([30.0, 32, 20, 15], dtype=F64) + torch.rand(B, N, 4, dtype=F64, generator=generator)
    return poses, torch.cat((xy, inverse_depth), 2), intrinsics


def edges() -> tuple[Tensor, Tensor, Tensor]:
    kk = torch.arange(N * M).repeat_interleave(N)
    return kk // M, torch.arange(N).repeat(N * M), kk


def written_out(
    poses: Tensor, patches: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, kk: Tensor
) -> tuple[Tensor, Tensor]:
    """REFERENCE: X = ((x-cx)/fx, (y-cy)/fy, 1, d); X' = T_j T_i^-1 X; pixel = K X' / max(Z', 0.1)."""
    fx, fy, cx, cy = intrinsics[:, ii, :, None, None].unbind(2)
    x, y, d = patches[:, kk].unbind(2)
    point = torch.stack(((x - cx) / fx, (y - cy) / fy, torch.ones_like(x), d), -1)
    motion = se3.matrix(poses[:, jj]) @ torch.linalg.inv(se3.matrix(poses[:, ii]))
    moved = (motion[:, :, None, None] @ point[..., None])[..., 0]
    fx, fy, cx, cy = intrinsics[:, jj, :, None, None].unbind(2)
    z = moved[..., 2].clamp(min=0.1)
    return torch.stack((fx * moved[..., 0] / z + cx, fy * moved[..., 1] / z + cy), -1), moved[..., 2]


@pytest.mark.parametrize("motion", [0.1, 1.0])
def test_the_formula(motion: float) -> None:
    out = reproject(*scene(motion=motion), *edges())
    coords, z = written_out(*scene(motion=motion), *edges())
    torch.testing.assert_close(out.coords, coords)
    torch.testing.assert_close(out.depth, z)
    assert torch.equal(out.valid, z > 0.2)
    if motion == 1.0:
        assert not out.valid.all() and out.valid.any()


def test_few_edges_among_many_frames_take_another_path_to_the_same_result() -> None:
    some = torch.tensor([3, 30, 61])
    ii, jj, kk = edges()
    whole = reproject(*scene(), ii, jj, kk)
    part = reproject(*scene(), ii[some], jj[some], kk[some])
    torch.testing.assert_close(part.coords, whole.coords[:, some])
    torch.testing.assert_close(part.depth, whole.depth[:, some])


def test_a_frame_sees_its_own_patches_where_they_are() -> None:
    poses, patches, intrinsics = scene()
    ii, jj, kk = edges()
    same = ii == jj
    out = reproject(poses, patches, intrinsics, ii[same], jj[same], kk[same])
    torch.testing.assert_close(out.coords, patches[:, kk[same], :2].permute(0, 1, 3, 4, 2))


def central_difference(role: str, axis: int) -> Tensor:
    """Of the centre pixel, moving only the source pose, only the target pose, or only the inverse depth of an edge."""
    poses, patches, intrinsics = scene()
    ii, jj, kk = edges()
    sides = []
    for eps in (1e-6, -1e-6):
        step = torch.zeros(6, dtype=F64)
        step[axis] = eps
        # moved copies of the frames stand behind the frames
        both = torch.cat((poses, se3.retract(poses, step)), 1)
        twice = intrinsics.repeat(1, 2, 1)
        changed = patches.clone()
        changed[:, :, 2] += eps if role == "d" else 0
        a, b = ii + (N if role == "i" else 0), jj + (N if role == "j" else 0)
        sides.append(reproject(both, changed, twice, a, b, kk).coords[:, :, 1, 1])
    return (sides[0] - sides[1]) / 2e-6


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("role", ["i", "j"])
def test_pose_jacobians_against_finite_differences(role: str, axis: int) -> None:
    out = reproject(*scene(), *edges(), jacobians=True)
    jacobian = getattr(out, f"jac_{role}")
    assert jacobian.shape == (B, N * N * M, 2, 6)
    torch.testing.assert_close(jacobian[..., axis], central_difference(role, axis), atol=1e-6, rtol=1e-6)


def test_depth_jacobian_against_finite_differences() -> None:
    out = reproject(*scene(), *edges(), jacobians=True)
    assert out.jac_d is not None and out.jac_d.shape == (B, N * N * M, 2, 1)
    torch.testing.assert_close(out.jac_d[..., 0], central_difference("d", 0), atol=1e-6, rtol=1e-6)


def test_jacobians_against_autograd() -> None:
    poses, patches, intrinsics = scene()
    ii, jj, kk = edges()
    out = reproject(poses, patches, intrinsics, ii, jj, kk, jacobians=True)
    assert out.jac_i is not None and out.jac_j is not None
    xi = torch.zeros(B, N, 6, dtype=F64, requires_grad=True)
    coords = reproject(se3.compose(se3.exp(xi), poses), patches, intrinsics, ii, jj, kk).coords[:, :, 1, 1]
    for e in (1, 17, 62):
        for axis in range(2):
            (found,) = torch.autograd.grad(coords[:, e, axis].sum(), xi, retain_graph=True)
            expected = torch.zeros(B, N, 6, dtype=F64)
            expected[:, ii[e]] += out.jac_i[:, e, axis]
            expected[:, jj[e]] += out.jac_j[:, e, axis]
            torch.testing.assert_close(found, expected)


def test_gradients() -> None:
    poses, patches, intrinsics = scene()
    ii, jj, kk = (index[::7] for index in edges())

    def f(xi: Tensor, patches: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
        out = reproject(se3.compose(se3.exp(xi), poses), patches, intrinsics, ii, jj, kk)
        return out.coords, out.depth

    xi = torch.zeros(B, N, 6, dtype=F64, requires_grad=True)
    inputs = (xi, patches.requires_grad_(), intrinsics.requires_grad_())
    assert torch.autograd.gradcheck(f, inputs, fast_mode=True)


def behind() -> tuple[Tensor, Tensor, Tensor, Reprojection]:
    poses, patches, intrinsics = scene()
    turn = torch.tensor([0, 0, 0, 0, torch.pi, 0], dtype=F64)
    poses = torch.cat((poses[:, :1], se3.retract(poses[:, 1:], turn)), 1).requires_grad_()
    patches.requires_grad_()
    intrinsics.requires_grad_()
    return poses, patches, intrinsics, reproject(poses, patches, intrinsics, *edges(), jacobians=True)


def test_points_behind_the_camera_are_finite_and_have_no_jacobian() -> None:
    poses, patches, intrinsics, out = behind()
    hidden = ~out.valid[:, :, 1, 1]
    assert hidden.any()
    for jacobian in (out.jac_i, out.jac_j, out.jac_d):
        assert jacobian is not None and torch.isfinite(jacobian).all()
        assert (jacobian[hidden] == 0).all()
    (out.coords.sum() + sum(j.sum() for j in (out.jac_i, out.jac_j, out.jac_d) if j is not None)).backward()
    for x in (poses, patches, intrinsics):
        assert x.grad is not None and torch.isfinite(x.grad).all()


def test_points_at_infinity_move_by_the_rotation_alone() -> None:
    poses, patches, intrinsics = scene()
    patches[:, :, 2] = 0
    far = reproject(poses, patches, intrinsics, *edges()).coords
    shifted = poses + torch.cat((torch.ones(3), torch.zeros(4))).to(F64)
    torch.testing.assert_close(reproject(shifted, patches, intrinsics, *edges()).coords, far)


def test_autocast_does_not_reach_in() -> None:
    poses, patches, intrinsics = (x.float() for x in scene())
    expected = reproject(poses, patches, intrinsics, *edges()).coords
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = reproject(poses, patches, intrinsics, *edges()).coords
    assert torch.equal(found, expected)


BAD = (math.nan, 1e8, -1e8, 0.0)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.integers(0, 10_000), st.integers(1, 2), st.sampled_from([0, 1, 7, 60]),
    st.sampled_from([(1, 1), (3, 3), (4, 5)]), st.sampled_from(BAD),
)  # fmt: skip
def test_the_kernel_projects_as_its_twin(
    monkeypatch: pytest.MonkeyPatch, seed: int, batch: int, count: int, size: tuple[int, int], bad: float
) -> None:
    """The twin in double precision; some points are behind the camera or have a coordinate that is none."""
    monkeypatch.delenv(VARIABLE, raising=False)
    generator = torch.Generator().manual_seed(seed)
    poses = se3.exp(torch.randn(batch, 4, 6, generator=generator))
    patches = 40 * torch.rand(batch, 5, 3, *size, generator=generator)
    patches[:, :, 2] /= 20
    patches[:, 0, seed % 3, 0, 0] = bad
    intrinsics = torch.tensor([30.0, 32, 20, 15]) + torch.rand(batch, 4, 4, generator=generator)
    indices = [torch.randint(high, (count,), generator=generator) for high in (4, 4, 5)]
    found = reproject(poses, patches, intrinsics, *indices)
    expected = reproject(se3.normalise(poses.double()), patches.double(), intrinsics.double(), *indices)
    torch.testing.assert_close(found.depth.double(), expected.depth, rtol=1e-5, atol=1e-5, equal_nan=True)
    scale = float(expected.coords.nan_to_num(0, 0, 0).abs().max()) if count else 1.0
    torch.testing.assert_close(found.coords.double(), expected.coords, rtol=1e-5, atol=1e-6 * scale, equal_nan=True)
    assert torch.equal(found.valid, expected.valid)
    assert found.coords.dtype == torch.float32


@pytest.mark.long
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.integers(0, 10_000), st.integers(1, 2), st.sampled_from([0, 1, 7, 60]),
    st.sampled_from([(1, 1), (3, 3), (4, 5)]), st.sampled_from([math.nan, 1e3, -1e3, 0.0]),
)  # fmt: skip
def test_the_adjoint_is_that_of_the_twin(
    monkeypatch: pytest.MonkeyPatch, seed: int, batch: int, count: int, size: tuple[int, int], bad: float
) -> None:
    """The twin in double precision; a number that is none spoils the same gradients."""
    monkeypatch.delenv(VARIABLE, raising=False)
    generator = torch.Generator().manual_seed(seed)
    poses = se3.exp(torch.randn(batch, 4, 6, generator=generator))
    patches = 40 * torch.rand(batch, 5, 3, *size, generator=generator)
    patches[:, :, 2] /= 20
    patches[:, 0, 2, 0, 0] = bad
    intrinsics = torch.tensor([30.0, 32, 20, 15]) + torch.rand(batch, 4, 4, generator=generator)
    indices = [torch.randint(high, (count,), generator=generator) for high in (4, 4, 5)]
    factors = [torch.randn(batch, count, *size, *last, generator=generator) for last in ((2,), ())]
    gradients = []
    for dtype in (torch.float32, torch.float64):
        leaves = [x.to(dtype).requires_grad_() for x in (se3.normalise(poses.double()), patches, intrinsics)]
        found = reproject(*leaves, *indices)
        total = (found.coords * factors[0].to(dtype)).sum() + (found.depth * factors[1].to(dtype)).sum()
        gradients.append(torch.autograd.grad(total, leaves))
    for x, y in zip(*gradients, strict=True):
        assert x.dtype == torch.float32
        scale = float(y.nan_to_num(0, 0, 0).abs().max())
        torch.testing.assert_close(x.double(), y, rtol=1e-4, atol=1e-5 * scale + 1e-6, equal_nan=True)


def test_the_adjoint_is_differentiated_again_and_takes_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds, batches = [], []
    for choice in CHOICES:
        monkeypatch.setenv(VARIABLE, choice)
        leaves = [x.float().requires_grad_() for x in scene()]
        coords = reproject(*leaves, *edges()).coords
        first = torch.autograd.grad(coords.square().sum(), leaves, create_graph=True)
        seconds.append(torch.autograd.grad(sum(g.square().sum() for g in first) * 1e-6, leaves, retain_graph=True))
        many = torch.stack((torch.ones_like(coords), coords.detach()))
        batches.append(torch.autograd.grad(coords, leaves, many, is_grads_batched=True))
    for found in (seconds, batches):
        for x, y in zip(*found, strict=True):
            torch.testing.assert_close(x, y, rtol=1e-3, atol=1e-4 * float(y.abs().max()))


@pytest.mark.parametrize("name", ["ii", "jj", "kk"])
@pytest.mark.parametrize("value", [-1, 100])
def test_an_index_out_of_range_is_not_read(name: str, value: int) -> None:
    floats = [x.float() for x in scene()]
    indices = dict(zip(("ii", "jj", "kk"), edges(), strict=True))
    wrong = indices[name].clone()
    wrong[1] = value
    assert by_kernel(*floats, **indices) is not None
    assert by_kernel(*floats, **(indices | {name: wrong})) is None
    assert by_kernel(*floats, **(indices | {name: wrong[:1]})) is None
    assert by_kernel(*floats, **(indices | {name: wrong.int()})) is None
