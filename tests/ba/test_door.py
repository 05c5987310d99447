"""The door: checks, several sensors, unknown intrinsics, report, covariance, and gradients with mixed factors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from dvo.ba.blocks import POSES
from dvo.ba.covariance import pose_covariance
from dvo.ba.factors import DepthDamping, DepthPrior, PosePrior, RelativePose
from dvo.ba.kernels import Kernel
from dvo.ba.layer.layer import BADamping, BAOptions, Sensors, bundle_adjust, make_problem
from dvo.ba.layer.reference import bundle_adjust_reference, dense_rows
from dvo.ba.layer.step import gauss_newton
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.problem import Factor, Linearisation, Problem
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.odometry.patch.config import TrackerConfig

F64 = torch.float64
Maker = Callable[..., Any]


@pytest.mark.parametrize("field", ["ii", "jj", "kk"])
@pytest.mark.parametrize("value", [-1, 24])
def test_an_edge_index_out_of_range(problem: Maker, field: str, value: int) -> None:
    p = problem()
    index = getattr(p, field).clone()
    index[3] = value
    with pytest.raises(DvoError, match=f"{field}: index {value} outside 0"):
        replace(p, **{field: index}).solve()
    with pytest.raises(DvoError, match="outside"):
        replace(p, **{field: index}).solve(check=True)


def test_negative_weights(problem: Maker) -> None:
    p = problem(noise=0.5)
    weights = p.weights.clone()
    weights[1, 5, 0] = -1e-6
    with pytest.raises(DvoError, match="weights: negative"):
        replace(p, weights=weights).solve()
    weights[0, 0, 0] = float("nan")  # which hides the smallest weight
    with pytest.raises(DvoError, match="weights: negative"):
        replace(p, weights=weights).solve()
    replace(p, weights=weights).solve(check=False)


def test_options_are_checked() -> None:
    with pytest.raises(DvoError, match="refine_intrinsics"):
        BAOptions(refine_intrinsics="radial")  # type: ignore[arg-type]
    with pytest.raises(DvoError, match="iterations"):
        BAOptions(iterations=-1)


def test_weights_that_are_not_finite_leave_every_gradient_finite(problem: Maker) -> None:
    p = problem(noise=0.5)
    weights = p.weights.clone()
    weights[:, 7, 1] = float("nan")
    leaves = replace(p, weights=weights).leaves()
    poses, patches = leaves.solve()
    (poses.sum() + patches.sum()).backward()
    for name in ("poses", "patches", "intrinsics", "targets", "weights"):
        assert torch.isfinite(getattr(leaves, name).grad).all(), name


def test_cost_and_inliers_only_when_asked(problem: Maker) -> None:
    p = problem(noise=0.3)
    targets = p.targets.clone()
    targets[:, ::9] += 500
    p = replace(p, targets=targets)
    plain, full = p.adjust(), p.adjust(report=True)
    assert plain.cost is None and plain.inliers is None and plain.covariance is None
    assert torch.equal(plain.poses_cw, full.poses_cw) and torch.equal(plain.patches, full.patches)
    assert torch.equal(full.inliers, (torch.arange(len(p.ii)) % 9 != 0).expand(2, -1))
    made = make_problem(PatchProblem(full.poses_cw, full.patches, *p.arguments()[2:]), grouped=False)
    torch.testing.assert_close(full.cost, made.cost())
    start = p.adjust(report=True, iterations=0).cost
    assert (full.cost < 0.5 * start).all()
    with_prior = p.adjust((DepthPrior(torch.tensor(5.0), torch.tensor(3.0)),), report=True, iterations=0).cost
    assert (with_prior > start).all()


def stereo(baseline: float = 0.2) -> tuple[Any, ...]:
    """Frame 0 alone: patches of the left camera measured in the right one; the truth and a wrong start."""
    generator = torch.Generator().manual_seed(0)
    count = 20
    depth = 0.3 + torch.rand(1, count, dtype=F64, generator=generator)
    pixels = torch.rand(1, count, 2, dtype=F64, generator=generator) * torch.tensor([40.0, 30.0])
    left, right = se3.identity(dtype=F64), se3.identity(dtype=F64)
    right[0] = -baseline
    intrinsics = torch.tensor([[[30.0, 30, 20, 15], [33.0, 32, 21, 14]]], dtype=F64)
    ray = (pixels - intrinsics[:, :1, 2:]) / intrinsics[:, :1, :2]
    seen = (ray + torch.stack((-baseline * depth, torch.zeros_like(depth)), -1)) * intrinsics[:, 1:, :2]
    targets = seen + intrinsics[:, 1:, 2:]
    start = torch.cat((pixels, torch.full((1, count, 1), 0.6, dtype=F64)), -1)[..., None, None]
    zero = torch.zeros(count, dtype=torch.long)
    sensors = Sensors(zero, zero + 1, torch.stack((left, right)))
    return start, intrinsics, targets, zero, torch.arange(count), sensors, depth


def test_a_stereo_edge_within_a_frame_measures_depth_and_moves_no_pose() -> None:
    start, intrinsics, targets, zero, kk, sensors, depth = stereo()
    poses = se3.exp(torch.tensor([[[0.3, -0.2, 0.1, 0.2, 0.1, -0.3]] * 2], dtype=F64))
    options = BAOptions(fixed=0, iterations=8, sensors=sensors, damping=BADamping(pose=1e-3, depth=1e-9))
    result = bundle_adjust(poses, start, intrinsics, targets, torch.ones_like(targets), zero, zero, kk, options)
    torch.testing.assert_close(result.patches[:, :, 2, 0, 0], depth, atol=1e-6, rtol=0)
    torch.testing.assert_close(result.poses_cw, poses, atol=1e-9, rtol=0)
    # from a frame into itself in the same sensor, nothing is measured
    same = replace(options, sensors=replace(sensors, target=zero), damping=BADamping())
    result = bundle_adjust(poses, start, intrinsics, targets, torch.ones_like(targets), zero, zero, kk, same)
    torch.testing.assert_close(result.patches, start)
    torch.testing.assert_close(result.poses_cw, poses)


def test_a_sensor_out_of_range() -> None:
    start, intrinsics, targets, zero, kk, sensors, _ = stereo()
    poses = se3.identity(1, 2, dtype=F64)
    arguments = (targets, torch.ones_like(targets), zero, zero, kk)
    with pytest.raises(DvoError, match=r"sensors.target: index 2 outside 0..1"):
        options = BAOptions(sensors=replace(sensors, target=zero + 2))
        bundle_adjust(poses, start, intrinsics, *arguments, options)
    with pytest.raises(DvoError, match="intrinsics"):
        bundle_adjust(poses, start, intrinsics[:, :1], *arguments, BAOptions(sensors=sensors))


def test_one_sensor_at_the_body_is_the_plain_problem(problem: Maker) -> None:
    p = problem(noise=0.5)
    p = replace(p, intrinsics=p.intrinsics[:, :1].expand(-1, 4, 4))
    none = torch.zeros(len(p.ii), dtype=torch.long)
    sensors = Sensors(none, none, se3.identity(1, dtype=F64))
    found = replace(p, intrinsics=p.intrinsics[:, :1]).adjust(sensors=sensors)
    expected = p.adjust()
    torch.testing.assert_close(found.poses_cw, expected.poses_cw)
    torch.testing.assert_close(found.patches, expected.patches)


@pytest.mark.parametrize("refine", ["focal", "all"])
def test_an_unknown_focal_length_is_recovered(problem: Maker, refine: str) -> None:
    """15 % off, from exact measurements of a rotating and translating camera."""
    p = problem(batch=2, frames=6, per_frame=12, disturbance=0.0, depth_error=0.0)
    randn = torch.Generator().manual_seed(5)
    truth = se3.exp(0.25 * torch.randn(2, 6, 6, dtype=F64, generator=randn))
    intrinsics = torch.tensor([30.0, 32, 20, 15], dtype=F64).expand(2, 6, 4)
    seen = reproject(truth, p.true_patches, intrinsics, p.ii, p.jj, p.kk)
    weights = seen.valid[:, :, 1, 1, None].to(F64).expand(-1, -1, 2)
    wrong = intrinsics * torch.tensor([1.15, 1.15, 1, 1], dtype=F64)
    options = BAOptions(refine_intrinsics=refine, iterations=25, damping=BADamping(1e-4, 1e-6, 1e-6))  # type: ignore[arg-type]
    arguments = (seen.coords[:, :, 1, 1], weights, p.ii, p.jj, p.kk)
    result = bundle_adjust(truth, p.true_patches, wrong, *arguments, options)
    torch.testing.assert_close(result.intrinsics, intrinsics.contiguous(), atol=1e-2, rtol=0)
    held = bundle_adjust(truth, p.true_patches, wrong, *arguments, replace(options, refine_intrinsics="none"))
    assert torch.equal(held.intrinsics, wrong)
    assert (se3.log(se3.relative(held.poses_cw, truth)).abs().max() > 1e-2).item()


def test_covariance_is_the_inverse_of_the_dense_hessian(problem: Maker) -> None:
    p = problem(noise=0.3)
    damping = BADamping(pose=0.1, relative=0.5, depth=1e-3)
    result = p.adjust(covariance=(3, 0, 1), damping=damping)
    made = make_problem(PatchProblem(result.poses_cw, result.patches, *p.arguments()[2:]), grouped=False)
    _, w, jac_p, jac_l = dense_rows(made)
    jacobian = torch.cat((jac_p, jac_l), -1)
    hessian = jacobian.mT @ (w[..., None] * jacobian)
    hessian = hessian + torch.diag(torch.cat((torch.full((18,), 0.1), torch.full((24,), 1e-3))).to(F64))
    inverse = torch.linalg.inv(hessian)
    rows = torch.cat((torch.arange(12, 18), torch.arange(0, 6)))  # frames 3 and 1; frame 0 is fixed
    kept = torch.cat((torch.arange(6), torch.arange(12, 18)))
    found = result.covariance
    assert found.shape == (2, 18, 18)
    torch.testing.assert_close(found[:, kept][:, :, kept], inverse[:, rows][:, :, rows], atol=1e-9, rtol=1e-7)
    assert (found[:, 6:12] == 0).all() and (found[:, :, 6:12] == 0).all()
    with pytest.raises(DvoError, match="frame 4 outside"):
        p.adjust(covariance=(4,))
    again = p.adjust(covariance=(3, 0, 1), damping=damping, sigma=0.05)
    torch.testing.assert_close(again.covariance, 0.05**2 * found)
    assert torch.equal(again.poses_cw, result.poses_cw)
    with pytest.raises(DvoError, match="sigma: is 0, not positive"):
        p.adjust(covariance=(3,), sigma=0)
    nothing = replace(p, weights=torch.zeros_like(p.weights))
    found = pose_covariance(make_problem(PatchProblem(*nothing.arguments())), (1,), BADamping(pose=0.0))
    assert torch.isinf(found.diagonal(dim1=1, dim2=2)).all() and not torch.isnan(found).any()


def test_covariance_predicts_the_spread_of_the_estimate(problem: Maker) -> None:
    """Unit weights and unit noise: the last pose's errors have the covariance that is reported."""
    p = problem(batch=400, frames=4, per_frame=12, disturbance=0.0, depth_error=0.0)
    p = p.element(0)
    rows = ("poses", "patches", "intrinsics", "targets", "weights", "true_poses", "true_patches")
    p = replace(p, **{name: getattr(p, name).expand(400, *getattr(p, name).shape[1:]) for name in rows})
    sigma = 0.02
    noise = sigma * torch.randn(p.targets.shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    p = replace(p, targets=p.targets + noise, weights=torch.full_like(p.weights, sigma**-2))
    result = p.adjust(fixed=2, iterations=6, covariance=(3,), damping=BADamping(0.1, 0.0, 1e-4))
    errors = se3.log(se3.relative(p.true_poses[:, 3], result.poses_cw[:, 3]))
    whitened = torch.linalg.solve_triangular(torch.linalg.cholesky(result.covariance), errors[..., None], upper=False)
    assert 0.8 < whitened.square().mean().item() < 1.25


def test_confidence_and_sigma_predict_the_spread_of_the_estimate(problem: Maker) -> None:
    """Weights that are inverse variances in units of ``sigma^-2``, as the confidence of a network is."""
    p = problem(batch=400, frames=4, per_frame=12, disturbance=0.0, depth_error=0.0).element(0)
    rows = ("poses", "patches", "intrinsics", "targets", "weights", "true_poses", "true_patches")
    p = replace(p, **{name: getattr(p, name).expand(400, *getattr(p, name).shape[1:]) for name in rows})
    generator, sigma = torch.Generator().manual_seed(0), TrackerConfig().sigma
    weights = 0.2 + 0.8 * torch.rand(p.weights.shape[1:], dtype=F64, generator=generator).expand_as(p.weights)
    noise = sigma / weights.sqrt() * torch.randn(p.targets.shape, dtype=F64, generator=generator)
    p = replace(p, targets=p.targets + noise, weights=weights)
    damping = BADamping(1e-4, 0.0, 1e-6)
    result = p.adjust(fixed=2, iterations=6, covariance=(3,), sigma=sigma, damping=damping)
    errors = se3.log(se3.relative(p.true_poses[:, 3], result.poses_cw[:, 3]))
    whitened = torch.linalg.solve_triangular(torch.linalg.cholesky(result.covariance), errors[..., None], upper=False)
    assert 0.8 < whitened.square().mean().item() < 1.25


def mixed(p: Any, tensors: tuple[Tensor, ...]) -> tuple[Factor, ...]:
    value, weight, step, stiffness, motion, information, damping = tensors
    ii, jj = torch.tensor([0, 2]), torch.tensor([1, 0])
    measured = se3.compose(se3.exp(motion), se3.relative(p.true_poses[:, ii], p.true_poses[:, jj]))
    return (
        DepthPrior(value, weight),
        PosePrior(se3.compose(se3.exp(step), p.true_poses), stiffness),
        RelativePose(measured, information, ii, jj),
        DepthDamping(damping),
    )


@pytest.mark.long
@pytest.mark.parametrize("refine", ["none", "all"])
def test_gradcheck_of_a_step_with_mixed_factors(problem: Maker, refine: str) -> None:
    p = problem(batch=1, frames=3, per_frame=2, noise=0.5)
    randn = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> Tensor:
        return 0.5 + torch.rand(*shape, dtype=F64, generator=randn)

    more = (
        rand(1, 6),
        rand(1, 6),
        0.05 * rand(1, 3, 6),
        rand(1, 3, 6),
        0.05 * rand(1, 2, 6),
        rand(1, 2, 6),
        rand(1, 6),
    )
    none = torch.arange(len(p.ii)) % 2
    body = 0.1 * rand(2, 6)
    options = BAOptions(damping=BADamping(0.1, 0.2, 1e-2), refine_intrinsics=refine)  # type: ignore[arg-type]

    def f(xi: Tensor, depth: Tensor, intrinsics: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
        targets, weights, from_body, *parameters = rest
        poses = se3.compose(se3.exp(xi), p.poses)
        patches = torch.cat((p.patches[:, :, :2], depth[:, :, None, None, None].expand_as(p.patches[:, :, :1])), 2)
        sensors = Sensors(none, 1 - none, se3.exp(from_body)) if refine == "none" else None
        chosen = replace(options, sensors=sensors)
        factors = mixed(p, tuple(parameters))
        result = bundle_adjust(poses, patches, intrinsics, targets, weights, p.ii, p.jj, p.kk, chosen, factors=factors)
        return se3.log(se3.relative(p.poses, result.poses_cw)), result.patches[:, :, 2, 1, 1], result.intrinsics

    intrinsics = p.intrinsics[:, :2] if refine == "none" else p.intrinsics
    inputs = (torch.zeros_like(p.poses[..., :6]), p.patches[:, :, 2, 1, 1], intrinsics, p.targets, p.weights, body)
    leaves = tuple(x.detach().clone().requires_grad_() for x in (*inputs, *more))
    assert torch.autograd.gradcheck(f, leaves, atol=1e-5, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize("refine", ["none", "focal", "all"])
def test_the_dense_twin_of_mixed_factors(problem: Maker, refine: str) -> None:
    """Fast reprojection (or generic, with intrinsics) and every other factor, against plain autograd."""
    found = []
    for twin in (bundle_adjust, bundle_adjust_reference):
        p = problem(noise=0.5).leaves()
        randn = torch.Generator().manual_seed(1)
        more = [
            torch.rand(2, *s, dtype=F64, generator=randn) for s in ((24,), (24,), (4, 6), (4, 6), (2, 6), (2, 6), (24,))
        ]
        more = [(0.05 * x if i in (2, 4) else x).requires_grad_() for i, x in enumerate(more)]
        options = BAOptions(refine_intrinsics=refine, damping=BADamping(0.1, 0.2, 1e-2))  # type: ignore[arg-type]
        result = twin(*p.arguments(), options, factors=mixed(p, tuple(more)))
        outputs = (result.poses_cw, result.patches, result.intrinsics)
        sum((x * torch.linspace(-1, 1, x.numel(), dtype=F64).view(x.shape)).sum() for x in outputs).backward()
        gradients = [getattr(p, name).grad for name in ("patches", "intrinsics", "targets", "weights")]
        found.append([*outputs, *gradients, *(x.grad for x in more)])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-6)


def test_kernel_weights_are_constants_of_the_backward_pass(problem: Maker) -> None:
    """The layer with a kernel has the gradient of the layer with the kernel's weights multiplied in, detached."""
    p = problem(noise=1.0).leaves()
    options = BAOptions(iterations=1, kernel=Kernel("huber", 0.3))
    made = make_problem(PatchProblem(*p.arguments()), options, grouped=False)
    scale = made.factors[0].linearise(made.state.values()).weight.detach() / p.weights.detach()
    assert scale.min() < 0.5
    p.solve(iterations=1, kernel=options.kernel)[0].sum().backward()
    plain = problem(noise=1.0).leaves()
    weights = (plain.weights * scale).detach().requires_grad_()
    replace(plain, weights=weights).solve(iterations=1)[0].sum().backward()
    torch.testing.assert_close(p.targets.grad, plain.targets.grad)
    torch.testing.assert_close(p.weights.grad, weights.grad * scale)


@dataclass(frozen=True)
class Anchor(Factor):
    """A factor from outside: the camera centre of one frame is measured."""

    centre: Tensor
    frame: int

    def linearise(self, values: Any) -> Linearisation:
        pose = values[POSES][:, self.frame]
        at = se3.inverse(pose)[..., :3]
        rotation = se3.matrix(pose)[..., :3, :3].mT
        jacobian = torch.cat((-rotation, torch.zeros_like(rotation)), -1)  # a turn about the camera moves no centre
        index = torch.tensor([self.frame])
        residual = (self.centre - at)[:, None]
        return Linearisation(residual, torch.full_like(residual, 1e6), (POSES,), (index,), (jacobian[:, None],))


def test_a_factor_from_outside_needs_its_linearisation_only(problem: Maker) -> None:
    p = problem()
    goal = torch.tensor([[0.1, 0.2, -0.3]] * 2, dtype=F64).requires_grad_()
    result = p.adjust((Anchor(goal, 2),), iterations=6)
    at = se3.inverse(result.poses_cw[:, 2])[:, :3]
    torch.testing.assert_close(at, goal, atol=1e-3, rtol=0)
    (gradient,) = torch.autograd.grad(at[0, 0], goal)
    assert 0.9 < gradient[0, 0] < 1.1 and gradient[1].abs().max() == 0


def test_a_problem_without_factors(problem: Maker) -> None:
    made = make_problem(PatchProblem(*problem().arguments()))
    with pytest.raises(DvoError, match="without factors"):
        gauss_newton(Problem(made.state, ()), 1, BADamping())
