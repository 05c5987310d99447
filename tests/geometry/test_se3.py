"""SE(3): values against the matrix exponential, gradients where others have returned NaN.

Against other packages: ``tests/conformity/test_groups.py``.
"""

from __future__ import annotations

import math
from types import ModuleType

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dvo.geometry import se3, sim3, so3

ANGLES = [0.0, 1e-12, 1e-6, 1e-3, 0.0316, 0.0317, 0.1, 1.0, 3.0, math.pi - 1e-6, math.pi]
number = st.floats(-2, 2, allow_nan=False, width=32)
unit = st.tuples(number, number, number).filter(lambda v: sum(x * x for x in v) > 1e-2)


def tangents(angle: float, count: int = 20, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(int(angle * 1e6))
    phi = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    phi = phi / phi.norm(dim=-1, keepdim=True) * angle
    return torch.cat((torch.randn(count, 3, dtype=torch.float64, generator=generator), phi), -1).to(dtype)


def twist_matrix(xi: Tensor) -> Tensor:
    m = torch.zeros(*xi.shape[:-1], 4, 4, dtype=xi.dtype)
    m[..., :3, :3], m[..., :3, 3] = so3.hat(xi[..., 3:]), xi[..., :3]
    return m


@st.composite
def poses(draw: st.DrawFn) -> Tensor:
    axis = torch.tensor(draw(unit), dtype=torch.float64)
    angle = draw(st.floats(0, 3.1))
    tau = torch.tensor([draw(number) for _ in range(3)], dtype=torch.float64)
    return se3.exp(torch.cat((tau, axis / axis.norm() * angle)))


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle: float) -> None:
    xi = tangents(angle)
    torch.testing.assert_close(se3.matrix(se3.exp(xi)), torch.linalg.matrix_exp(twist_matrix(xi)), atol=1e-13, rtol=0)


@pytest.mark.parametrize("angle", ANGLES[:-1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_log_undoes_exp_for_both_signs_of_the_quaternion(angle: float, sign: float) -> None:
    xi = tangents(angle)
    pose = se3.exp(xi)
    pose = torch.cat((pose[:, :3], sign * pose[:, 3:]), -1)
    torch.testing.assert_close(se3.log(pose), xi, atol=1e-9, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
def test_float32_keeps_its_digits(angle: float) -> None:
    xi = tangents(angle)
    expected = se3.exp(xi)
    pose = se3.exp(xi.float())
    torch.testing.assert_close(pose.double(), expected, atol=2e-6, rtol=0)
    back = se3.log(pose)
    torch.testing.assert_close(se3.matrix(se3.exp(back)), se3.matrix(pose), atol=1e-5, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
def test_gradients_of_exp(angle: float) -> None:
    assert torch.autograd.gradcheck(se3.exp, tangents(angle, 3).requires_grad_())


@pytest.mark.long
@pytest.mark.parametrize("angle", ANGLES[:-1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_gradients_of_log(angle: float, sign: float) -> None:
    """In the tangent space; at angle zero with sign -1 the quaternion is minus the identity's."""
    pose = se3.exp(tangents(angle, 3))
    pose = torch.cat((pose[:, :3], sign * pose[:, 3:]), -1)

    def moved(xi: Tensor) -> Tensor:
        return se3.log(se3.compose(se3.exp(xi), pose))

    eps = 1e-7 if angle > 3.1 else 1e-6  # within the same half turn
    assert torch.autograd.gradcheck(moved, torch.zeros(3, 6, dtype=torch.float64, requires_grad=True), eps=eps)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "q",
    [
        (0, 0, 0, 1),
        (0, 0, 0, -1),
        (1, 0, 0, 0),
        (0, -1, 0, 0),
        (0, 0, 1, 1e-12),
        (0, 0, 1, -1e-12),
        (1e-20, 0, 0, 1),
        (1e-4, 0, 0, -1),
    ],
)
def test_everything_is_finite_at_special_rotations(q: tuple[float, ...], dtype: torch.dtype) -> None:
    pose = torch.tensor([0.3, -0.2, 0.1, *q], dtype=dtype, requires_grad=True)
    xi = se3.log(pose)
    out = (xi, se3.exp(xi), se3.inverse(pose), se3.adjoint(pose), se3.normalise(pose), so3.angle(pose[3:]))
    sum(x.sum() for x in out).backward()
    assert all(torch.isfinite(x).all() for x in out)
    assert torch.isfinite(pose.grad).all()


def test_huge_rotation_vectors_are_finite() -> None:
    xi = torch.tensor([1.0, 2, 3, 1e18, -1e18, 1e18], requires_grad=True)
    pose = se3.exp(xi)
    pose.sum().backward()
    assert torch.isfinite(pose).all() and torch.isfinite(xi.grad).all()


@settings(max_examples=30)
@given(poses(), poses(), poses())
def test_group_axioms(a: Tensor, b: Tensor, c: Tensor) -> None:
    close = {"atol": 1e-10, "rtol": 0.0}
    m = se3.matrix
    torch.testing.assert_close(m(se3.compose(a, b)), m(a) @ m(b), **close)
    torch.testing.assert_close(m(se3.compose(se3.compose(a, b), c)), m(se3.compose(a, se3.compose(b, c))), **close)
    torch.testing.assert_close(m(se3.compose(a, se3.inverse(a))), torch.eye(4, dtype=torch.float64), **close)
    torch.testing.assert_close(m(se3.relative(a, b)), m(b) @ torch.linalg.inv(m(a)), **close)
    torch.testing.assert_close(m(se3.from_matrix(m(a))), m(a), **close)


@given(poses(), st.tuples(number, number, number), number)
def test_action(a: Tensor, p: tuple[float, ...], h: float) -> None:
    point = torch.tensor(p, dtype=torch.float64)
    whole = torch.cat((point, torch.tensor([h], dtype=torch.float64)))
    torch.testing.assert_close(se3.act_homogeneous(a, whole), se3.matrix(a) @ whole)
    torch.testing.assert_close(se3.act(a, point), se3.matrix(a)[:3, :3] @ point + a[:3])
    torch.testing.assert_close(se3.rotate(a[3:], point), se3.matrix(a)[:3, :3] @ point)


@given(poses(), st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6))
def test_adjoint_moves_a_perturbation_across(a: Tensor, small: list[float]) -> None:
    xi = torch.tensor(small, dtype=torch.float64)
    left = se3.compose(se3.compose(a, se3.exp(xi)), se3.inverse(a))
    torch.testing.assert_close(se3.matrix(left), se3.matrix(se3.exp(se3.adjoint(a) @ xi)), atol=1e-10, rtol=0)


@given(poses())
def test_from_matrix_near_every_branch(a: Tensor) -> None:
    """Rotations by half a turn about each axis exercise all four solutions."""
    for axis in torch.eye(3, dtype=torch.float64):
        turned = se3.compose(se3.exp(torch.cat((torch.zeros(3, dtype=torch.float64), axis * math.pi))), a)
        m = se3.matrix(turned)
        torch.testing.assert_close(se3.matrix(se3.from_matrix(m)), m, atol=1e-10, rtol=0)


def test_retract_keeps_the_quaternion_at_length_one() -> None:
    pose = se3.identity(5)
    step = tangents(0.3, 5, torch.float32)
    for _ in range(200):
        pose = se3.retract(pose, step)
    torch.testing.assert_close(pose[:, 3:].norm(dim=-1), torch.ones(5), atol=1e-6, rtol=0)


def test_batches_broadcast() -> None:
    a, b = se3.exp(tangents(0.5, 4))[:, None], se3.exp(tangents(0.7, 3))
    out = se3.compose(a, b)
    assert out.shape == (4, 3, 7)
    torch.testing.assert_close(out[2, 1], se3.compose(a[2, 0], b[1]))
    assert se3.act(a, torch.zeros(3, 3, dtype=torch.float64)).shape == (4, 3, 3)


def test_rotations_are_not_computed_in_the_precision_of_autocast() -> None:
    pose = se3.exp(tangents(0.5, 4, torch.float32))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = se3.matrix(se3.compose(pose, pose)), se3.act(pose, pose[:, :3])
    outside = se3.matrix(se3.compose(pose, pose)), se3.act(pose, pose[:, :3])
    for a, b in zip(inside, outside, strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=0)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-6, 0.5, 3.0]))
def test_left_jacobians_are_derivatives_of_the_exponential_maps(seed: int, angle: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    for group, dim in ((se3, 6), (sim3, 7)):
        xi = torch.randn(3, dim, dtype=torch.float64, generator=generator)
        xi[:, 3:6] *= angle / xi[:, 3:6].norm(dim=-1, keepdim=True)

        def turned(step: Tensor, group: ModuleType = group, xi: Tensor = xi) -> Tensor:
            return group.log(group.compose(group.exp(xi + step), group.inverse(group.exp(xi)))).sum(0)

        expected = torch.autograd.functional.jacobian(turned, torch.zeros_like(xi)).transpose(0, 1)
        torch.testing.assert_close(group.left_jacobian(xi), expected, atol=1e-9, rtol=0)


def test_steps_compose_to_the_trajectory():
    poses_cw = se3.exp(0.3 * tangents(0.8, 8)).unflatten(0, (2, 4))
    motions = se3.steps(poses_cw)
    assert motions.shape == (2, 3, 7)
    pose_wc = se3.inverse(poses_cw[:, 0])
    for k in range(3):
        pose_wc = se3.compose(pose_wc, motions[:, k])
    torch.testing.assert_close(se3.matrix(pose_wc), se3.matrix(se3.inverse(poses_cw[:, 3])))
