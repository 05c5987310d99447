"""Sparse Cholesky factorisation by rounds of tiles."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvo.ba.sparse.cholesky import TILE_SIZES, best_plan, plan_tiles, solve_cholesky
from tests.support.block_systems import PAIRS, system


@given(st.integers(1, 31), PAIRS, st.sampled_from([1, 6, 7]), st.sampled_from(TILE_SIZES), st.integers(0, 99))
def test_the_solution_is_that_of_the_dense_matrix(size, pairs, dim, width, seed):
    rows, columns, blocks, dense, rhs = system(size, pairs, dim, seed)
    plan = plan_tiles(size, rows, columns, width)
    found = solve_cholesky(plan, blocks, rhs)
    torch.testing.assert_close(found, torch.linalg.solve(dense, rhs.view(-1)).view(size, dim), atol=1e-12, rtol=1e-10)


@given(st.integers(1, 31), PAIRS, st.sampled_from(TILE_SIZES))
def test_tiles_of_a_round_are_no_neighbours_and_each_is_eliminated_once(size, pairs, width):
    rows, columns, *_ = system(size, pairs, 1, 0)
    plan = plan_tiles(size, rows, columns, width)
    order = [tile for step in plan.rounds for tile in step.tile.tolist()]
    assert sorted(order) == list(range(-(-size // width)))
    done = set()
    for step in plan.rounds:
        now = set(step.tile.tolist())
        below = {tile for row in step.under.tolist() for tile in row}
        assert not below & (now | done)
        done |= now
        for parts, index in ((step.turns, step.goes), (step.rows_in_turn, step.under)):
            flat = index.view(-1)
            assert all(flat[part].unique().numel() == len(part) for part in parts)
            assert sorted(int(k) for part in parts for k in part) == list(range(flat.numel()))


@pytest.mark.slow
def test_many_rows_below_a_tile_and_long_chains():
    """An arrow, whose last rows are below all others, and a chain with a few loops."""
    arrow = [(i, j) for i in range(100, 112) for j in range(112)]
    chain = [(i + 1, i) for i in range(999)] + [(100 * k, 0) for k in range(1, 10)]
    for size, pairs in ((112, arrow), (1000, chain)):
        rows, columns, blocks, dense, rhs = system(size, [], 6, 1)
        pairs = sorted({(i, j) for i, j in pairs if i > j})
        rows = torch.cat([rows, torch.tensor([i for i, _ in pairs])])
        columns = torch.cat([columns, torch.tensor([j for _, j in pairs])])
        off = 0.01 * torch.randn(len(pairs), 6, 6, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        blocks = torch.cat([blocks, off])
        for (i, j), block in zip(pairs, off, strict=True):
            dense[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] = block
            dense[6 * j : 6 * j + 6, 6 * i : 6 * i + 6] = block.T
        expected = torch.linalg.solve(dense, rhs.view(-1)).view(size, 6)
        for width in (1, 16):
            plan = plan_tiles(size, rows, columns, width)
            torch.testing.assert_close(solve_cholesky(plan, blocks, rhs), expected, atol=1e-12, rtol=1e-9)
        assert len(plan_tiles(size, rows, columns, 1).rounds) < size / 4  # most are eliminated together


def test_a_matrix_that_is_not_positive_definite_gives_nan():
    rows, columns, blocks, _, rhs = system(5, [(1, 0)], 6, 0)
    assert solve_cholesky(best_plan(5, rows, columns, 6), -blocks, rhs).isnan().all()


@pytest.mark.parametrize(("limit", "fits"), [(10.0, False), (1e9, True)])
def test_planning_ends_at_the_limit(limit, fits):
    full = [(i, j) for i in range(20) for j in range(20)]
    rows, columns, *_ = system(20, full, 1, 0)
    assert (plan_tiles(20, rows, columns, 1, limit) is not None) == fits
