"""Rigid motions as tensors ``(..., 7)``: ``tx ty tz qx qy qz qw``, unit quaternion.

Tangent vectors are ``(..., 6)``: ``[tau, phi]``, translation first, ``phi`` in radians. Batch dimensions broadcast.
The retraction is a left one: ``T <- Exp(xi) T``. Gradients are the Euclidean ones of autograd through the seven
numbers.
Formulas: Sola et al., "A micro Lie theory for state estimation in robotics", appendix D.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import so3
from dvo.geometry.so3 import hat, rotate

__all__ = [
    "act",
    "act_homogeneous",
    "adjoint",
    "compose",
    "exp",
    "from_matrix",
    "identity",
    "inverse",
    "left_jacobian",
    "log",
    "matrix",
    "normalise",
    "relative",
    "retract",
    "rotate",
]


def identity(*shape: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Tensor:
    """Identity poses.

    Args:
        shape: batch dimensions.
        dtype, device: of the result.

    Returns:
        ``(*shape, 7)``.
    """
    pose = torch.zeros(*shape, 7, dtype=dtype, device=device)
    pose[..., 6] = 1
    return pose


def exp(xi: Tensor) -> Tensor:
    """Exponential map (Sola et al., eq. 172).

    Args:
        xi: ``(..., 6)`` tangent ``[tau, phi]``, radians.

    Returns:
        ``(..., 7)`` pose.
    """
    tau, phi = xi[..., :3], xi[..., 3:]
    q, b, c = so3.exp_terms(phi)
    first = torch.linalg.cross(phi, tau)
    return torch.cat((tau + b * first + c * torch.linalg.cross(phi, first), q), -1)


def log(pose: Tensor) -> Tensor:
    """Logarithm map (Sola et al., eq. 173).

    Args:
        pose: ``(..., 7)``; ``q`` and ``-q`` give the same result.

    Returns:
        ``(..., 6)`` tangent ``[tau, phi]`` with ``|phi| <= pi``.
    """
    t = pose[..., :3]
    phi, e = so3.log_terms(pose[..., 3:])
    first = torch.linalg.cross(phi, t)
    return torch.cat((t - 0.5 * first + e * torch.linalg.cross(phi, first), phi), -1)


def compose(a: Tensor, b: Tensor) -> Tensor:
    """Product ``a b``: first ``b``, then ``a``.

    Args:
        a, b: ``(..., 7)``; batch dimensions broadcast.

    Returns:
        ``(..., 7)``.
    """
    t = rotate(a[..., 3:], b[..., :3]) + a[..., :3]
    return torch.cat((t, so3.multiply(a[..., 3:], b[..., 3:])), -1)


def inverse(pose: Tensor) -> Tensor:
    """Inverse motion.

    Args:
        pose: ``(..., 7)``, for example ``T_cw``.

    Returns:
        ``(..., 7)``, then ``T_wc``.
    """
    q = so3.conjugate(pose[..., 3:])
    return torch.cat((-rotate(q, pose[..., :3]), q), -1)


def relative(a: Tensor, b: Tensor) -> Tensor:
    """Relative motion ``b a^-1``: with world-to-camera poses, points of camera ``a`` to camera ``b``.

    Args:
        a, b: ``(..., 7)``; batch dimensions must be equal.

    Returns:
        ``(..., 7)``.
    """
    q = so3.multiply(b[..., 3:], so3.conjugate(a[..., 3:]))
    return torch.cat((b[..., :3] - rotate(q, a[..., :3]), q), -1)


def steps(poses_cw: Tensor) -> Tensor:
    """Motions between neighbouring poses: ``T_ab = T_cw[a] T_cw[b]^-1``, of camera ``b = a + 1``.

    Args:
        poses_cw: ``(..., N, 7)`` world to camera.

    Returns:
        ``(..., N - 1, 7)`` pose of each camera but the first in the coordinates of the one before it.
    """
    return relative(poses_cw[..., 1:, :], poses_cw[..., :-1, :])


def act(pose: Tensor, points: Tensor) -> Tensor:
    """Transform points: ``R p + t``.

    Args:
        pose: ``(..., 7)``; ``pose[..., None, :]`` for many points per pose.
        points: ``(..., 3)``; batch dimensions broadcast.

    Returns:
        ``(..., 3)``.
    """
    return rotate(pose[..., 3:], points) + pose[..., :3]


def act_homogeneous(pose: Tensor, points: Tensor) -> Tensor:
    """Transform homogeneous points: ``(R x + t h, h)``.

    Args:
        pose: ``(..., 7)``.
        points: ``(..., 4)`` = ``(x, h)``; ``h`` is an inverse depth if ``x`` is a ray.

    Returns:
        ``(..., 4)``.
    """
    x, h = points[..., :3], points[..., 3:]
    moved = rotate(pose[..., 3:], x) + pose[..., :3] * h
    return torch.cat((moved, h.expand(*moved.shape[:-1], 1)), -1)


def normalise(pose: Tensor) -> Tensor:
    """Scale the quaternion of a pose ``(..., 7)`` to unit length."""
    return torch.cat((pose[..., :3], so3.normalise(pose[..., 3:])), -1)


def retract(pose: Tensor, xi: Tensor) -> Tensor:
    """Left retraction ``Exp(xi) pose``, with a unit quaternion.

    Args:
        pose: ``(..., 7)``.
        xi: ``(..., 6)`` tangent ``[tau, phi]``.

    Returns:
        ``(..., 7)``.
    """
    return normalise(compose(exp(xi), pose))


def matrix(pose: Tensor) -> Tensor:
    """Homogeneous matrix ``(..., 4, 4)`` = ``[[R, t], [0, 1]]`` of a pose ``(..., 7)``."""
    upper = torch.cat((so3.matrix(pose[..., 3:]), pose[..., :3, None]), -1)
    last = torch.zeros_like(upper[..., :1, :])
    last[..., 3] = 1
    return torch.cat((upper, last), -2)


def from_matrix(m: Tensor) -> Tensor:
    """Pose ``(..., 7)`` of a matrix ``(..., 4, 4)`` or ``(..., 3, 4)`` whose upper left block is a rotation."""
    return torch.cat((m[..., :3, 3], so3.from_matrix(m[..., :3, :3])), -1)


def adjoint(pose: Tensor) -> Tensor:
    """Adjoint ``[[R, [t]x R], [0, R]]``: ``pose Exp(xi) pose^-1 = Exp(adjoint(pose) xi)``.

    Args:
        pose: ``(..., 7)``.

    Returns:
        ``(..., 6, 6)``.
    """
    r = so3.matrix(pose[..., 3:])
    tr = hat(pose[..., :3]) @ r
    upper = torch.cat((r, tr), -1)
    return torch.cat((upper, torch.cat((torch.zeros_like(r), r), -1)), -2)


# exp(u ad) is entire in u: ten Gauss nodes integrate it to the last digit for angles up to pi.
_NODES, _NODE_WEIGHTS = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(10))


def left_jacobian(xi: Tensor) -> Tensor:
    """Left Jacobian of the exponential map: ``Exp(xi + d) = Exp(left_jacobian(xi) d) Exp(xi)`` to first order in ``d``.

    The integral of ``Ad(Exp(u xi))`` over ``u`` in [0, 1] by Gauss-Legendre quadrature, without a branch at small
    angles. The right Jacobian is ``left_jacobian(-xi)``.

    Args:
        xi: ``(..., 6)`` tangent ``[tau, phi]``, ``|phi| <= pi``.

    Returns:
        ``(..., 6, 6)``.
    """
    nodes, weights = _NODES.to(xi) / 2 + 0.5, _NODE_WEIGHTS.to(xi) / 2
    return (weights[:, None, None] * adjoint(exp(xi[..., None, :] * nodes[:, None]))).sum(-3)
