"""Backward of a Gauss-Newton step.

The step solves ``H delta = g``. For the incoming gradient ``c`` let ``H lambda = c``; then the derivative of the step
by anything that H and g are made of is that of the scalar

    phi = lambda^T (g - H delta) = sum over rows of  w (J lambda) . (r - J delta)

with ``lambda`` and ``delta`` constant (implicit function theorem). ``J lambda`` is a directional derivative, so phi
is a short formula for each row of a factor, and autograd through it is all that is left.

H contains ``relative diag(S)`` of the reduced system ``S = H_pp - E Q E^T``. It adds ``sum s_i S_ii`` to phi, with
``s_i = -relative lambda_i delta_i``. To first order ``S_ii`` changes with ``H_pp`` directly, with E by ``-2 Q E`` and
with the curvatures C of the eliminated block by ``(Q E)^2``, which are constants too; summed over rows,

    sum over rows of  w (J diag(s) J^T + J_d J e + J_d^2 c),   e_k = -2 s Q_k E_k,   c_k = sum_i s_i (Q_k E_ik)^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from dvo.ba.problem import AdjointConstants, Problem


def adjoint_constants(
    relative: float, h_pl: Tensor, q: Tensor, lambda_p: Tensor, delta_p: Tensor, lambda_l: Tensor, delta_l: Tensor
) -> AdjointConstants:
    """Constants of phi.

    Args:
        relative: relative damping of the reduced system.
        h_pl: ``(B, P, K)``, E above.
        q: ``(B, K)`` inverse curvatures of the eliminated block.
        lambda_p, delta_p: ``(B, P)``.
        lambda_l, delta_l: ``(B, K)``.
    """
    parts = (lambda_p, delta_p, lambda_l, delta_l)
    if lambda_p.shape[1] == 0 or relative == 0:
        return AdjointConstants(*parts)
    s = -relative * lambda_p * delta_p
    qe = h_pl * q[:, None]
    return AdjointConstants(*parts, s, -2 * s[..., None] * qe, (s[:, None] @ (qe * qe))[:, 0])


def gradients(
    problem: Problem, tensors: Sequence[Tensor], needed: Sequence[int], constants: AdjointConstants, memos: list[Any]
) -> list[Tensor | None]:
    """Gradients of phi by the tensors that need one.

    Term by term, so that the graph of only one is alive at a time.

    Args:
        problem: structure; its own tensors are not used.
        tensors: values, in the order of :meth:`Problem.tensors`.
        needed: positions among them.
        constants: see :class:`AdjointConstants`.
        memos: of the factors, from the forward pass.
    """
    found: list[Tensor | None] = [None] * len(needed)
    if not needed:
        return found
    with torch.enable_grad():
        leaves = [x.detach().requires_grad_(i in needed) for i, x in enumerate(tensors)]
        wanted = [leaves[i] for i in needed]
        problem = problem.with_tensors(leaves)
        for factor, memo in zip(problem.factors, memos, strict=True):
            for term in factor.phi(problem.state, constants, memo):
                if term.requires_grad:
                    more = torch.autograd.grad(term, wanted, allow_unused=True)
                    found = [a if b is None else b if a is None else a + b for a, b in zip(found, more, strict=True)]
    return found
