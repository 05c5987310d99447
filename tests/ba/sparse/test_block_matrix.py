"""Block-sparse matrices and their solvers against dense linear algebra."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dvo.ba.sparse import block_matrix
from dvo.ba.sparse.block_matrix import (
    BlockMatrix,
    CGOptions,
    block_jacobi,
    conjugate_gradients,
    make_pattern,
    solve_blocks,
)
from dvo.ba.sparse.cholesky import plan_tiles, solve_cholesky
from dvo.core.errors import DvoError


def random_matrix(n: int, dim: int, pairs: int, seed: int) -> BlockMatrix:
    """Positive definite, with ``pairs`` blocks off the diagonal at random places."""
    generator = torch.Generator().manual_seed(seed)
    rows, columns = torch.randint(0, n, (2, pairs), generator=generator)
    pattern = make_pattern(n, rows, columns)
    blocks = torch.randn(pattern.count, dim, dim, generator=generator, dtype=torch.float64)
    blocks[pattern.diagonal] = blocks[pattern.diagonal] + blocks[pattern.diagonal].mT
    matrix = BlockMatrix(pattern, blocks)
    bound = matrix.dense().abs().sum(1).view(n, dim)  # diagonally dominant
    return matrix.damped(bound)


def test_the_pattern_drops_what_is_outside_and_keeps_the_diagonal():
    pattern = make_pattern(4, torch.tensor([0, 2, 4, 1, 1]), torch.tensor([2, 0, 1, -1, 1]))
    assert list(zip(pattern.rows.tolist(), pattern.columns.tolist(), strict=True)) == [
        (0, 0), (1, 1), (2, 0), (2, 2), (3, 3),
    ]  # fmt: skip
    assert pattern.diagonal.tolist() == [0, 1, 3, 4]


@pytest.mark.long
@given(st.integers(1, 40), st.sampled_from([6, 7]), st.integers(0, 80), st.integers(0, 10_000))
def test_products_and_solutions_are_the_dense_ones(n: int, dim: int, pairs: int, seed: int):
    matrix = random_matrix(n, dim, pairs, seed)
    dense = matrix.dense()
    assert torch.equal(dense, dense.mT)
    x = torch.randn(n, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    expected = (dense @ x.flatten()).view(n, dim)
    torch.testing.assert_close(matrix.times(x), expected)
    torch.testing.assert_close(matrix.operator()(x), expected)
    for solver in ("direct", "cg"):
        found = solve_blocks(matrix, expected, solver, CGOptions(tolerance=1e-12))
        torch.testing.assert_close(found, x, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("width", [1, 3, 4, 50])
def test_every_tile_width_gives_the_solution(width: int):
    matrix = random_matrix(23, 6, 30, 1)
    plan = plan_tiles(23, matrix.pattern.rows, matrix.pattern.columns, width)
    rhs = torch.arange(23 * 6, dtype=torch.float64).view(23, 6)
    found = solve_cholesky(plan, matrix.blocks, rhs)
    torch.testing.assert_close(matrix.times(found), rhs)


def test_a_chain_is_factorised_without_fill():
    n = 64
    chain = make_pattern(n, torch.arange(1, n), torch.arange(n - 1))
    plan = plan_tiles(n, chain.rows, chain.columns, 1)
    assert plan.tiles == 2 * n - 1


def test_a_matrix_that_is_not_positive_definite_gives_nan():
    matrix = random_matrix(5, 6, 4, 0)
    broken = replace(matrix, blocks=-matrix.blocks)
    assert solve_blocks(broken, torch.ones(5, 6, dtype=torch.float64), "direct").isnan().all()


def test_a_cluster_of_all_blocks_is_the_inverse():
    matrix = random_matrix(10, 6, 20, 3)
    rhs = torch.ones(10, 6, dtype=torch.float64)
    exact = torch.linalg.solve(matrix.dense(), rhs.flatten()).view(10, 6)
    torch.testing.assert_close(block_jacobi(matrix, 10)(rhs), exact)
    x, iterations = conjugate_gradients(matrix.operator(), rhs, block_jacobi(matrix, 10))
    assert iterations <= 2
    torch.testing.assert_close(x, exact)


@pytest.mark.long
def test_a_matrix_too_dense_to_factorise_goes_to_conjugate_gradients(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(block_matrix, "best_plan", lambda *_: None)
    matrix = random_matrix(8, 6, 20, 5)
    x = torch.ones(8, 6, dtype=torch.float64)
    options = CGOptions(tolerance=1e-12)
    torch.testing.assert_close(solve_blocks(matrix, matrix.times(x), "auto", options), x)
    with pytest.raises(DvoError, match="too dense"):
        solve_blocks(matrix, x, "direct")
    with pytest.raises(DvoError, match="unknown linear solver"):
        solve_blocks(matrix, x, "lu")  # type: ignore[arg-type]
