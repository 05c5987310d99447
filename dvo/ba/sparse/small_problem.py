"""Cost and dense normal equations of a graph of few frames, such as the window of a tracker, by kernels of its edges.

The twin is :class:`dvo.ba.sparse.global_adjust.SparseProblem`: its block-sparse operations take many times as long as
the arithmetic of a graph of this size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.ba.layer.edgewise import ROBUST
from dvo.ba.patch_problem import PatchProblem
from dvo.ba.sparse.levenberg import MAX_DIAGONAL, MIN_DIAGONAL, LMOptions
from dvo.core.kernels import use_kernels
from dvo.geometry.bounds import MIN_Z_VALID

MOST_FRAMES = 20
"""Frames of a graph up to which its equations are dense."""

Array = np.ndarray[Any, Any]
Values = tuple[Array, Array]
"""Poses ``(N, 7)`` and inverse depths ``(K,)``; steps ``(6 n,)`` and ``(K,)``."""


def is_small(problem: PatchProblem) -> bool:
    """Tell if a graph is one for :class:`SmallProblem`: few frames of one camera, in float64, and no further factor.

    Args:
        problem: one graph.
    """
    if len(problem.poses_cw) > MOST_FRAMES or problem.sensors is not None or problem.factors or problem.blocks:
        return False
    values = problem.poses_cw, problem.patches, problem.intrinsics, problem.targets, problem.weights
    return problem.poses_cw.dtype == torch.float64 and use_kernels(*values, double=True)


@dataclass(frozen=True)
class SmallSystem:
    """Normal equations at one linearisation point; they are used for one step.

    Attributes:
        h_pp, h_lp, h_ll: ``(P, P)``, ``(K, P)`` and ``(K,)``.
        g_p, g_l: ``(P,)`` and ``(K,)`` negative gradients.
    """

    h_pp: Array
    h_lp: Array
    h_ll: Array
    g_p: Array
    g_l: Array

    def step(self, damping: float, options: LMOptions) -> tuple[Values, float]:
        """Damped Gauss-Newton step, as :meth:`dvo.ba.sparse.equations.SparseSystem.step`."""
        from dvo.ba.layer.edgewise_kernels import solve_reduced

        d_p = damping * self.h_pp.diagonal().clip(MIN_DIAGONAL, MAX_DIAGONAL)
        d_l = damping * self.h_ll.clip(MIN_DIAGONAL, MAX_DIAGONAL)
        damped = self.h_pp + np.diag(d_p), self.h_lp, np.where(self.h_ll > 0, self.h_ll + d_l, 0.0), self.g_p, self.g_l
        dp, dl = np.empty_like(self.g_p), np.empty_like(self.g_l)
        solve_reduced(*damped, 0.0, 0.0, np.full(len(dp), math.inf), dp, dl)
        predicted = 0.5 * float((dp * (d_p * dp + self.g_p)).sum() + (dl * (d_l * dl + self.g_l)).sum())
        return (dp, dl), predicted


class SmallProblem:
    """A graph for which :func:`is_small` is true.

    Args:
        problem: one graph; edges without a target have no weight.
        slot: ``(N,)`` row of each pose among those that move; ``free`` for one that stays.
        free: number of poses that move.
        move_depths: whether inverse depths move.
        kernel, max_residual, depth_range: see :class:`dvo.ba.sparse.global_adjust.GlobalBAOptions`.

    Attributes:
        state: the unknowns at the values of the problem.
    """

    def __init__(
        self,
        problem: PatchProblem,
        slot: Tensor,
        free: int,
        move_depths: bool,
        kernel: Kernel,
        max_residual: float,
        depth_range: tuple[float, float],
    ) -> None:
        from dvo.ba.layer.edgewise_kernels import frame_pairs

        measured = problem.centres, problem.intrinsics, problem.targets, problem.weights
        ii, jj, kk = (x.contiguous().numpy() for x in (problem.ii, problem.jj, problem.kk))
        _, pairs, ends = frame_pairs(ii, jj, kk, len(problem.poses_cw), len(problem.patches))
        self.edges: tuple[Any, ...] = *(x.contiguous().numpy() for x in measured), ii, jj, kk, pairs, ends
        poses, depths = (x.contiguous().numpy().copy() for x in (problem.poses_cw, problem.inverse_depths))
        self.state: Values = poses, depths
        place = slot.numpy()
        self.free, self.rows = free, np.where(place < free, 6 * place, -1)
        self.move_depths, self.depth_range = move_depths, depth_range
        numbers = MIN_Z_VALID, max_residual, 0.0, 0.0, math.inf, math.inf, kernel.width
        self.gate, self.robust = tuple(map(float, numbers)), ROBUST[kernel.name]
        self.counted = np.empty(len(pairs), np.bool_)

    def cost(self, state: Values) -> float:
        """Half the sum of robust squared residuals; ``counted`` is filled with the edges that count."""
        from dvo.ba.layer.edgewise_kernels import robust_cost

        arguments: tuple[Any, ...] = (*state, *self.edges, self.gate, self.robust, self.counted)
        return float(robust_cost(*arguments))

    def linearise(self, state: Values) -> SmallSystem:
        """Normal equations at a state."""
        from dvo.ba.layer.edgewise_kernels import add_reprojection

        size, count = 6 * self.free, len(state[1])
        sums = np.zeros((size, size)), np.zeros((count, size)), np.zeros(count), np.zeros(size), np.zeros(count)
        given = *state, *self.edges, self.rows, self.move_depths, self.gate, self.robust
        arguments: tuple[Any, ...] = (*given, *sums)
        add_reprojection(*arguments)
        return SmallSystem(*sums)

    def moved(self, state: Values, step: Values) -> Values:
        """The state after a step."""
        from dvo.ba.layer.edgewise_kernels import move_poses

        poses = state[0].copy()
        move_poses(poses, self.rows, step[0])
        return poses, (state[1] + step[1]).clip(*self.depth_range) if self.move_depths else state[1]

    def values(self, state: Values) -> tuple[Tensor, Tensor]:
        """Poses ``(N, 7)`` and inverse depths ``(K,)`` of a state."""
        return torch.from_numpy(state[0]), torch.from_numpy(state[1])

    def inliers(self, state: Values) -> Tensor:
        """``(E,)`` bool, edges that count."""
        self.cost(state)
        return torch.from_numpy(self.counted)

    @property
    def stored_blocks(self) -> int:
        """Blocks of the normal equations that are not zero: observations by frames that move, and pairs of these."""
        ii, jj, kk = self.edges[4:7]
        seen = np.zeros((len(self.state[1]), len(self.rows)), np.bool_)
        seen[kk, ii] = seen[kk, jj] = True
        coupled = np.eye(len(self.rows), dtype=np.bool_)
        coupled[ii, jj] = coupled[jj, ii] = True
        moves = self.rows >= 0
        pairs = int(coupled[moves][:, moves].sum()) + self.free  # each twice, but for the diagonal
        return int(seen[:, moves].sum()) + pairs // 2
