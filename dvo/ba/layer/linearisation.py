"""Linearised factors, and the generic sums over their rows: normal equations and adjoint.

The specification of every fast path: the sums use nothing of a factor but its :class:`Linearisation`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from dvo.ba.blocks import State
from dvo.core.errors import DvoError


@dataclass(frozen=True)
class Linearisation:
    """Residuals of a factor and their derivatives at a state.

    To first order a step ``delta`` changes the residual to ``r - J delta``: ``J`` is minus the derivative of the
    residual by the left tangents of the blocks.

    Attributes:
        residual: ``(B, F, D)``.
        weight: ``(B, F, D)``, not negative; zero for a row that does not count. Kernel weights are included, computed
            from detached residuals.
        blocks: name of the state block of each slot. At most one slot is of an eliminated block.
        indices: per slot ``(F,)`` element of the block; -1 if the row does not touch it.
        jacobians: per slot ``(B, F, D, dim)``.
    """

    residual: Tensor
    weight: Tensor
    blocks: tuple[str, ...]
    indices: tuple[Tensor, ...]
    jacobians: tuple[Tensor, ...]

    def cost(self) -> Tensor:
        """``(B,)`` sum of ``weight * residual^2``."""
        return (self.weight * self.residual.square()).sum((1, 2))


@dataclass(frozen=True)
class NormalEquations:
    """``h_pp (B, P, P)``, ``h_pl (B, P, K)``, ``h_ll (B, K)``, ``g_p (B, P)``, ``g_l (B, K)``."""

    h_pp: Tensor
    h_pl: Tensor
    h_ll: Tensor
    g_p: Tensor
    g_l: Tensor

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass(frozen=True)
class AdjointConstants:
    """Constants of the adjoint scalar ``phi`` (see :mod:`dvo.ba.layer.adjoint`), none of which is differentiated.

    Attributes:
        lambda_p, delta_p: ``(B, P)`` reduced parts of lambda and delta. lambda_l, delta_l: ``(B, K)`` their parts of
            the eliminated block.
        s: ``(B, P)``; None without relative damping, as are the other two.
        e: ``(B, P, K)``. c: ``(B, K)``.
    """

    lambda_p: Tensor
    delta_p: Tensor
    lambda_l: Tensor
    delta_l: Tensor
    s: Tensor | None = None
    e: Tensor | None = None
    c: Tensor | None = None


def landmark_count(state: State) -> int:
    """Elements ``K`` of the eliminated block, 0 if there is none."""
    return 0 if state.landmarks is None else state[state.landmarks].value.shape[1]


def reduced_part(linear: Linearisation, state: State) -> tuple[Tensor, Tensor]:
    """Jacobian ``(B, F, D, R)`` by the unknowns of the reduced system and their rows ``(F, R)`` in it.

    A row ``state.size`` stands for no unknown. Blocks without unknowns are left out.
    """
    rows, jacobians = [], []
    for name, index, jacobian in zip(linear.blocks, linear.indices, linear.jacobians, strict=True):
        if name != state.landmarks and state[name].unknowns:
            rows.append(state.rows(name, index))
            jacobians.append(jacobian)
    if not rows:
        b, f, d = linear.residual.shape
        return linear.residual.new_zeros(b, f, d, 0), torch.zeros(f, 0, dtype=torch.long, device=linear.residual.device)
    return torch.cat(jacobians, -1), torch.cat(rows, -1)


def landmark_part(linear: Linearisation, state: State) -> tuple[Tensor, Tensor] | None:
    """Jacobian ``(B, F, D)`` by the eliminated block and the element ``(F,)`` of each row, ``K`` for none.

    None if the factor does not touch that block, or if the block is held.
    """
    found = None
    for name, index, jacobian in zip(linear.blocks, linear.indices, linear.jacobians, strict=True):
        if name != state.landmarks or state[name].unknowns == 0:
            continue
        if found is not None:
            raise DvoError(f"a factor couples two elements of {name!r}", remedy="give it one slot of that block")
        found = jacobian[..., 0], torch.where(index < 0, landmark_count(state), index)
    return found


def assemble(linear: Linearisation, state: State) -> NormalEquations:
    """Sum ``J^T W J`` and ``J^T W r`` over the rows of a factor.

    Args:
        linear: the linearised factor.
        state: blocks that its slots refer to.

    Returns:
        Dense normal equations with ``P = state.size`` reduced unknowns and ``K`` eliminated ones.

    Raises:
        DvoError: two slots of the eliminated block.
    """
    b, p, k = len(linear.residual), state.size, landmark_count(state)
    zeros = linear.residual.new_zeros
    jacobian, rows = reduced_part(linear, state)
    weighted = jacobian * linear.weight[..., None]
    cells = (rows[:, :, None] * (p + 1) + rows[:, None]).flatten()
    h_pp = zeros(b, (p + 1) ** 2).index_add_(1, cells, (weighted.mT @ jacobian).flatten(1)).view(b, p + 1, p + 1)
    gradient = (weighted * linear.residual[..., None]).sum(2)
    g_p = zeros(b, p + 1).index_add_(1, rows.flatten(), gradient.flatten(1))
    h_pl, h_ll, g_l = zeros(b, p + 1, k + 1), zeros(b, k + 1), zeros(b, k + 1)
    found = landmark_part(linear, state)
    if found is not None:
        by_landmark, index = found
        weighted_l = linear.weight * by_landmark
        h_ll.index_add_(1, index, (weighted_l * by_landmark).sum(-1))
        g_l.index_add_(1, index, (weighted_l * linear.residual).sum(-1))
        cells = (rows * (k + 1) + index[:, None]).flatten()
        h_pl.view(b, -1).index_add_(1, cells, (jacobian * weighted_l[..., None]).sum(2).flatten(1))
    return NormalEquations(h_pp[:, :p, :p], h_pl[:, :p, :k], h_ll[:, :k], g_p[:, :p], g_l[:, :k])


def adjoint_term(linear: Linearisation, state: State, constants: AdjointConstants) -> Tensor:
    """Scalar ``phi`` of one factor; see :mod:`dvo.ba.layer.adjoint`.

    Args:
        linear: the factor linearised at leaves of autograd.
        state: blocks that its slots refer to.
        constants: lambda, delta and the coefficients of relative damping.

    Returns:
        ``sum w (J lambda) . (r - J delta)`` and, with relative damping, ``sum w (J diag(s) J^T + J_d J e + J_d^2 c)``.
    """
    pad = torch.nn.functional.pad
    jacobian, rows = reduced_part(linear, state)
    b, f, r = len(jacobian), *rows.shape

    def along(reduced: Tensor) -> Tensor:
        """``(B, P)`` at the rows of the slots, ``(B, F, 1, R)``, zero where there is no unknown."""
        return pad(reduced, (0, 1)).index_select(1, rows.flatten()).view(b, f, 1, r)

    flow, change = ((jacobian * along(x)).sum(-1) for x in (constants.lambda_p, constants.delta_p))
    found = landmark_part(linear, state)
    if found is not None:
        by_landmark, index = found
        steps = (pad(x, (0, 1)).index_select(1, index)[..., None] for x in (constants.lambda_l, constants.delta_l))
        flow_l, change_l = (by_landmark * x for x in steps)
        flow, change = flow + flow_l, change + change_l
    total = (linear.weight * flow * (linear.residual - change)).sum()
    if constants.s is None or constants.e is None or constants.c is None:
        return total
    # Two slots of one row may be the same unknown: their Jacobians add up before they are squared.
    same = (rows[:, :, None] == rows[:, None]).to(jacobian)
    quadratic = ((jacobian * along(constants.s)) @ same * jacobian).sum(-1)
    if found is not None:
        by_landmark, index = found
        k = constants.c.shape[1]
        cells = (rows * (k + 1) + index[:, None]).flatten()
        e = pad(constants.e, (0, 1, 0, 1)).flatten(1).index_select(1, cells).view(b, f, 1, r)
        c = pad(constants.c, (0, 1)).index_select(1, index)[..., None]
        quadratic = quadratic + by_landmark * ((jacobian * e).sum(-1) + by_landmark * c)
    return total + (linear.weight * quadratic).sum()
