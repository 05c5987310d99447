"""Derivatives of the layer beyond a backward pass: second ones, ``torch.func``, and tensors changed in place."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from dvo.ba.edges import plan_edges
from dvo.ba.factors import DepthPrior, PosePrior
from dvo.ba.kernels import Kernel
from dvo.ba.layer.dense import dense_bundle_adjust, dense_plan
from dvo.ba.layer.layer import BADamping, BAOptions, Sensors, bundle_adjust
from dvo.ba.layer.reference import bundle_adjust_reference
from dvo.core.errors import DvoError
from dvo.geometry import se3

Maker = Callable[..., Any]
F64 = torch.float64
OPTIONS = BAOptions(damping=BADamping(0.1, 0.2, 1e-2))
NAMES = ("poses", "patches", "intrinsics", "targets", "weights")


def loss_of(p: Any, options: BAOptions = OPTIONS, twin: Callable[..., Any] = bundle_adjust, **more: Any) -> Callable:
    """A number of the result as a function of targets and weights."""

    def loss(targets: Tensor, weights: Tensor = p.weights) -> Tensor:
        given = p.poses, p.patches, p.intrinsics, targets, weights, p.ii, p.jj, p.kk
        result = twin(*given, options, **more)
        return result.poses_cw[..., :3].square().sum() + result.patches[:, :, 2].sum() + result.intrinsics.sum()

    return loss


@pytest.mark.parametrize("changes", [{}, {"refine_intrinsics": "all"}, {"motion_only": True}, {"structure_only": True}],
                         ids=str)  # fmt: skip
def test_a_gradient_penalty_has_the_gradient_of_the_twin(problem: Maker, changes: dict[str, Any]) -> None:
    p = problem(batch=2, frames=3, per_frame=2, noise=0.3)
    found = []
    for twin in (bundle_adjust, bundle_adjust_reference):
        targets, weights = p.targets.clone().requires_grad_(), p.weights.clone().requires_grad_()
        value = loss_of(p, replace(OPTIONS, **changes), twin)(targets, weights)
        gradient, more = torch.autograd.grad(value, (targets, weights), create_graph=True)
        (gradient.square().sum() + more.square().sum()).backward()
        found.append((gradient, more, targets.grad, weights.grad))
    assert found[0][2].abs().max() > 1e-6
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, atol=1e-8, rtol=1e-6)


@pytest.mark.long
def test_second_derivatives_against_finite_differences(problem: Maker) -> None:
    p = problem(batch=1, frames=3, per_frame=2, noise=0.3)
    prior = PosePrior(p.true_poses, torch.ones(1, 3, 6, dtype=F64))

    def f(targets: Tensor, weights: Tensor, intrinsics: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        factors = (prior, DepthPrior(value, torch.tensor(2.0, dtype=F64)))
        given = p.poses, p.patches, intrinsics, targets, weights, p.ii, p.jj, p.kk
        result = bundle_adjust(*given, OPTIONS, factors=factors)
        return result.poses_cw, result.patches[:, :, 2, 1, 1]

    inputs = (p.targets, p.weights, p.intrinsics, torch.full((1, 6), 0.6, dtype=F64))
    leaves = tuple(x.clone().requires_grad_() for x in inputs)
    assert torch.autograd.gradgradcheck(f, leaves, atol=1e-4, rtol=1e-3, fast_mode=True)


@pytest.mark.long
def test_transforms_agree_with_autograd(problem: Maker) -> None:
    p = problem(batch=1, frames=3, per_frame=2, noise=0.3).edges(torch.arange(6))
    loss = loss_of(p)
    targets = p.targets.clone().requires_grad_()
    value = loss(targets)
    (expected,) = torch.autograd.grad(value, targets)
    assert torch.equal(torch.func.grad(loss)(p.targets), expected)
    several = torch.stack((p.targets, p.targets + 0.1, p.targets - 0.2))
    torch.testing.assert_close(torch.func.vmap(loss)(several), torch.stack([loss(x) for x in several]))
    torch.testing.assert_close(torch.func.vmap(torch.func.grad(loss))(several)[0], expected)
    direction = torch.linspace(-1, 1, expected.numel(), dtype=F64).view_as(expected)
    along = torch.func.jvp(loss, (p.targets,), (direction,))[1]
    torch.testing.assert_close(along, (expected * direction).sum())
    hessian = torch.func.hessian(loss)(p.targets)
    torch.testing.assert_close(hessian, torch.autograd.functional.hessian(loss, p.targets))
    torch.testing.assert_close(torch.func.jacrev(torch.func.grad(loss))(p.targets), hessian)


def test_transforms_of_everything_that_a_problem_holds(problem: Maker) -> None:
    """Sensors, factors, indices, report and covariance, over a batch of whole problems."""
    p = problem(batch=1, frames=3, per_frame=2, noise=0.3)
    p = replace(p, intrinsics=p.intrinsics[:, :2])
    sensor = torch.arange(len(p.ii)) % 2
    options = replace(OPTIONS, sensors=Sensors(sensor, 1 - sensor, se3.identity(2, dtype=F64)), report=True,
                      covariance=(1,), kernel=Kernel("huber", 0.3))  # fmt: skip

    def solved(targets: Tensor, jj: Tensor, value: Tensor) -> tuple[Tensor, ...]:
        factors = (DepthPrior(value, value.new_tensor(2.0)),)
        given = p.poses, p.patches, p.intrinsics, targets, p.weights, p.ii, jj, p.kk
        r = bundle_adjust(*given, options, factors=factors)
        assert r.cost is not None and r.inliers is not None and r.covariance is not None
        return r.poses_cw, r.patches, r.intrinsics, r.cost, r.inliers, r.covariance

    targets = torch.stack((p.targets, p.targets + 0.5))
    jj, value = torch.stack((p.jj, (p.jj + 1) % 3)), torch.tensor([[[0.5] * 6], [[0.8] * 6]], dtype=F64)
    found = torch.func.vmap(solved)(targets, jj, value)
    for i in range(2):
        for a, b in zip(found, solved(targets[i], jj[i], value[i]), strict=True):
            assert torch.equal(a[i], b)


def test_what_is_not_supported_is_one_clear_error(problem: Maker) -> None:
    p = problem(batch=1, frames=3, per_frame=2, noise=0.3)
    loss = loss_of(p)
    with pytest.raises(DvoError, match=r"torch\.func\.jvp"), forward_ad.dual_level():
        loss(forward_ad.make_dual(p.targets, torch.ones_like(p.targets)))
    with pytest.raises(DvoError, match=r"torch\.func\.jacrev"):
        torch.autograd.functional.jacobian(loss, p.targets, vectorize=True)
    with pytest.raises(DvoError, match="weights: negative"):
        torch.func.vmap(lambda w: loss(p.targets, w))(torch.stack((p.weights, -p.weights)))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("options", [{}, {"refine_intrinsics": "focal"}, {"bounds": (40, 30)}], ids=str)
def test_a_target_that_is_none_leaves_every_gradient_finite(problem: Maker, value: float, options: dict) -> None:
    p = problem(noise=0.5)
    targets = p.targets.clone()
    targets[:, 7, 1] = value
    found, expected = replace(p, targets=targets).leaves(), p.edges(torch.arange(len(p.ii)) != 7).leaves()
    for q in (found, expected):
        result = q.adjust(**options)
        (result.poses_cw.sum() + result.patches.sum() + result.intrinsics.sum()).backward()
    for name in NAMES:
        assert torch.isfinite(getattr(found, name).grad).all(), name
    for name in ("poses", "patches", "intrinsics"):
        torch.testing.assert_close(getattr(found, name).grad, getattr(expected, name).grad, atol=1e-7, rtol=1e-7)


def test_a_gradient_that_is_none_is_not_hidden(problem: Maker) -> None:
    p = problem(noise=0.5).leaves()
    (p.solve()[1].sum() * math.nan).backward()
    assert p.weights.grad.isnan().any()


def change(x: Tensor) -> None:
    x.copy_(x.flip(0))


@pytest.mark.parametrize("name", ["ii", "jj", "kk"])
def test_indices_changed_before_the_backward_pass(problem: Maker, name: str) -> None:
    """Autograd notices; or the layer has copies, and the gradient is that of the indices as they were."""
    for options in ({}, {"refine_intrinsics": "all"}):
        p = problem(noise=0.5)
        p = replace(p, ii=p.ii.clone(), jj=p.jj.clone(), kk=p.kk.clone())
        gradients = []
        for changed in (False, True):
            leaves = p.leaves()
            total = sum(x.sum() for x in leaves.solve(**options))
            if changed:
                change(getattr(p, name))
            try:
                total.backward()
            except RuntimeError as error:
                assert changed and "modified by an inplace operation" in str(error)
                break
            gradients.append(leaves.targets.grad)
        assert len(gradients) == 1 or torch.equal(*gradients)


def test_other_indices_changed_before_the_backward_pass(problem: Maker) -> None:
    p = problem(noise=0.5)
    sensor, index = torch.arange(len(p.ii)) % 2, torch.arange(24)
    rig = Sensors(sensor, 1 - sensor, se3.identity(2, dtype=F64))
    prior = DepthPrior(torch.ones(2, 24, dtype=F64), torch.ones(2, 24, dtype=F64), index)
    plan = plan_edges(p.ii, p.jj, p.kk, 4, 24)
    for changed, options, more in (
        (sensor, {"sensors": rig}, {}), (index, {}, {"factors": (prior,)}), (plan.kk, {}, {"plan": plan}),
    ):  # fmt: skip
        q = replace(p, intrinsics=p.intrinsics[:, :2]) if options else p
        total = q.leaves().adjust(**more, **options).poses_cw.sum()
        change(changed)
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            total.backward()
    ii, jj = torch.tensor([0, 1]), torch.tensor([1, 0])
    depth = torch.full((1, 2, 3, 4), 0.5, dtype=F64, requires_grad=True)
    seen = torch.rand(1, 2, 3, 4, 2, dtype=F64)
    given = se3.identity(1, 2, dtype=F64), depth, p.intrinsics[:1, :2], seen, torch.ones_like(seen)
    poses, _ = dense_bundle_adjust(*given, ii, jj, plan=dense_plan(ii, jj, 2, 12))
    change(ii)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        poses.sum().backward()
