"""Gradients of the layer against finite differences in float64."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from dvo.ba.factors import DepthPrior, PosePrior
from dvo.ba.layer.layer import BADamping, BAOptions, bundle_adjust
from dvo.geometry import se3

DAMPING = BADamping(pose=0.1, relative=0.2, depth=1e-2)
Maker = Callable[..., Any]


def layer_of(
    p: Any, factors: tuple = (), **options: Any
) -> tuple[Callable[..., tuple[Tensor, Tensor]], tuple[Tensor, ...]]:
    """The layer on tangents of the poses, inverse depths, intrinsics, targets and weights."""

    def f(xi: Tensor, depth: Tensor, intrinsics: Tensor, targets: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        poses = se3.compose(se3.exp(xi), p.poses)
        row = depth[:, :, None, None, None].expand_as(p.patches[:, :, :1])
        patches = torch.cat((p.patches[:, :, :2], row), 2)
        chosen = BAOptions(damping=DAMPING, **options)
        result = bundle_adjust(poses, patches, intrinsics, targets, weights, p.ii, p.jj, p.kk, chosen, factors=factors)
        poses, patches = result.poses_cw, result.patches
        return se3.log(se3.relative(p.poses, poses)), patches[:, :, 2, 1, 1]

    inputs = (torch.zeros_like(p.poses[..., :6]), p.patches[:, :, 2, 1, 1], p.intrinsics, p.targets, p.weights)
    return f, tuple(x.clone().requires_grad_() for x in inputs)


@pytest.mark.long
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"iterations": 1, "fixed": 0},
        {"structure_only": True},
        {"motion_only": True},
        {"fixed": torch.tensor([False, True, False])},
        {"bounds": (20, 20), "max_residual": 2.0},
    ],
    ids=str,
)
def test_gradcheck(problem: Maker, options: dict[str, Any]) -> None:
    p = problem(batch=1, frames=3, per_frame=2, noise=0.5)
    f, inputs = layer_of(p.shifted(60.0) if "bounds" in options else p, **options)  # some points leave the bounds
    # every number one by one for the plain call, random projections of the Jacobian for the rest
    assert torch.autograd.gradcheck(f, inputs, atol=1e-5, rtol=1e-4, fast_mode=bool(options))


def test_gradcheck_of_a_batch_with_many_edges(problem: Maker) -> None:
    f, inputs = layer_of(problem(noise=0.5))
    assert torch.autograd.gradcheck(f, inputs, atol=1e-5, rtol=1e-4, fast_mode=True)


def test_gradcheck_of_priors(problem: Maker) -> None:
    p = problem(batch=1, frames=3, per_frame=2, noise=0.5)
    f, inputs = layer_of(p)
    value, weight = torch.full((1, 6), 0.7, dtype=torch.float64), torch.full((1, 6), 2.0, dtype=torch.float64)
    step, stiffness = torch.full((1, 3, 6), 0.01, dtype=torch.float64), torch.full((1, 3, 6), 3.0, dtype=torch.float64)

    def with_priors(*tensors: Tensor) -> tuple[Tensor, Tensor]:
        value, weight, step, stiffness = tensors[5:]
        pose_prior = PosePrior(se3.compose(se3.exp(step), p.true_poses), stiffness)
        return layer_of(p, factors=(DepthPrior(value, weight), pose_prior))[0](*tensors[:5])

    inputs = (*inputs, *(x.requires_grad_() for x in (value, weight, step, stiffness)))
    assert torch.autograd.gradcheck(with_priors, inputs, atol=1e-5, rtol=1e-4, fast_mode=True)


def test_a_network_can_learn_through_the_layer(problem: Maker) -> None:
    """Descent on the targets alone brings the poses that come out to where they ought to be."""
    p = problem(batch=1, noise=1.0)
    targets = p.targets.clone().requires_grad_()
    optimiser = torch.optim.Adam([targets], lr=0.1)
    losses = []
    for _ in range(20):
        poses = bundle_adjust(p.poses, p.patches, p.intrinsics, targets, p.weights, p.ii, p.jj, p.kk).poses_cw
        loss = se3.log(se3.relative(poses, p.true_poses)).square().sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]
