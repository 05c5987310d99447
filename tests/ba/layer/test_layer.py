"""The layer: what it solves, and the modes and options it has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from dvo.ba import edges as edges_module
from dvo.ba.edges import plan_edges
from dvo.ba.factors import DepthPrior, PosePrior
from dvo.ba.layer.layer import BADamping, BAOptions
from dvo.ba.layer.reference import bundle_adjust_reference
from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.projection import reproject

Maker = Callable[..., Any]


def reprojection_error(p: Any, poses: Tensor, patches: Tensor) -> Tensor:
    coords = reproject(poses, patches, p.intrinsics, p.ii, p.jj, p.kk).coords[:, :, 1, 1]
    return (coords - p.targets).norm(dim=-1)


def test_exact_targets_are_recovered(problem: Maker) -> None:
    """Two poses held at the truth fix the scale."""
    p = problem()
    p = replace(p, poses=torch.cat((p.true_poses[:, :2], p.poses[:, 2:]), 1))
    assert reprojection_error(p, p.poses, p.patches).median() > 0.5
    poses, patches = p.solve(iterations=15, damping=BADamping(pose=1e-6, relative=0, depth=1e-9), fixed=2)
    assert reprojection_error(p, poses, patches).max() < 1e-6
    torch.testing.assert_close(se3.matrix(poses), se3.matrix(p.true_poses), atol=1e-6, rtol=0)
    torch.testing.assert_close(patches, p.true_patches, atol=1e-5, rtol=0)


def test_default_damping_recovers_motion_up_to_scale(problem: Maker) -> None:
    p = problem(dtype=torch.float32)
    poses, patches = p.solve(iterations=20)
    assert reprojection_error(p, poses, patches).median() < 0.02
    rotation = se3.log(se3.relative(poses, p.true_poses))[..., 3:].norm(dim=-1)
    assert rotation.max() < 2e-3


def test_fixed_poses_stay_to_the_bit(problem: Maker) -> None:
    p = problem(noise=0.5)
    for fixed, held in ((1, [0]), (3, [0, 1, 2]), (torch.tensor([False, True, False, True]), [1, 3])):
        poses, patches = p.solve(fixed=fixed, iterations=3)
        free = [n for n in range(4) if n not in held]
        assert torch.equal(poses[:, held], p.poses[:, held])
        assert (poses[:, free] != p.poses[:, free]).any(-1).all()
        assert (patches[:, :, 2] != p.patches[:, :, 2]).any()


@pytest.mark.parametrize("fixed", [4, torch.ones(4, dtype=torch.bool), [True] * 4])
def test_all_poses_fixed_is_structure_only(problem: Maker, fixed: Any) -> None:
    p = problem(noise=0.5)
    found, expected = p.solve(fixed=fixed), p.solve(structure_only=True)
    assert torch.equal(found[0], p.poses) and torch.equal(expected[0], p.poses)
    torch.testing.assert_close(found[1], expected[1])


def test_motion_only(problem: Maker) -> None:
    p = problem()
    p = replace(p, patches=p.true_patches)
    poses, patches = p.solve(motion_only=True, iterations=10, damping=BADamping(pose=1e-9))
    assert torch.equal(patches, p.patches)
    torch.testing.assert_close(se3.matrix(poses), se3.matrix(p.true_poses), atol=1e-6, rtol=0)


def test_structure_only(problem: Maker) -> None:
    p = problem()
    p = replace(p, poses=p.true_poses)
    poses, patches = p.solve(structure_only=True, iterations=10)
    assert torch.equal(poses, p.poses)
    torch.testing.assert_close(patches, p.true_patches, atol=1e-4, rtol=0)


def test_both_modes_at_once_move_nothing(problem: Maker) -> None:
    p = problem()
    poses, patches = p.solve(structure_only=True, motion_only=True)
    assert torch.equal(poses, p.poses) and torch.equal(patches, p.patches)


MODES: list[dict[str, Any]] = [
    {},
    {"bounds": (20, 15), "max_residual": 3.0},
    {"structure_only": True},
    {"motion_only": True},
    {"fixed": 2, "iterations": 3},
    {"fixed": 0, "iterations": 1},
    {"damping": BADamping(1.0, 0.3, 0.2)},
    {"depth_range": (0.4, 0.9)},
]


@pytest.mark.parametrize("options", MODES, ids=str)
def test_the_dense_twin_gives_the_same_values_and_gradients(problem: Maker, options: dict[str, Any]) -> None:
    """One joint system from explicit Jacobians, differentiated by plain autograd."""
    results = []
    for twin in (False, True):
        p = problem(noise=0.5).leaves()
        if twin:
            result = bundle_adjust_reference(*p.arguments(), BAOptions(**options))
            poses, patches = result.poses_cw, result.patches
        else:
            poses, patches = p.solve(**options)
        generator = torch.Generator().manual_seed(1)
        random = torch.randn(2, poses.numel() + patches.numel(), dtype=poses.dtype, generator=generator)[0]
        (torch.cat((poses.flatten(), patches.flatten())) * random).sum().backward()
        # along the manifold only: how a function extends to quaternions of another length is no property of the layer
        xi = torch.zeros(2, 4, 6, dtype=poses.dtype, requires_grad=True)
        (se3.retract(p.poses.detach(), xi) * p.poses.grad).sum().backward()
        names = ("patches", "intrinsics", "targets", "weights")
        gradients = {name: getattr(p, name).grad for name in names} | {"poses": xi.grad}
        results.append((poses, patches, gradients))
    (poses, patches, gradients), (their_poses, their_patches, theirs) = results
    torch.testing.assert_close(poses, their_poses, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(patches, their_patches, atol=1e-9, rtol=1e-9)
    for name, expected in theirs.items():
        torch.testing.assert_close(gradients[name], expected, atol=1e-7, rtol=1e-6, msg=lambda m, n=name: f"{n}: {m}")


def test_the_order_of_edges_does_not_matter(problem: Maker) -> None:
    p = problem(noise=0.5)
    order = torch.randperm(len(p.ii), generator=torch.Generator().manual_seed(0))
    for found, expected in zip(p.edges(order).solve(), p.solve(), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-11, rtol=0)


def test_ragged_and_repeated_edges(problem: Maker) -> None:
    """Pairs with very different numbers of edges, some edges twice, and edges from a frame into itself."""
    p = problem(noise=0.5)
    generator = torch.Generator().manual_seed(0)
    some = torch.randperm(len(p.ii), generator=generator)[:25]
    p = p.edges(torch.cat((some, some[:5], torch.where((p.ii == 1) & (p.jj == 2))[0])))
    own = torch.arange(3)
    p = replace(
        p, ii=torch.cat((p.ii, own)), jj=torch.cat((p.jj, own)), kk=torch.cat((p.kk, own * 6)),
        targets=torch.cat((p.targets, p.patches[:, own * 6, :2, 1, 1] + 1), 1),
        weights=torch.cat((p.weights, p.weights[:, :3]), 1),
    )  # fmt: skip
    expected = bundle_adjust_reference(*p.arguments())
    for found, theirs in zip(p.solve(), (expected.poses_cw, expected.patches), strict=True):
        torch.testing.assert_close(found, theirs, atol=1e-9, rtol=1e-9)


def test_a_batch_is_a_loop(problem: Maker) -> None:
    p = problem(batch=3, noise=0.5)
    whole = p.solve()
    for b in range(3):
        for found, expected in zip(p.element(b).solve(), whole, strict=True):
            torch.testing.assert_close(found, expected[b : b + 1], atol=1e-12, rtol=0)


def test_chunks_change_nothing(problem: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for chunk in (edges_module.CHUNK, 10):
        monkeypatch.setattr(edges_module, "CHUNK", chunk)
        p = problem(noise=0.5).leaves()
        plan = plan_edges(p.ii, p.jj, p.kk, 4, 24)
        assert (len(plan.chunks()) > 1) == (chunk == 10)
        result = p.adjust(plan=plan)
        poses, patches = result.poses_cw, result.patches
        (poses.square().sum() + patches.square().sum()).backward()
        results.append((poses, patches, p.targets.grad, p.weights.grad, p.poses.grad, p.patches.grad))
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, atol=1e-8, rtol=1e-8)


def test_determinism(problem: Maker) -> None:
    a, b = (problem(noise=0.5, dtype=torch.float32).solve() for _ in range(2))
    assert torch.equal(a[0], b[0]) and torch.equal(a[1], b[1])


def test_outliers_and_points_out_of_bounds_do_not_count(problem: Maker) -> None:
    p = problem()
    wild = p.targets.clone()
    wild[:, ::5] += 500
    clean = p.edges(torch.arange(len(p.ii)) % 5 != 0)
    for found, expected in zip(replace(p, targets=wild).solve(), clean.solve(), strict=True):
        torch.testing.assert_close(found, expected, atol=1e-10, rtol=0)
    p = p.shifted(200.0)  # every projection is more than 64 px outside of a small map
    nothing = p.solve(bounds=(40, 30))
    torch.testing.assert_close(nothing[0], p.poses)
    torch.testing.assert_close(nothing[1], p.patches)


def test_depth_prior(problem: Maker) -> None:
    p = problem(noise=0.5)
    goal = torch.full((2, 24), 0.7, dtype=torch.float64)
    patches = p.adjust((DepthPrior(goal, torch.tensor(1e9, dtype=torch.float64)),)).patches
    torch.testing.assert_close(patches[:, :, 2, 1, 1], goal, atol=1e-5, rtol=0)


def test_pose_prior(problem: Maker) -> None:
    p = problem(noise=0.5)
    weight = torch.zeros(2, 4, 6, dtype=torch.float64)
    weight[:, 2] = 1e9
    poses = p.adjust((PosePrior(p.true_poses, weight),), iterations=3).poses_cw
    torch.testing.assert_close(se3.matrix(poses[:, 2]), se3.matrix(p.true_poses[:, 2]), atol=1e-5, rtol=0)
    free, _ = p.solve(iterations=3)
    assert (free[:, 2] - p.true_poses[:, 2]).abs().max() > 1e-4


def test_inverse_depths_stay_in_range(problem: Maker) -> None:
    p = problem(noise=20.0)
    _, patches = p.solve(depth_range=(0.5, 0.8))
    assert patches[:, :, 2].min() == 0.5 and patches[:, :, 2].max() == 0.8


@pytest.mark.parametrize("name", ["poses", "patches", "intrinsics", "targets", "weights", "jj", "kk"])
def test_shapes_that_do_not_belong_together(problem: Maker, name: str) -> None:
    p = problem()
    with pytest.raises(DvoError, match="shape"):
        replace(p, **{name: getattr(p, name)[:1]}).solve()


def test_half_precision_and_autocast_are_left_at_the_door(problem: Maker) -> None:
    p = problem(dtype=torch.float32)
    half = replace(p, targets=p.targets.bfloat16(), weights=p.weights.bfloat16())
    assert half.solve()[0].dtype == torch.float32
    expected = p.solve()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = p.solve()
    assert torch.equal(found[0], expected[0]) and torch.equal(found[1], expected[1])
    assert replace(p, poses=p.poses.half()).solve()[0].dtype == torch.float32
