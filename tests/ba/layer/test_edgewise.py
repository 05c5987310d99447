"""Compiled Gauss-Newton steps are those of the twin, which is run in double precision here."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from dvo.ba.blocks import vector_block
from dvo.ba.factors import DepthDamping, DepthPrior, PosePrior, RelativePose
from dvo.ba.kernels import Kernel
from dvo.ba.layer.edgewise import EdgewiseReprojection, measured_edges
from dvo.ba.layer.edgewise_kernels import solve_reduced
from dvo.ba.layer.layer import BADamping, BAOptions, BAResult, bundle_adjust, make_problem
from dvo.ba.layer.schur import eliminate
from dvo.ba.layer.step import normal_equations
from dvo.ba.limits import LARGEST
from dvo.ba.patch_problem import PatchProblem
from dvo.core.kernels import CHOICES, VARIABLE
from dvo.geometry import se3

Maker = Callable[..., Any]

OPTIONS: dict[str, list[Any]] = {
    "fixed": [0, 1, 2, 4, torch.tensor([False, True, False, True])],
    "iterations": [0, 1, 2, 3],
    "damping": [BADamping(), BADamping(1.0, 0.3, 0.2), BADamping(1e-3, 0.0, 0.0)],
    "structure_only": [False, False, False, True],
    "motion_only": [False, False, False, True],
    "bounds": [None, (20, 15), (1, 1)],
    "max_residual": [128.0, 2.0, math.inf],
    "depth_range": [(1e-3, 10.0), (0.4, 0.9)],
    "kernel": [Kernel(), Kernel("huber", 0.3), Kernel("cauchy", 0.3)],
}
BAD = (math.nan, math.inf, -math.inf, 1e9, -1e9, 1e7)


@pytest.fixture(autouse=True)
def with_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)


def uneven(problem: Maker, seed: int, batch: int, edges: int) -> Any:
    """Edges in any order, some twice, some from a frame into itself; some points are behind a camera, and some weights
    and targets are no measurements."""
    p = problem(batch=batch, noise=0.5, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    some = torch.randint(len(p.ii), (edges,), generator=generator)
    p = p.edges(some)
    own = torch.arange(min(3, edges))
    jj, poses, targets, weights = p.jj.clone(), p.poses.clone(), p.targets.clone(), p.weights.clone()
    jj[own] = p.ii[own]
    if seed % 3 == 0:  # turned around, or far ahead of the others
        step = torch.tensor([0, 0, 0, 0, math.pi - 0.3, 0] if seed % 2 else [0, 0, -2.0, 0, 0, 0], dtype=poses.dtype)
        poses[:, 2] = se3.retract(poses[:, 2], step)
    for x in (targets, weights):
        if edges and seed % 2:
            at = torch.randint(edges, (3,), generator=generator)
            x[-1, at, seed % 4 // 2] = BAD[seed % len(BAD)] if x is targets else abs(BAD[seed % 3])
    weights[:, ::7] = 0.0
    p = replace(p, jj=jj, poses=poses, targets=targets, weights=weights)
    floats = ("poses", "patches", "intrinsics", "targets", "weights")
    return replace(p, **{name: getattr(p, name).float() for name in floats})


def solved(p: Any, options: BAOptions, dtype: torch.dtype, **more: Any) -> BAResult:
    poses, *floats = (x.to(dtype) for x in p.arguments()[:5])
    if dtype == torch.float64:  # what is rounding in float32 is a scale of the rotation there
        poses = se3.normalise(poses)
    return bundle_adjust(poses, *floats, p.ii, p.jj, p.kk, options, **more)


def assert_equal(found: BAResult, expected: BAResult) -> None:
    for name in ("poses_cw", "patches"):
        x, y = getattr(found, name), getattr(expected, name)
        assert x.dtype == torch.float32
        torch.testing.assert_close(x.double(), y, atol=2e-5, rtol=2e-5)
    assert found.cost is not None and expected.cost is not None and found.inliers is not None
    torch.testing.assert_close(found.cost.double(), expected.cost, atol=1e-4, rtol=1e-3)
    assert expected.inliers is not None and torch.equal(found.inliers, expected.inliers)


@pytest.mark.long
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.integers(0, 10_000), st.integers(1, 2), st.sampled_from([0, 1, 5, 40, 90]),
    st.fixed_dictionaries({name: st.sampled_from(values) for name, values in OPTIONS.items()}),
)  # fmt: skip
def test_steps_are_those_of_the_twin(
    problem: Maker, seed: int, batch: int, edges: int, changes: dict[str, Any]
) -> None:
    p = uneven(problem, seed, batch, edges)
    options = BAOptions(**changes, report=True)
    made = make_problem(PatchProblem(*p.arguments()), options)
    assert isinstance(made.factors[0], EdgewiseReprojection)
    found = solved(p, options, torch.float32)
    assert_equal(found, solved(p, options, torch.float64))
    at_once = solved(p, replace(options, report=False), torch.float32)  # as the window of a tracker
    assert torch.equal(at_once.poses_cw, found.poses_cw) and torch.equal(at_once.patches, found.patches)


@pytest.mark.parametrize("changes", [{}, {"structure_only": True}, {"motion_only": True}, {"fixed": 0}], ids=str)
def test_with_further_factors_and_blocks(problem: Maker, changes: dict[str, Any]) -> None:
    for seed in range(3):
        p = uneven(problem, seed, 2, 60)
        results = []
        for dtype in (torch.float32, torch.float64):
            like = {"dtype": dtype}
            ends = torch.tensor([0, 1]), torch.tensor([1, 2])
            factors = (
                DepthPrior(torch.full((1, 24), 0.5, **like), torch.tensor(2.0, **like)),
                DepthDamping(torch.tensor(0.5, **like)),
                PosePrior(se3.identity(1, 4, **like), torch.full((1, 4, 6), 3.0, **like)),
                RelativePose(se3.identity(1, 2, **like), torch.ones(1, 2, 6, **like), *ends),
            )
            blocks = {"speed": vector_block(torch.ones(2, 3, 3, **like))}
            results.append(solved(p, BAOptions(report=True, **changes), dtype, factors=factors, blocks=blocks))
        assert_equal(*results)
        assert torch.equal(results[0].blocks["speed"], torch.ones(2, 3, 3))


def test_equations_are_those_of_the_twin(problem: Maker) -> None:
    p = uneven(problem, 3, 2, 80)
    options = BAOptions(kernel=Kernel("cauchy", 0.3), bounds=(40, 30))
    made = make_problem(PatchProblem(*p.arguments()), options)
    found, _ = normal_equations(made, 0.1)
    exact = made.with_tensors([x.double() for x in made.tensors()])
    expected, _ = normal_equations(exact, 0.1)
    for name in ("h_pp", "h_pl", "h_ll", "g_p", "g_l"):
        x, y = getattr(found, name), getattr(expected, name)
        assert float(y.abs().max()) > 1e-3
        torch.testing.assert_close(x, y, atol=1e-6 * float(y.abs().max()), rtol=1e-5)


def random_system(seed: int, size: int, count: int) -> list[np.ndarray]:
    random = np.random.default_rng(seed)
    root = random.normal(size=(size, size + 4))
    h_lp = random.normal(size=(count, size)) * (random.random((count, size)) < 0.7)
    h_ll = np.where(random.random(count) < 0.2, 0.0, 50 + random.random(count))
    return [root @ root.T + np.eye(size), h_lp, h_ll, random.normal(size=size), random.normal(size=count)]


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 10_000), st.sampled_from([0, 1, 6, 13]), st.sampled_from([0, 1, 4, 11]),
    st.sampled_from(["plain", "indefinite", "hopeless", "infinite", "nan", "long", "long depths"]),
)  # fmt: skip
def test_the_solution_is_that_of_the_twin(seed: int, size: int, count: int, kind: str) -> None:
    h_pp, h_lp, h_ll, g_p, g_l = random_system(seed, size, count)
    longest = np.full(size, LARGEST)
    if kind == "indefinite" and size:  # damping of a thousandth of the largest entry makes it regular
        h_pp = np.diag(np.linspace(100.0, 1.0, size))
        h_lp[:] = 0.0
        h_pp[-1, -1] = -0.02 * h_pp.max()
    elif kind == "hopeless":
        h_pp = -h_pp
    elif kind in ("infinite", "nan") and size:
        h_pp[-1, 0] = h_pp[0, -1] = math.inf if kind == "infinite" else math.nan
    elif kind == "long":
        longest[:] = 1e-3
    elif kind == "long depths" and count:
        h_ll[0], g_l[0], h_lp[0] = 1e-9, 1.0, 0.0
    tensors = [torch.from_numpy(x.copy())[None] for x in (h_pp, h_lp, h_ll, g_p, g_l)]
    solver = eliminate(tensors[0], tensors[1].mT[..., None], tensors[2][..., None, None], 0.1, 1e-4)
    dp, dl = (x[0].flatten() for x in solver.solve(tensors[3], tensors[4][..., None]))
    short = bool((dp.abs() <= torch.from_numpy(longest)).all())
    dp, dl = dp * short, torch.where(dl.abs() <= LARGEST, dl, 0.0) * short
    found = np.full(size, math.nan), np.full(count, math.nan)
    solve_reduced(h_pp.copy(), h_lp, h_ll, g_p, g_l, 0.1, 1e-4, longest, *found)
    torch.testing.assert_close(torch.from_numpy(found[0]), dp, atol=1e-10, rtol=1e-8)
    torch.testing.assert_close(torch.from_numpy(found[1]), dl, atol=1e-10, rtol=1e-8)
    if kind in ("hopeless", "infinite", "nan") and size > 1:
        assert not found[0].any()
    if kind == "indefinite" and size > 1:
        assert found[0].any()


def gradients(p: Any, options: BAOptions, dtype: torch.dtype, seed: int) -> list[torch.Tensor]:
    """By tangents of the poses, patches, intrinsics, targets and weights, of random numbers times the results."""
    generator = torch.Generator().manual_seed(seed)
    poses, *floats = (x.detach().to(dtype) for x in p.arguments()[:5])
    leaves = [torch.zeros_like(poses[..., :6]).requires_grad_(), *(x.clone().requires_grad_() for x in floats)]
    poses = se3.compose(se3.exp(leaves[0]), se3.normalise(poses))
    result = bundle_adjust(poses, *leaves[1:], p.ii, p.jj, p.kk, options)
    parts = result.poses_cw, result.patches
    total = sum((x * torch.randn(x.shape, generator=generator).to(dtype)).sum() for x in parts)
    assert isinstance(total, torch.Tensor)
    found = torch.autograd.grad(total, leaves, allow_unused=True)
    return [torch.zeros_like(x) if g is None else g for x, g in zip(leaves, found, strict=True)]


@pytest.mark.long
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.integers(0, 10_000), st.integers(1, 2), st.sampled_from([0, 1, 5, 40, 90]),
    st.fixed_dictionaries({name: st.sampled_from(values) for name, values in OPTIONS.items()}),
)  # fmt: skip
def test_gradients_are_those_of_the_twin(
    problem: Maker, seed: int, batch: int, edges: int, changes: dict[str, Any]
) -> None:
    """As near to those in double precision as the gradients of the twin in single precision are."""
    options = replace(BAOptions(**changes), damping=replace(changes["damping"], pose=1.0))
    p = uneven(problem, seed, batch, edges)
    ours, exact = (gradients(p, options, dtype, seed) for dtype in (torch.float32, torch.float64))
    # Steps that run away from what few edges tell have derivatives in double precision only.
    assume(all(float(y.abs().max()) < 1e5 for y in exact if y.numel()))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DVO_KERNELS", "torch")
        twins = gradients(p, options, torch.float32, seed)
    for x, y, z in zip(ours, exact, twins, strict=True):
        assert x.dtype == torch.float32
        if y.numel():
            scale, away = float(y.abs().max()), float((z - y).abs().max())
            assert float((x - y).abs().max()) <= 4 * away + 1e-3 * scale + 1e-7


def test_what_has_no_kernel_is_left_to_the_twin(problem: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    p = uneven(problem, 1, 1, 60)
    given = PatchProblem(*p.arguments())
    leaf = given.with_values(weights=given.weights.clone().requires_grad_())
    assert isinstance(make_problem(leaf).factors[0], EdgewiseReprojection)
    prior = DepthPrior(torch.ones(1, 24), torch.ones(1, 24))
    assert isinstance(make_problem(given.with_values(factors=(prior,))).factors[0], EdgewiseReprojection)
    assert not isinstance(make_problem(leaf.with_values(factors=(prior,))).factors[0], EdgewiseReprojection)
    prior = replace(prior, weight=prior.weight.clone().requires_grad_())
    assert not isinstance(make_problem(given.with_values(factors=(prior,))).factors[0], EdgewiseReprojection)
    with torch.no_grad():
        assert isinstance(make_problem(leaf).factors[0], EdgewiseReprojection)
    monkeypatch.setenv(VARIABLE, "torch")
    assert not isinstance(make_problem(given).factors[0], EdgewiseReprojection)


def test_a_gradient_is_differentiated_again_as_by_the_twin(problem: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    p = uneven(problem, 3, 2, 80)
    options, second = BAOptions(damping=BADamping(pose=1.0)), []
    for choice in CHOICES:
        monkeypatch.setenv(VARIABLE, choice)
        weights = p.weights.clone().requires_grad_()
        result = bundle_adjust(p.poses, p.patches, p.intrinsics, p.targets, weights, p.ii, p.jj, p.kk, options)
        (first,) = torch.autograd.grad(result.poses_cw.square().sum(), weights, create_graph=True)
        second += torch.autograd.grad(first.square().sum(), weights)
    assert float(second[1].abs().max()) > 0
    torch.testing.assert_close(second[0], second[1], atol=1e-3 * float(second[1].abs().max()), rtol=1e-2)


@pytest.mark.parametrize("name", ["targets", "ii", "kk"])
def test_what_is_changed_before_the_backward_pass_is_noticed(problem: Maker, name: str) -> None:
    p = uneven(problem, 1, 1, 60).leaves()
    p = replace(p, **{name: getattr(p, name).detach().clone()})
    total = p.adjust().poses_cw.sum()
    getattr(p, name)[..., 0] = 0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        total.backward()


def test_a_gradient_that_is_none_is_not_hidden(problem: Maker) -> None:
    p = uneven(problem, 1, 1, 60).leaves()
    (p.adjust().patches.sum() * math.nan).backward()
    assert p.targets.grad is not None and p.targets.grad.isnan().all()


@pytest.mark.parametrize(("name", "value"), [("jj", 4), ("ii", -1), ("kk", 24)])
def test_an_index_out_of_range_reads_nothing_beside_the_tensors(problem: Maker, name: str, value: int) -> None:
    p = uneven(problem, 1, 1, 60)
    index = getattr(p, name).clone()
    index[5] = value
    edges = {"ii": p.ii, "jj": p.jj, "kk": p.kk}
    floats = p.patches[:, :, :2, 1, 1], p.intrinsics, p.targets, p.weights
    gate: dict[str, Any] = dict(max_residual=128.0, bounds=None, kernel=Kernel())
    assert measured_edges(*floats, **edges, **gate) is not None
    assert measured_edges(*floats, **(edges | {name: index}), **gate) is None
    assert measured_edges(*floats, **(edges | {name: index[:3]}), **gate) is None


def test_the_arguments_do_not_change_and_runs_are_alike(problem: Maker) -> None:
    p = uneven(problem, 5, 2, 90)
    before = [x.clone() for x in p.arguments()]
    first, second = p.adjust(), p.adjust()
    assert torch.equal(first.poses_cw, second.poses_cw) and torch.equal(first.patches, second.patches)
    assert all(torch.equal(x, y) or bool(x.isnan().any()) for x, y in zip(before, p.arguments(), strict=True))
