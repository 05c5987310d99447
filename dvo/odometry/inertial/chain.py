"""Least squares of a chain of states in time with a few unknowns that all of them share.

The information matrix is block tridiagonal with a border: states are eliminated in order of time, which costs a few
small Cholesky decompositions for each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass
class ChainSystem:
    """Normal equations ``H x = g`` of ``N`` states of ``n`` unknowns and ``m`` shared ones.

    Attributes:
        diagonal: ``(N, n, n)`` blocks of the states.
        upper: ``(N - 1, n, n)`` blocks of a state and the one after it.
        border: ``(N, n, m)`` blocks of a state and the shared unknowns.
        shared: ``(m, m)``.
        right: ``(N, n)`` and
        right_shared: ``(m,)``, the right side.
    """

    diagonal: Array
    upper: Array
    border: Array
    shared: Array
    right: Array
    right_shared: Array

    @classmethod
    def zeros(cls, count: int, size: int, shared: int) -> ChainSystem:
        """System without measurements.

        Args:
            count, size, shared: ``N``, ``n`` and ``m``.
        """
        return cls(
            np.zeros((count, size, size)), np.zeros((max(count - 1, 0), size, size)), np.zeros((count, size, shared)),
            np.zeros((shared, shared)), np.zeros((count, size)), np.zeros(shared),
        )  # fmt: skip


@dataclass(frozen=True)
class ChainSolution:
    """Solution of a chain.

    Attributes:
        states: ``(N, n)``.
        shared: ``(m,)``.
        covariance: ``(n + m, n + m)`` of the last state and the shared unknowns, jointly.
        pairs: ``(N - 1, 2 n + m, 2 n + m)`` covariance of each state, the one after it and the shared unknowns; None if
            not asked for.
    """

    states: Array
    shared: Array
    covariance: Array
    pairs: Array | None = None


def solve_chain(system: ChainSystem, damping: float = 0.0, *, pairs: bool = False) -> ChainSolution:
    """Solve the normal equations.

    Args:
        system: positive definite.
        damping: share of each diagonal entry that is added to it (Levenberg and Marquardt).
        pairs: the covariances of all states are wanted.

    Returns:
        Solution, and covariance of the newest state and the shared unknowns.

    Raises:
        numpy.linalg.LinAlgError: it is not positive definite.
    """
    count, n, m = system.border.shape
    inverses, coupled, block, side, shared = _eliminated(system, damping)
    inverses[-1] = np.linalg.inv(np.linalg.cholesky(block))
    scaled = inverses[-1] @ side
    coupled[-1, :, : m + 1] = scaled
    shared -= scaled[:, :m].T @ scaled
    root = np.linalg.inv(np.linalg.cholesky(shared[:, :m])) if m else np.zeros((0, 0))
    common = root.T @ (root @ shared[:, m])
    states = np.empty((count, n))
    for k in reversed(range(count)):
        ahead = n if k < count - 1 else 0
        part = coupled[k, :, ahead + m] - coupled[k, :, ahead : ahead + m] @ common
        if ahead:
            part = part - coupled[k, :, :n] @ states[k + 1]
        states[k] = inverses[k].T @ part
    # Joint covariance of the last state and the border from their Cholesky factor.
    joint = np.zeros((n + m, n + m))
    joint[:n, :n] = inverses[-1].T
    joint[:n, n:] = -inverses[-1].T @ coupled[-1, :, :m] @ root.T
    joint[n:, n:] = root.T
    covariance = joint @ joint.T
    return ChainSolution(states, common, covariance, _pairs(inverses, coupled, covariance) if pairs else None)


def marginal(system: ChainSystem) -> tuple[Array, Array]:
    """Normal equations of the last state and the shared unknowns, without the states before (Schur complement).

    Args:
        system: positive definite but for the last state and the shared unknowns.

    Returns:
        Information ``(n + m, n + m)`` and right side ``(n + m,)``.

    Raises:
        numpy.linalg.LinAlgError: it is not positive definite.
    """
    n, m = system.border.shape[1:]
    block, side, shared = _eliminated(system, 0.0)[2:]
    information = np.block([[block, side[:, :m]], [side[:, :m].T, shared[:, :m]]])
    return information, np.concatenate([side[:, m], shared[:, m]])


def _eliminated(system: ChainSystem, damping: float) -> tuple[Array, Array, Array, Array, Array]:
    """All states but the last: inverses of their Cholesky factors, and what couples each with all that come later (the
    state after it, the border, and the right side as a column); equations of the last one and of the border."""
    count, n, m = system.border.shape
    shared = np.empty((m, m + 1))
    shared[:, :m], shared[:, m] = system.shared, system.right_shared
    shared[np.arange(m), np.arange(m)] *= 1 + damping
    inverses = np.empty((count, n, n))
    coupled = np.empty((count, n, n + m + 1))
    block, side = system.diagonal[0].copy(), np.concatenate([system.border[0], system.right[0][:, None]], 1)
    index = np.arange(n)
    for k in range(count - 1):
        block[index, index] += damping * system.diagonal[k][index, index]
        inverses[k] = np.linalg.inv(np.linalg.cholesky(block))
        coupled[k] = scaled = inverses[k] @ np.concatenate([system.upper[k], side], 1)
        ahead, rest = scaled[:, :n], scaled[:, n:]
        shared -= rest[:, :m].T @ rest
        block = system.diagonal[k + 1] - ahead.T @ ahead
        side = np.concatenate([system.border[k + 1], system.right[k + 1][:, None]], 1) - ahead.T @ rest
    block[index, index] += damping * system.diagonal[-1][index, index]
    return inverses, coupled, block, side, shared


def _pairs(inverses: Array, coupled: Array, last: Array) -> Array:
    """Covariances of consecutive states, from the last one backwards."""
    count, n = inverses.shape[:2]
    size = len(last)
    found, after = np.empty((count - 1, n + size, n + size)), last
    for k in reversed(range(count - 1)):
        back = inverses[k].T
        follows = -back @ coupled[k, :, :size]
        across, pair = follows @ after, found[k]
        pair[:n, :n] = back @ back.T + across @ follows.T
        pair[:n, n:], pair[n:, :n], pair[n:, n:] = across, across.T, after
        after = np.delete(np.delete(pair, np.s_[n : 2 * n], 0), np.s_[n : 2 * n], 1)
    return found
