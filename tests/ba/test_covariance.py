"""Marginal covariance under a constraint that fixes the scale: the dense bordered Hessian, and estimates' spread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from dvo.ba.covariance import pose_covariance, size_gradient
from dvo.ba.layer.layer import BADamping, BAOptions, make_problem
from dvo.ba.layer.reference import dense_rows
from dvo.ba.patch_problem import PatchProblem
from dvo.geometry import se3

F64 = torch.float64
Maker = Callable[..., Any]
WEAK = BADamping(pose=1e-8, relative=0.0, depth=1e-9)


def bordered_inverse(p: Any, gradient: Tensor, damping: BADamping) -> Tensor:
    """Inverse of the Hessian of all unknowns but the first pose, bordered with the constraint; plain and dense."""
    made = make_problem(PatchProblem(*p.arguments()), BAOptions(fixed=1), grouped=False)
    _, w, jac_p, jac_l = dense_rows(made)
    jacobian = torch.cat((jac_p, jac_l), -1)
    hessian = jacobian.mT @ (w[..., None] * jacobian)
    poses, depths = jac_p.shape[-1], jac_l.shape[-1]
    own = torch.cat((torch.full((poses,), damping.pose), torch.full((depths,), damping.depth)))
    column = torch.nn.functional.pad(gradient[:, 1:].flatten(1), (0, depths))[..., None]
    top = torch.cat((hessian + torch.diag(own.to(F64)), column), -1)
    return torch.linalg.inv(torch.cat((top, torch.nn.functional.pad(column.mT, (0, 1))), -2))


def test_the_inverse_of_the_bordered_dense_hessian(problem: Maker) -> None:
    p = problem(noise=0.3)
    gradient = size_gradient(p.poses, 0, [1, 2])
    made = make_problem(PatchProblem(*p.arguments()), BAOptions(fixed=1))
    found = pose_covariance(made, [3, 1], WEAK, constraint=gradient)
    rows = torch.cat((torch.arange(12, 18), torch.arange(6)))
    plain = bordered_inverse(p, gradient, WEAK)[:, rows][:, :, rows]
    torch.testing.assert_close(found, plain, atol=1e-10, rtol=1e-6)
    assert (torch.linalg.eigvalsh(found[:, :6, :6]) > 0).all()


def test_the_size_is_held_and_free_without_the_constraint(problem: Maker) -> None:
    p = problem()
    gradient = size_gradient(p.true_poses, 0, [1, 2, 3])
    exact = replace(p, poses=p.true_poses, patches=p.true_patches)
    made = make_problem(PatchProblem(*exact.arguments()), BAOptions(fixed=1))
    a = gradient[:, 1:].flatten(1)[..., None]
    held, free = (pose_covariance(made, [1, 2, 3], WEAK, constraint=c) for c in (gradient, None))
    assert (a.mT @ held @ a).abs().max() < 1e-8
    assert (a.mT @ free @ a).min() > 1e3, "nothing measures the scale"
    again = pose_covariance(made, [1, 2, 3], WEAK, constraint=1e3 * gradient)
    torch.testing.assert_close(again, held, atol=1e-10, rtol=1e-6)


def test_the_gradient_of_the_size(problem: Maker) -> None:
    poses = problem().poses
    xi = torch.zeros(*poses.shape[:2], 6, dtype=F64, requires_grad=True)
    centres = se3.inverse(se3.retract(poses, xi))[..., :3]
    size = (centres[:, [0, 2]] - centres[:, 1:2].detach()).square().sum() / 2
    (expected,) = torch.autograd.grad(size, xi)
    torch.testing.assert_close(size_gradient(poses, 1, [0, 2]), expected)


def test_it_predicts_the_spread_of_the_estimate_at_fixed_size(problem: Maker) -> None:
    """Only one pose is held: estimates begin at another scale, stay there, and are brought to the true size."""
    p = problem(batch=400, frames=4, per_frame=12, disturbance=0.0, depth_error=0.0).element(0)
    rows = ("poses", "patches", "intrinsics", "targets", "weights", "true_poses", "true_patches")
    p = replace(p, **{name: getattr(p, name).expand(400, *getattr(p, name).shape[1:]) for name in rows})
    sigma = 0.02
    noise = sigma * torch.randn(p.targets.shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    p = replace(p, targets=p.targets + noise, weights=torch.full_like(p.weights, sigma**-2))
    relative = se3.relative(p.poses[:, :1].expand_as(p.poses), p.poses)
    larger = torch.cat((1.3 * relative[..., :3], relative[..., 3:]), -1)
    patches = torch.cat((p.patches[:, :, :2], p.patches[:, :, 2:] / 1.3), 2)
    poses, _ = replace(p, poses=larger, patches=patches).solve(
        fixed=1, iterations=8, damping=BADamping(1e-3, 0.0, 1e-6)
    )
    found, true = (se3.relative(x[:, :1].expand_as(x), x) for x in (poses, p.true_poses))
    size = [x[:, 1:3, :3].square().sum((1, 2)).sqrt() for x in (found, true)]
    newest = torch.cat(((size[1] / size[0])[:, None] * found[:, 3, :3], found[:, 3, 3:]), -1)
    errors = se3.log(se3.relative(true[:, 3], newest))
    made = make_problem(PatchProblem(p.true_poses, p.true_patches, *p.arguments()[2:]), BAOptions(fixed=1))
    covariance = pose_covariance(made, [3], WEAK, constraint=size_gradient(p.true_poses, 0, [1, 2]))
    whitened = torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), errors[..., None], upper=False)
    assert 0.8 < whitened.square().mean().item() < 1.25
    assert (size[0] / size[1]).mean().item() > 1.25


@pytest.mark.parametrize("weight", [1e10, 1e14, 1e20])
@pytest.mark.parametrize("dtype", [torch.float32, F64], ids=str)
def test_one_weight_among_small_ones_leaves_the_other_directions(
    problem: Maker, weight: float, dtype: torch.dtype
) -> None:
    """From a weight on that holds its edge, more of it changes nothing; a Hessian has no digits for both."""
    p = problem(noise=0.3)
    p = replace(p, **{name: getattr(p, name).to(torch.float32).to(dtype) for name in
                      ("poses", "patches", "intrinsics", "targets", "weights")})  # fmt: skip

    def covariance(weight: float) -> Tensor:
        weights = p.weights.clone()
        weights[:, 5] = weight
        given = PatchProblem(*replace(p, weights=weights).arguments())
        return pose_covariance(make_problem(given), (1, 3))

    expected, found = covariance(1e6), covariance(weight)
    assert torch.isfinite(found).all()
    scale = expected.diagonal(dim1=1, dim2=2).sqrt()
    scale = scale[:, :, None] * scale[:, None]
    assert ((found - expected) / scale).abs().max() < 0.01


def test_the_rows_give_the_covariance_of_the_equations(problem: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    p = problem(noise=0.3)
    made = make_problem(PatchProblem(*p.arguments()))
    prior = size_gradient(p.poses, 0, (1, 2, 3))
    expected = [pose_covariance(made, (1, 2), WEAK, constraint=prior), pose_covariance(made, (1, 2))]
    monkeypatch.setattr("dvo.ba.covariance._keeps_digits", lambda *a: torch.zeros(2, dtype=torch.bool))
    found = [pose_covariance(made, (1, 2), WEAK, constraint=prior), pose_covariance(made, (1, 2))]
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-9)
