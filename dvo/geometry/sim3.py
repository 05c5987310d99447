"""Similarities as tensors ``(..., 8)``: ``tx ty tz qx qy qz qw s``, unit quaternion, scale ``s > 0``.

Tangent vectors are ``(..., 7)``: ``[tau, phi, sigma]``, ``s = exp(sigma)``. A point goes to ``s R p + t``. Batch
dimensions broadcast; the retraction is a left one. (Strasdat, "Local accuracy and global consistency for efficient
visual SLAM", 2012.)
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3, so3

# The left Jacobian is the integral of s^u R^u over u in [0, 1]. Its closed form divides by differences that vanish at
# small angles and at small log-scales; sixteen Gauss nodes give it to the last digit for all angles and |sigma| < 10
# without a branch.
_NODES, _NODE_WEIGHTS = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(16))


def identity(*shape: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Tensor:
    """``(*shape, 8)`` similarities that move nothing."""
    return from_se3(se3.identity(*shape, dtype=dtype, device=device))


def from_se3(pose: Tensor, scale: Tensor | float = 1.0) -> Tensor:
    """Pose ``(..., 7)`` and scale ``(...)`` to ``(..., 8)``."""
    scale = torch.as_tensor(scale, dtype=pose.dtype, device=pose.device)
    return torch.cat((pose, scale.expand(pose.shape[:-1])[..., None]), -1)


def _left_jacobian(phi: Tensor, sigma: Tensor) -> Tensor:
    """``(..., 3, 3)`` for ``phi (..., 3)`` and ``sigma (..., 1)``."""
    u, w = ((x.to(phi) + (0.5 if shift else 0)) for x, shift in ((_NODES / 2, True), (_NODE_WEIGHTS / 2, False)))
    turned = so3.matrix(so3.exp(phi[..., None, :] * u[:, None]))
    return ((w * torch.exp(sigma * u))[..., None, None] * turned).sum(-3)


def exp(xi: Tensor) -> Tensor:
    """Tangent ``(..., 7)`` to similarity ``(..., 8)``."""
    tau, phi, sigma = xi.split((3, 3, 1), -1)
    t = (_left_jacobian(phi, sigma) * tau[..., None, :]).sum(-1)
    return torch.cat((t, so3.exp(phi), sigma.exp()), -1)


def log(sim: Tensor) -> Tensor:
    """Similarity ``(..., 8)`` to tangent ``(..., 7)``, rotation angle at most pi."""
    phi, sigma = so3.log(sim[..., 3:7]), sim[..., 7:].log()
    tau = torch.linalg.solve(_left_jacobian(phi, sigma), sim[..., :3])
    return torch.cat((tau, phi, sigma), -1)


def compose(a: Tensor, b: Tensor) -> Tensor:
    """``a b``: first ``b``, then ``a``."""
    return torch.cat((act(a, b[..., :3]), so3.multiply(a[..., 3:7], b[..., 3:7]), a[..., 7:] * b[..., 7:]), -1)


def inverse(sim: Tensor) -> Tensor:
    """``sim^-1``."""
    q, scale = so3.conjugate(sim[..., 3:7]), 1 / sim[..., 7:]
    return torch.cat((-scale * so3.rotate(q, sim[..., :3]), q, scale), -1)


def act(sim: Tensor, points: Tensor) -> Tensor:
    """``s R p + t`` on points ``(..., 3)``."""
    return sim[..., 7:] * so3.rotate(sim[..., 3:7], points) + sim[..., :3]


def act_on_pose(sim: Tensor, poses_wc: Tensor) -> Tensor:
    """Camera-to-world poses ``(..., 7)`` in the new world: the centre is moved and scaled, the camera only turned."""
    return torch.cat((act(sim, poses_wc[..., :3]), so3.multiply(sim[..., 3:7], poses_wc[..., 3:])), -1)


def normalise(sim: Tensor) -> Tensor:
    """Bring the quaternion back to unit length."""
    return torch.cat((sim[..., :3], so3.normalise(sim[..., 3:7]), sim[..., 7:]), -1)


def retract(sim: Tensor, xi: Tensor) -> Tensor:
    """``Exp(xi) sim``, renormalised."""
    return normalise(compose(exp(xi), sim))


def matrix(sim: Tensor) -> Tensor:
    """``(..., 4, 4)`` matrix ``[[s R, t], [0, 1]]``."""
    rigid = se3.matrix(sim[..., :7])
    scale = torch.ones_like(rigid)
    scale[..., :3, :3] = sim[..., 7:, None]
    return rigid * scale


def adjoint(sim: Tensor) -> Tensor:
    """``(..., 7, 7)`` with ``sim Exp(xi) sim^-1 = Exp(adjoint(sim) xi)``."""
    r, t, s = so3.matrix(sim[..., 3:7]), sim[..., :3], sim[..., 7:, None]
    o, column = torch.zeros_like(r), torch.zeros_like(t)[..., None]
    top = torch.cat((s * r, so3.hat(t) @ r, -t[..., None]), -1)
    middle = torch.cat((o, r, column), -1)
    last = torch.cat((torch.zeros_like(sim[..., :6]), torch.ones_like(sim[..., 7:])), -1)[..., None, :]
    return torch.cat((top, middle, last), -2)


def left_jacobian(xi: Tensor) -> Tensor:
    """Left Jacobian of the exponential map: ``Exp(xi + d) = Exp(left_jacobian(xi) d) Exp(xi)`` to first order in ``d``.

    The integral of ``Ad(Exp(u xi))`` over ``u`` in [0, 1] by Gauss-Legendre quadrature, without a branch at small
    angles. The right Jacobian is ``left_jacobian(-xi)``.

    Args:
        xi: ``(..., 7)`` tangent ``[tau, phi, sigma]``, ``|phi| <= pi`` and ``|sigma| < 10``.

    Returns:
        ``(..., 7, 7)``.
    """
    nodes, weights = _NODES.to(xi) / 2 + 0.5, _NODE_WEIGHTS.to(xi) / 2
    return (weights[:, None, None] * adjoint(exp(xi[..., None, :] * nodes[:, None]))).sum(-3)
