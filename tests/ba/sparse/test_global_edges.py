"""Compiled normal equations of a graph against their plain twins."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.ba.kernels import Kernel
from dvo.ba.sparse import schur_pattern
from dvo.ba.sparse.block_matrix import BlockMatrix
from dvo.ba.sparse.global_adjust import GlobalBAOptions, SparseProblem, adjust_sparse
from dvo.ba.sparse.levenberg import LMOptions
from dvo.ba.sparse.small_problem import MOST_FRAMES
from dvo.core.kernels import available
from tests.support.random_edges import KERNELS, both, graph

NAMES = ("h_pp", "h_pl", "h_ll", "g_p", "g_l")


def close(found, wanted, tolerance):
    """Relative to the largest value, or to a squared focal length where all cancel."""
    scale = max(float(wanted.abs().max()), 1600.0) if wanted.numel() else 1.0
    torch.testing.assert_close(found / scale, wanted / scale, atol=tolerance, rtol=tolerance)


GRAPHS = dict(
    seed=st.integers(0, 999), frames=st.integers(1, 9), per_frame=st.integers(1, 10), edges=st.integers(1, 200),
    kernel=st.sampled_from(KERNELS), double=st.booleans(), held=st.integers(0, 511),
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(**GRAPHS)
def test_sums_over_edges_are_those_of_the_twin(seed, frames, per_frame, edges, kernel, double, held):
    problem = graph(seed, frames, per_frame, edges, torch.float64 if double else torch.float32)
    fixed = [bool(held >> k & 1) for k in range(frames)]
    options = GlobalBAOptions(fixed, kernel, 16.0)

    def sums():
        sparse = SparseProblem(problem, options)
        return sparse, sparse.linearise(sparse.state), sparse.cost(sparse.state), sparse.inliers(sparse.state)

    (a, found, cost, inliers), (b, wanted, twin_cost, twin_inliers) = both(sums)
    for name in ("keys", "first", "frame", "patch"):
        assert torch.equal(getattr(a.pattern, name), getattr(b.pattern, name))
    assert all(torch.equal(place, getattr(b.at, name)) for name, place in vars(a.at).items())
    assert torch.equal(a.pattern.reduced.keys, b.pattern.reduced.keys)
    tolerance = 1e-11 if double else 2e-4
    assert torch.equal(inliers, twin_inliers)
    assert cost == pytest.approx(twin_cost, rel=tolerance)
    for name in NAMES:
        close(getattr(found, name), getattr(wanted, name), tolerance)


@settings(max_examples=40, deadline=None)
@given(**GRAPHS)
def test_the_reduced_system_and_its_products_are_those_of_the_twin(
    seed, frames, per_frame, edges, kernel, double, held
):
    problem = graph(seed, frames, per_frame, edges, torch.float64 if double else torch.float32)
    sparse = SparseProblem(problem, GlobalBAOptions([bool(held >> k & 1) for k in range(frames)], kernel, 16.0))
    system = sparse.linearise(sparse.state)
    q = torch.where(system.h_ll > 0, 1 / (1 + system.h_ll), 0.0)
    x = torch.randn(system.g_p.shape, generator=torch.Generator().manual_seed(seed)).to(q)
    poses = BlockMatrix(system.pattern.h_pp, system.h_pp)

    def products():
        return system.reduce(poses, q).dense(), system._to_poses(q), system._to_depths(x)

    if sparse.parts.count:
        for found, wanted in zip(*both(products), strict=True):
            close(found, wanted, 1e-11 if double else 2e-4)


@pytest.mark.parametrize("marks", [schur_pattern.MARKS, 0])
def test_steps_and_results_are_those_of_the_twin(monkeypatch, marks):
    monkeypatch.setattr(schur_pattern, "MARKS", marks)
    problem = graph(3, MOST_FRAMES + 1, 10, 1500)  # few frames are not for these kernels
    problem = problem.with_values(targets=torch.where(problem.targets.isfinite(), problem.targets, 0.0))
    options = GlobalBAOptions(1, Kernel("huber", 0.5), 64.0, solver=LMOptions(max_iterations=6))
    found, wanted = both(lambda: adjust_sparse(problem, options))
    assert found.iterations == wanted.iterations and found.cost == pytest.approx(wanted.cost, rel=1e-9)
    torch.testing.assert_close(found.poses_cw, wanted.poses_cw, atol=1e-7, rtol=1e-7)
    for before, again in zip((found, wanted), both(lambda: adjust_sparse(problem, options)), strict=True):
        assert torch.equal(again.poses_cw, before.poses_cw) and torch.equal(again.patches, before.patches)


def test_gradients_and_other_types_are_for_the_twin():
    problem = graph(1, 4, 3, 40)
    edges = SparseProblem(problem, GlobalBAOptions()).edges
    values = problem.poses_cw, problem.inverse_depths
    assert edges._compiled(*values) == available()
    assert not edges._compiled(values[0].clone().requires_grad_(), values[1])
    assert not replace(edges, weight=edges.weight.float())._compiled(*values)


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(**GRAPHS)
def test_poses_and_depths_move_as_by_the_twin(seed, frames, per_frame, edges, kernel, double, held):
    problem = graph(seed, frames, per_frame, edges, torch.float64 if double else torch.float32)
    sparse = SparseProblem(problem, GlobalBAOptions([bool(held >> k & 1) for k in range(frames)], kernel, 16.0))
    g = torch.Generator().manual_seed(seed)
    step = torch.randn(sparse.parts.count, 6, generator=g), torch.randn(len(problem.patches), generator=g)
    found, wanted = both(lambda: sparse.values(sparse.moved(sparse.state, tuple(x.to(problem.poses_cw) for x in step))))
    for one, twin in zip(found, wanted, strict=True):
        close(one, twin, 1e-11 if double else 2e-4)


def test_solutions_of_one_plan_share_what_does_not_change():
    problem = graph(4, MOST_FRAMES + 1, 10, 1500)
    problem = problem.with_values(targets=torch.where(problem.targets.isfinite(), problem.targets, 0.0))
    planned = problem.planned()
    for fixed in (1, 3, 1):
        options = GlobalBAOptions(fixed, Kernel("huber", 0.5), 64.0, solver=LMOptions(max_iterations=3))
        assert torch.equal(adjust_sparse(planned, options).poses_cw, adjust_sparse(problem, options).poses_cw)
    assert planned.plan is not None and len(planned.plan.layouts) == 2
    first, second = (SparseProblem(planned, options) for _ in range(2))
    assert first.pattern is second.pattern
