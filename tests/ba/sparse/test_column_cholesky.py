"""Compiled Cholesky factorisation by columns against the dense matrix and its twin."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.ba.sparse import column_cholesky
from dvo.ba.sparse.block_matrix import BlockMatrix, make_pattern, solve_blocks
from dvo.ba.sparse.cholesky import best_plan, solve_cholesky
from dvo.ba.sparse.column_cholesky import plan_columns, solve_columns
from dvo.core.kernels import VARIABLE
from tests.support.block_systems import PAIRS, system


@pytest.mark.long
@settings(deadline=None)
@given(st.integers(1, 31), PAIRS, st.booleans(), st.integers(0, 99))
def test_the_solution_is_that_of_the_dense_matrix_and_of_the_twin(size, pairs, double, seed):
    rows, columns, blocks, dense, rhs = system(size, pairs, 6, seed)
    dtype, tolerance = (torch.float64, 1e-10) if double else (torch.float32, 1e-4)
    plan = plan_columns(size, rows, columns)
    found = solve_columns(plan, blocks.to(dtype), rhs.to(dtype))
    expected = torch.linalg.solve(dense, rhs.view(-1)).view(size, 6).to(dtype)
    torch.testing.assert_close(found, expected, atol=tolerance, rtol=tolerance)
    twin = solve_cholesky(best_plan(size, rows, columns, 6), blocks, rhs)
    torch.testing.assert_close(found, twin.to(dtype), atol=tolerance, rtol=tolerance)
    assert sorted(plan.rank.tolist()) == list(range(size))


@pytest.mark.parametrize("loops", [0, 9])
def test_a_chain_has_a_factor_of_its_own_size(loops):
    """Columns are eliminated in an order of little fill, whatever loops there are."""
    pairs = [(i + k, i) for k in (1, 2, 3) for i in range(400 - k)] + [(40 * k, 7) for k in range(1, loops + 1)]
    ends = torch.tensor(pairs).T
    pattern = make_pattern(400, *ends)
    plan = plan_columns(400, pattern.rows, pattern.columns)
    assert len(plan.under) <= pattern.count + 60 * loops


def test_a_matrix_that_is_not_positive_definite_gives_nan():
    rows, columns, blocks, _, rhs = system(5, [(1, 0)], 6, 0)
    assert solve_columns(plan_columns(5, rows, columns), -blocks, rhs).isnan().all()
    broken = blocks.clone()
    broken[0] = torch.nan
    assert solve_columns(plan_columns(5, rows, columns), broken, rhs).isnan().all()


def test_a_large_factor_has_no_plan(monkeypatch):
    rows, columns, *_ = system(20, [(i, j) for i in range(20) for j in range(20)], 1, 0)
    assert plan_columns(20, rows, columns) is not None and plan_columns(0, rows[:0], columns[:0]) is None
    monkeypatch.setattr(column_cholesky, "MAX_BLOCKS", 209)
    assert plan_columns(20, rows, columns) is None
    monkeypatch.setattr(column_cholesky, "MAX_BLOCKS", 210)
    assert plan_columns(20, rows, columns) is not None
    monkeypatch.setattr(column_cholesky, "MAX_SIZE", 19)
    assert plan_columns(20, rows, columns) is None


@pytest.mark.parametrize("dim", [1, 6, 7])
def test_the_automatic_choice_takes_blocks_of_any_size(dim, monkeypatch):
    rows, columns, blocks, dense, rhs = system(9, [(3, 1), (8, 2), (7, 6)], dim, 4)
    pattern = make_pattern(9, rows, columns)
    at = pattern.find(rows, columns)
    ordered = torch.empty_like(blocks)
    ordered[at] = blocks
    expected = torch.linalg.solve(dense, rhs.view(-1)).view(9, dim)
    for choice in ("numba", "torch"):
        monkeypatch.setenv(VARIABLE, choice)
        several = torch.stack([rhs, 2 * rhs], -1)
        found = solve_blocks(BlockMatrix(pattern, ordered), several)
        torch.testing.assert_close(found, torch.stack([expected, 2 * expected], -1), atol=1e-12, rtol=1e-10)
