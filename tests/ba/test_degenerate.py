"""Problems without a solution: something finite comes out, with finite gradients, and no harm is done elsewhere."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from dvo.ba.layer.layer import BADamping, BAOptions, bundle_adjust
from dvo.ba.pose_graph import PoseGraphOptions, optimise_pose_graph
from dvo.ba.sparse.global_adjust import GlobalBAOptions, global_bundle_adjust
from dvo.ba.sparse.levenberg import LMOptions
from dvo.core.errors import DvoError
from dvo.geometry import se3

Maker = Callable[..., Any]
NO_DAMPING = BADamping(pose=0.0, relative=0.0, depth=0.0)


def no_parallax(p: Any) -> Any:
    still = p.poses[:, :1].expand_as(p.poses)
    same = p.intrinsics[:, :1].expand_as(p.intrinsics)
    return replace(p, poses=still, intrinsics=same, targets=p.patches[:, p.kk, :2, 1, 1])


def pure_rotation(p: Any) -> Any:
    turned = p.poses.clone()
    turned[..., :3] = 0
    return replace(p, poses=turned)


def one_edge(p: Any) -> Any:
    return p.edges(torch.tensor([5]))


def no_edge(p: Any) -> Any:
    return p.edges(torch.zeros(0, dtype=torch.long))


def behind(p: Any) -> Any:
    turn = torch.tensor([0, 0, 0, 0, torch.pi, 0], dtype=p.poses.dtype)
    return replace(p, poses=torch.cat((p.poses[:, :2], se3.retract(p.poses[:, 2:], turn)), 1))


def at_the_camera(p: Any) -> Any:
    """The second camera sits where the first sees its points, so that Z passes zero."""
    poses = p.poses.clone()
    poses[:, 1, 2] -= 1 / p.patches[:, 0, 2, 1, 1]
    return replace(p, poses=poses)


def zero_weights(p: Any) -> Any:
    return replace(p, weights=torch.zeros_like(p.weights))


def wild_targets(p: Any) -> Any:
    return replace(p, targets=p.targets * 1e6)


def huge_weights(p: Any) -> Any:
    return replace(p, weights=p.weights * 1e12)


def zero_depths(p: Any) -> Any:
    patches = p.patches.clone()
    patches[:, :, 2] = 0
    return replace(p, patches=patches)


KINDS = [
    no_parallax,
    pure_rotation,
    one_edge,
    no_edge,
    behind,
    at_the_camera,
    zero_weights,
    wild_targets,
    huge_weights,
    zero_depths,
]


@pytest.mark.long
@pytest.mark.parametrize("damping", [BADamping(), NO_DAMPING], ids=["damped", "undamped"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_finite_forward_and_backward(problem: Maker, kind: Any, dtype: torch.dtype, damping: BADamping) -> None:
    for options in ({}, {"fixed": 0}, {"structure_only": True}, {"motion_only": True}):
        p = kind(problem(dtype=dtype)).leaves()
        poses, patches = p.solve(damping=damping, bounds=(40, 30), **options)
        (poses.sum() + patches.sum()).backward()
        assert torch.isfinite(poses).all() and torch.isfinite(patches).all()
        assert patches[:, :, 2].min() >= 0 and patches[:, :, 2].max() <= 10
        torch.testing.assert_close(poses[..., 3:].norm(dim=-1), torch.ones_like(poses[..., 0]))
        for name in ("poses", "patches", "intrinsics", "targets", "weights"):
            gradient = getattr(p, name).grad
            assert gradient is None or torch.isfinite(gradient).all(), name


@pytest.mark.parametrize("kind", [zero_weights, no_edge, wild_targets])
def test_nothing_to_go_by_moves_nothing(problem: Maker, kind: Any) -> None:
    p = kind(problem())
    poses, patches = p.solve()
    torch.testing.assert_close(poses, p.poses)
    torch.testing.assert_close(patches, p.patches)


def test_no_parallax_keeps_the_poses(problem: Maker) -> None:
    p = no_parallax(problem())
    poses, patches = p.solve(iterations=5)
    torch.testing.assert_close(poses, p.poses)
    torch.testing.assert_close(patches, p.patches)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["targets", "weights"])
def test_a_broken_edge_is_left_out(problem: Maker, name: str, value: float) -> None:
    p = problem(noise=0.5)
    broken = getattr(p, name).clone()
    broken[:, 7, 1] = value
    found = replace(p, **{name: broken}).solve()
    expected = p.edges(torch.arange(len(p.ii)) != 7).solve()
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-10, rtol=0)


def test_one_bad_element_of_a_batch_does_not_harm_the_other(problem: Maker) -> None:
    p = problem(noise=0.5)
    good = p.element(0).leaves()
    sum(x.sum() for x in good.solve()).backward()
    weights = p.weights.clone()
    weights[1] = 0
    mixed = replace(p, weights=weights).leaves()
    poses, patches = mixed.solve(damping=BADamping(pose=0.1))
    (poses.sum() + patches.sum()).backward()
    torch.testing.assert_close(poses[:1].detach(), good.solve()[0].detach())
    torch.testing.assert_close(mixed.targets.grad[:1], good.targets.grad, atol=1e-10, rtol=0)
    assert torch.isfinite(mixed.weights.grad).all()


@pytest.mark.parametrize(("edges", "refine"), [(0, "focal"), (1, "all"), (1, "focal")])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_second_derivatives_of_what_nothing_determines_are_finite(edges, refine, dtype):
    """Intrinsics without an edge, or with one from a frame to itself, and no damping."""
    poses = torch.tensor([[[0, 0, 0, 0, 0, 0, 1], [0.1, 0, 0, 0, 0, 0, 1]]], dtype=dtype)
    patches = torch.tensor([17.0, 25, 0.5], dtype=dtype)[None, None, :, None, None]
    intrinsics = torch.tensor([50.0, 50, 20, 15], dtype=dtype).repeat(1, 2, 1)
    targets, weights = (torch.full((1, edges, 2), x, dtype=dtype) for x in (5.0, 0.5))
    leaves = [x.requires_grad_() for x in (poses, patches, intrinsics, targets, weights)]
    index = torch.ones(edges, dtype=torch.long)
    options = BAOptions(
        damping=BADamping(0, 0, 0), iterations=3, refine_intrinsics=refine, motion_only=True, structure_only=not edges
    )
    result = bundle_adjust(*leaves, index, index, 0 * index, options)
    total = result.poses_cw.sum() + result.intrinsics.sum()
    first = torch.autograd.grad(total, leaves, create_graph=True, allow_unused=True)
    sums = [x.sum() for x in first if x is not None and x.requires_grad]
    second = torch.autograd.grad(sums, leaves, allow_unused=True) if sums else ()
    assert all(torch.isfinite(x).all() for x in (*first, *second) if x is not None)


# -- graphs ---------------------------------------------------------------------------------------------------------

SPOILT: dict[str, Callable[[Tensor], Any]] = {
    "nan": lambda x: x.float() * math.nan, "infinite": lambda x: x.half() * math.inf, "huge": lambda x: x * 1e30,
    "list": lambda x: x.tolist(), "none": lambda x: None, "array": lambda x: x.numpy(), "text": lambda x: "poses",
    "complex": lambda x: x.to(torch.complex64), "batch": lambda x: x[None], "number": lambda x: x.flatten()[0],
}  # fmt: skip


def graph_of_poses() -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    poses = se3.exp(0.1 * torch.randn(4, 6, generator=generator))
    ii, jj = torch.tensor([0, 1, 2, 0]), torch.tensor([1, 2, 3, 3])
    return [poses, ii, jj, se3.exp(0.1 * torch.randn(4, 6, generator=generator)), torch.ones(4, 6)]


def graph_of_patches() -> list[Tensor]:
    poses, generator = graph_of_poses()[0], torch.Generator().manual_seed(1)
    patches = torch.rand(3, 3, 1, 1, generator=generator) * torch.tensor([40.0, 30, 1])[:, None, None] + 0.1
    jj, kk = torch.tensor([1, 2, 3, 1, 2, 3]), torch.tensor([0, 0, 1, 1, 2, 2])
    targets = 40 * torch.rand(6, 2, generator=generator)
    intrinsics = torch.tensor([50.0, 50, 20, 15]).repeat(4, 1)
    return [poses, patches, intrinsics, targets, torch.ones(6, 2), 0 * kk, jj, kk]


@pytest.mark.parametrize("how", SPOILT)
def test_a_graph_that_is_none_is_one_error(how):
    """The doors of pose graphs and of whole graphs, argument by argument; a target that is no number does not count."""
    for solve, graph in ((optimise_pose_graph, graph_of_poses), (global_bundle_adjust, graph_of_patches)):
        for place in range(len(graph())):
            given: list[Any] = graph()
            if how == "none" and solve is optimise_pose_graph and place == 4:
                continue
            given[place] = SPOILT[how](given[place])
            if solve is global_bundle_adjust and place == 3 and how in ("nan", "infinite", "huge"):
                result = solve(*given)
                assert torch.isfinite(result.poses_cw).all() and result.cost == 0 and not result.inliers.any()
                continue
            with pytest.raises(DvoError):
                solve(*given)


def test_an_edge_without_a_target_counts_for_nothing_in_a_graph():
    given = graph_of_patches()
    without = global_bundle_adjust(*given[:3], *(x[:5] for x in given[3:]))
    given[3][5] = math.nan
    result = global_bundle_adjust(*given)
    torch.testing.assert_close(result.poses_cw, without.poses_cw, atol=1e-5, rtol=0)
    assert result.inliers.tolist() == [*without.inliers.tolist(), False]


def test_indices_of_a_graph_may_be_of_any_whole_type():
    for solve, graph in ((optimise_pose_graph, graph_of_poses), (global_bundle_adjust, graph_of_patches)):
        given = graph()
        short = [x if x.is_floating_point() else x.to(torch.int32) for x in given]
        assert torch.equal(solve(*given).poses_cw, solve(*short).poses_cw)


@pytest.mark.parametrize(
    "make",
    [
        lambda: LMOptions(max_iterations=-1), lambda: LMOptions(max_iterations=1.5),
        lambda: LMOptions(damping=math.nan), lambda: LMOptions(tolerance=-1.0),
        lambda: LMOptions(solver="dense"), lambda: LMOptions(cg=None),
        lambda: GlobalBAOptions(kernel="huber"), lambda: GlobalBAOptions(max_residual=math.nan),
        lambda: GlobalBAOptions(depth_range=(10, 1)), lambda: GlobalBAOptions(depth_range=3),
        lambda: GlobalBAOptions(move_poses=1), lambda: GlobalBAOptions(solver=None),
        lambda: PoseGraphOptions(kernel=None), lambda: PoseGraphOptions(solver=3),
        lambda: optimise_pose_graph(*graph_of_poses(), {}), lambda: global_bundle_adjust(*graph_of_patches(), {}),
    ],
)  # fmt: skip
def test_options_of_graphs_have_limits(make):
    with pytest.raises(DvoError):
        make()
