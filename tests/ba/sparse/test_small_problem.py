"""Graphs of few frames, solved by dense kernels, against the block-sparse twin."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.ba.blocks import vector_block
from dvo.ba.kernels import Kernel
from dvo.ba.sparse.global_adjust import GlobalBAOptions, adjust_sparse
from dvo.ba.sparse.levenberg import LMOptions
from dvo.ba.sparse.small_problem import MOST_FRAMES, is_small
from dvo.core.errors import DvoError
from dvo.core.kernels import available
from tests.ba.sparse.test_global_edges import KERNELS, both, graph


def apart(problem):
    """Without edges from a frame into itself: where a patch has no other, its depth moves by errors of rounding."""
    return problem.edges(problem.ii != problem.jj)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 999), frames=st.integers(2, 9), per_frame=st.integers(1, 10), edges=st.integers(20, 300),
    kernel=st.sampled_from(KERNELS), held=st.integers(0, 511), depths=st.booleans(),
    damping=st.sampled_from([1e-4, 1.0]),
)  # fmt: skip
def test_a_step_is_that_of_the_twin(seed, frames, per_frame, edges, kernel, held, depths, damping):
    problem = apart(graph(seed, frames, per_frame, edges))
    fixed = [bool(held >> k & 1) for k in range(frames)]
    solver = LMOptions(max_iterations=1, damping=damping)
    options = GlobalBAOptions(fixed, kernel, 16.0, (0.1, 2.0), move_depths=depths, solver=solver)
    assert is_small(problem) == available()
    found, wanted = both(lambda: adjust_sparse(problem, options))
    assert torch.equal(found.inliers, wanted.inliers) and found.stored_blocks == wanted.stored_blocks
    assert (found.iterations, found.converged) == (wanted.iterations, wanted.converged)
    assert found.initial_cost == pytest.approx(wanted.initial_cost, rel=1e-11)
    assert found.cost == pytest.approx(wanted.cost, rel=1e-7)
    torch.testing.assert_close(found.poses_cw, wanted.poses_cw, atol=1e-7, rtol=1e-7)
    torch.testing.assert_close(found.patches, wanted.patches, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_solution_is_that_of_the_twin(kernel):
    problem = apart(graph(3, 8, 10, 600))
    problem = problem.with_values(targets=torch.where(problem.targets.isfinite(), problem.targets, 0.0))
    options = GlobalBAOptions(1, kernel, 64.0, solver=LMOptions(max_iterations=8))
    found, wanted = both(lambda: adjust_sparse(problem, options))
    assert found.cost == pytest.approx(wanted.cost, rel=1e-9) and found.cost < found.initial_cost
    torch.testing.assert_close(found.poses_cw, wanted.poses_cw, atol=1e-7, rtol=1e-7)
    again = adjust_sparse(problem, options)
    assert torch.equal(again.poses_cw, found.poses_cw) and torch.equal(again.patches, found.patches)


def test_other_graphs_are_not_small():
    problem = graph(0, 4, 3, 40)
    assert is_small(problem) == available()
    assert not is_small(graph(0, MOST_FRAMES + 1, 3, 40))
    assert not is_small(graph(0, 4, 3, 40, torch.float32))
    assert not is_small(problem.with_values(blocks={"speed": vector_block(torch.zeros(1, 1, 3))}))


def test_the_given_values_stay_as_they_are():
    problem = apart(graph(1, 4, 3, 40))
    before = problem.poses_cw.clone(), problem.patches.clone()
    adjust_sparse(problem, GlobalBAOptions(1, Kernel("huber", 0.5)))
    assert torch.equal(problem.poses_cw, before[0]) and torch.equal(problem.patches, before[1])


def test_a_patch_of_two_frames_is_refused():
    problem = graph(1, 4, 3, 40)
    with pytest.raises(DvoError, match="two source frames"):
        adjust_sparse(problem.with_values(ii=problem.ii.flip(0)), GlobalBAOptions())
