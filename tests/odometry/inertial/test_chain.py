"""Block elimination against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.odometry.inertial.chain import ChainSystem, marginal, solve_chain


@pytest.mark.parametrize("count", [1, 2, 7])
@pytest.mark.parametrize("shared", [0, 3])
def test_solution_and_covariance_are_those_of_the_dense_system(count: int, shared: int) -> None:
    rng, n = np.random.default_rng(count + shared), 4
    size = count * n + shared
    dense = np.eye(size)
    for k in range(count):
        rows = rng.normal(size=(9, size))
        rows[:, : k * n], rows[:, (k + 2) * n : count * n] = 0, 0
        dense += rows.T @ rows
    right = rng.normal(size=size)
    system = ChainSystem.zeros(count, n, shared)
    for k in range(count):
        mine = slice(k * n, (k + 1) * n)
        system.diagonal[k], system.border[k], system.right[k] = dense[mine, mine], dense[mine, count * n :], right[mine]
        if k + 1 < count:
            system.upper[k] = dense[mine, (k + 1) * n : (k + 2) * n]
    system.shared[:], system.right_shared[:] = dense[count * n :, count * n :], right[count * n :]
    found = solve_chain(system)
    expected = np.linalg.solve(dense, right)
    np.testing.assert_allclose(np.concatenate([found.states.ravel(), found.shared]), expected, atol=1e-9)
    kept = slice((count - 1) * n, None)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(dense)[kept, kept], atol=1e-9)
    information, side = marginal(system)
    np.testing.assert_allclose(np.linalg.inv(information), found.covariance, atol=1e-9)
    np.testing.assert_allclose(found.covariance @ side, expected[kept], atol=1e-9)
    everything, covariance = solve_chain(system, pairs=True), np.linalg.inv(dense)
    assert found.pairs is None and everything.pairs is not None and len(everything.pairs) == count - 1
    for k, pair in enumerate(everything.pairs):
        kept = np.r_[k * n : (k + 2) * n, count * n : size]
        np.testing.assert_allclose(pair, covariance[np.ix_(kept, kept)], atol=1e-9)
    damped = solve_chain(system, 0.5)
    expected = np.linalg.solve(dense + 0.5 * np.diag(np.diag(dense)), right)
    np.testing.assert_allclose(np.concatenate([damped.states.ravel(), damped.shared]), expected, atol=1e-9)


def test_system_without_information_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        solve_chain(ChainSystem.zeros(3, 2, 1))
