"""Sim(3): values against the matrix exponential, gradients, group axioms."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dvo.geometry import se3, sim3, so3

CASES = [(0.0, 0.0), (1e-9, 1e-9), (1e-4, 0.0), (0.0, 1e-4), (0.5, 0.3), (1.0, -2.0), (3.1, 1.0), (2.0, 4.0)]


def tangents(angle: float, sigma: float, count: int = 10) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    phi = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    phi = phi / phi.norm(dim=-1, keepdim=True) * angle
    tau = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    return torch.cat((tau, phi, torch.full((count, 1), sigma, dtype=torch.float64)), -1)


def generator_matrix(xi: Tensor) -> Tensor:
    m = torch.zeros(len(xi), 4, 4, dtype=xi.dtype)
    m[:, :3, :3] = so3.hat(xi[:, 3:6]) + xi[:, 6, None, None] * torch.eye(3, dtype=xi.dtype)
    m[:, :3, 3] = xi[:, :3]
    return m


@pytest.mark.parametrize(("angle", "sigma"), CASES)
def test_exp_is_the_matrix_exponential_and_log_undoes_it(angle: float, sigma: float) -> None:
    xi = tangents(angle, sigma)
    sim = sim3.exp(xi)
    torch.testing.assert_close(sim3.matrix(sim), torch.linalg.matrix_exp(generator_matrix(xi)), atol=1e-12, rtol=1e-12)
    torch.testing.assert_close(sim3.log(sim), xi, atol=1e-9, rtol=0)


@pytest.mark.long
@pytest.mark.parametrize(("angle", "sigma"), CASES)
def test_gradients(angle: float, sigma: float) -> None:
    xi = tangents(angle, sigma, 2)
    assert torch.autograd.gradcheck(sim3.exp, xi.clone().requires_grad_())
    for sign in (1.0, -1.0):
        flip = torch.tensor([1, 1, 1, sign, sign, sign, sign, 1], dtype=torch.float64)
        sim = sim3.exp(xi) * flip

        def moved(step: Tensor, sim: Tensor = sim) -> Tensor:
            return sim3.log(sim3.compose(sim3.exp(step), sim))

        assert torch.autograd.gradcheck(moved, torch.zeros(2, 7, dtype=torch.float64, requires_grad=True))


def test_group_axioms() -> None:
    a, b = sim3.exp(tangents(0.7, 0.4)), sim3.exp(tangents(1.3, -0.8)).flip(0)
    m = sim3.matrix
    torch.testing.assert_close(m(sim3.compose(a, b)), m(a) @ m(b))
    torch.testing.assert_close(m(sim3.inverse(a)), torch.linalg.inv(m(a)))
    points = torch.randn(10, 3, dtype=torch.float64)
    torch.testing.assert_close(sim3.act(a, points), (m(a)[:, :3, :3] @ points[..., None])[..., 0] + a[:, :3])
    xi = 0.1 * tangents(0.5, 0.2)
    left = sim3.compose(sim3.compose(a, sim3.exp(xi)), sim3.inverse(a))
    right = sim3.exp((sim3.adjoint(a) @ xi[..., None])[..., 0])
    torch.testing.assert_close(m(left), m(right))


def test_scale_one_is_se3() -> None:
    xi = tangents(0.9, 0.0)
    torch.testing.assert_close(sim3.exp(xi)[:, :7], se3.exp(xi[:, :6]))
    pose = se3.exp(xi[:, :6])
    sim = sim3.from_se3(pose, 2.0)
    moved = sim3.act_on_pose(sim, pose)
    torch.testing.assert_close(moved[:, :3], 2 * se3.rotate(pose[:, 3:], pose[:, :3]) + pose[:, :3])
    torch.testing.assert_close(moved[:, 3:].norm(dim=-1), torch.ones(10, dtype=torch.float64))
    torch.testing.assert_close(sim3.retract(sim, torch.zeros(10, 7, dtype=torch.float64)), sim)
    assert sim3.identity(2, 3).shape == (2, 3, 8)
