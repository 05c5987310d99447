"""Cholesky factorisation by fronts against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.ba.sparse import block_matrix
from dvo.ba.sparse.block_matrix import BlockMatrix, make_pattern, solve_blocks
from dvo.ba.sparse.multifrontal import order_columns, plan_fronts, solve_fronts
from dvo.core.errors import DvoError

pytest.importorskip("scipy")


def random_matrix(size: int, edges: int, dim: int, seed: int) -> BlockMatrix:
    """Positive definite, with blocks at random places."""
    generator = torch.Generator().manual_seed(seed)
    ends = torch.randint(0, size, (2, edges), generator=generator)
    pattern = make_pattern(size, *ends)
    blocks = torch.randn(pattern.count, dim, dim, dtype=torch.float64, generator=generator)
    on = pattern.diagonal
    degree = torch.bincount(torch.cat((pattern.rows, pattern.columns)), minlength=size)
    blocks[on] = blocks[on] + blocks[on].mT + 4 * dim * degree[:, None, None] * torch.eye(dim, dtype=torch.float64)
    return BlockMatrix(pattern, blocks)


@pytest.mark.long
@settings(max_examples=40, deadline=None)
@given(st.integers(1, 60), st.integers(0, 150), st.sampled_from([1, 2, 3, 6, 7]), st.integers(0, 10_000))
def test_the_solution_is_that_of_dense_algebra(size: int, edges: int, dim: int, seed: int):
    matrix = random_matrix(size, edges, dim, seed)
    rhs = torch.randn(size, dim, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    expected = torch.linalg.solve(matrix.dense(), rhs.view(size * dim, 2)).view(size, dim, 2)
    torch.testing.assert_close(solve_blocks(matrix, rhs, "fronts"), expected)
    torch.testing.assert_close(solve_blocks(matrix, rhs[..., 0], "fronts"), expected[..., 0])
    torch.testing.assert_close(solve_blocks(matrix, rhs, "tiles"), expected)


@pytest.mark.parametrize("pieces", [0, 1, 1000])
def test_remainders_are_added_by_pieces_or_at_once(pieces: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("dvo.ba.sparse.multifrontal.MAX_PIECES", pieces)
    monkeypatch.setattr("dvo.ba.sparse.multifrontal.SECONDS_PER_FRONT", 1e-6)  # many small fronts
    matrix = random_matrix(200, 350, 3, 0)
    x = torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    plan = matrix.pattern.front_plan(3)
    assert plan is not None and len(plan.fronts) > 20
    torch.testing.assert_close(solve_blocks(matrix, matrix.times(x), "fronts"), x)


def test_the_numbers_of_a_chain_grow_with_its_length():
    numbers = []
    for size in (1000, 4000):
        chain = torch.arange(size - 1)
        plan = make_pattern(size, chain, chain + 1).front_plan(6)
        assert plan is not None
        numbers.append(sum((f.end - f.begin) * (f.end - f.begin + len(f.below)) for f in plan.fronts))
    assert numbers[1] < 5 * numbers[0]


def test_a_matrix_that_is_not_positive_definite():
    matrix = random_matrix(30, 40, 6, 0)
    blocks = matrix.blocks.clone()
    blocks[matrix.pattern.diagonal[7]] *= -1
    assert (
        solve_blocks(BlockMatrix(matrix.pattern, blocks), torch.ones(30, 6, dtype=torch.float64), "fronts")
        .isnan()
        .all()
    )
    rows, columns = matrix.pattern.rows.numpy(), matrix.pattern.columns.numpy()
    structure = order_columns(30, rows, columns)
    assert structure is not None
    plan = plan_fronts(structure, rows, columns, 6)
    assert plan is not None and solve_fronts(plan, np.zeros((len(rows), 6, 6)), np.ones((30, 6))) is None


def test_a_factor_that_would_be_too_large_is_left_to_conjugate_gradients(monkeypatch: pytest.MonkeyPatch):
    matrix = random_matrix(30, 60, 3, 0)
    monkeypatch.setattr("dvo.ba.sparse.multifrontal.MAX_NUMBERS", 100)
    assert matrix.pattern.front_plan(3) is None
    x = torch.randn(30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(solve_blocks(matrix, matrix.times(x), "fronts"), x, rtol=1e-3, atol=1e-4)


def test_without_scipy_fronts_are_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(block_matrix, "scipy_is_installed", lambda: False)
    with pytest.raises(DvoError, match=r"dvo\[sparse\]"):
        solve_blocks(random_matrix(5, 5, 3, 0), torch.ones(5, 3, dtype=torch.float64), "fronts")
