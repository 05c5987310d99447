"""Unit quaternions ``(..., 4)`` in the order ``qx qy qz qw`` and rotation vectors ``(..., 3)`` in radians.

Plain functions on tensors of any batch shape; batch dimensions broadcast. Every branch is taken with ``torch.where`` on
inputs made safe beforehand, so that values and gradients are finite at the identity, at ``q = -identity`` and at half
a turn.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dvo.geometry.bounds import SMALL

# A product of quaternions, the matrix of one, and the matrix of a cross product are fixed linear maps of the (pairs of)
# numbers. Written as one matrix product they take a tenth of the calls, which is what counts on the few poses of a
# window.
_MULTIPLY = torch.zeros(4, 4, 4)  # [a, b, out]
for _a, _b, _out, _sign in (
    *((3, 0, 0, 1), (0, 3, 0, 1), (1, 2, 0, 1), (2, 1, 0, -1), (3, 1, 1, 1), (0, 2, 1, -1), (1, 3, 1, 1), (2, 0, 1, 1)),
    *(
        (3, 2, 2, 1),
        (0, 1, 2, 1),
        (1, 0, 2, -1),
        (2, 3, 2, 1),
        (3, 3, 3, 1),
        (0, 0, 3, -1),
        (1, 1, 3, -1),
        (2, 2, 3, -1),
    ),
):
    _MULTIPLY[_a, _b, _out] = _sign
_HAT = torch.zeros(3, 3, 3)  # [v, row, column]
for _v, _row, _column in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):
    _HAT[_v, _row, _column], _HAT[_v, _column, _row] = 1, -1
# R v = vector part of q v q^-1
_CONJUGATE = torch.tensor([-1.0, -1.0, -1.0, 1.0])
_MATRIX = torch.einsum("avc,cbr,b->abrv", _MULTIPLY[:, :3], _MULTIPLY[..., :3], _CONJUGATE).reshape(16, 9)
_MULTIPLY, _HAT = _MULTIPLY.view(16, 4), _HAT.view(3, 9)


_MOVED: dict[tuple[int, torch.device, torch.dtype], Tensor] = {}


def _like(table: Tensor, x: Tensor) -> Tensor:
    """A constant of this file (itself, no view of it) with the type and on the device of a tensor.

    It is moved once, as that waits for the device.
    """
    if x.device == table.device:
        return table.to(x)
    key = id(table), x.device, x.dtype
    moved = _MOVED.get(key)
    if moved is None:
        with torch.inference_mode(False):  # for computations with gradients, too
            moved = _MOVED[key] = table.to(x.device, x.dtype)
    return moved


def _linear(x: Tensor, table: Tensor) -> Tensor:
    """``x (..., I)`` by ``table (I, O)``, never in the reduced precision of TF32 or autocast."""
    table = _like(table, x)
    if x.device.type == "cpu" and not torch.is_autocast_enabled("cpu"):
        return x @ table
    return (x[..., :, None] * table).sum(-2)


def _bilinear(a: Tensor, b: Tensor, table: Tensor) -> Tensor:
    """``out_o = sum_ij table_ijo a_i b_j`` with ``table (I * J, O)``."""
    return _linear((a[..., :, None] * b[..., None, :]).flatten(-2), table)


def hat(v: Tensor) -> Tensor:
    """Skew matrix ``(..., 3, 3)`` of ``v (..., 3)``: ``hat(a) b = a x b``."""
    return _linear(v, _HAT).unflatten(-1, (3, 3))


def cross(a: Tensor, b: Tensor, dim: int = -1) -> Tensor:
    """Cross product along one dimension, broadcasting."""
    return torch.linalg.cross(*torch.broadcast_tensors(a, b), dim=dim)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product ``a b`` of quaternions: first ``b``, then ``a``.

    Args:
        a, b: ``(..., 4)``; batch dimensions broadcast.

    Returns:
        ``(..., 4)``.
    """
    return _bilinear(a, b, _MULTIPLY)


def conjugate(q: Tensor) -> Tensor:
    """Conjugate of a quaternion ``(..., 4)``, the inverse of a unit one."""
    return q * _like(_CONJUGATE, q)


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors.

    Args:
        q: ``(..., 4)`` unit quaternions.
        v: ``(..., 3)``; batch dimensions broadcast.

    Returns:
        ``(..., 3)``.
    """
    return (matrix(q) * v[..., None, :]).sum(-1)


def normalise(q: Tensor) -> Tensor:
    """Scale ``(..., 4)`` to length one; a zero quaternion stays zero, with a finite gradient."""
    return torch.nn.functional.normalize(q, dim=-1)


def matrix(q: Tensor) -> Tensor:
    """Rotation matrices ``(..., 3, 3)`` of unit quaternions ``(..., 4)``."""
    return _bilinear(q, q, _MATRIX).unflatten(-1, (3, 3))


def from_matrix(r: Tensor) -> Tensor:
    """Unit quaternions of rotation matrices.

    Of the four textbook solutions the one with the largest divisor is taken (Shepperd 1978).

    Args:
        r: ``(..., 3, 3)``.

    Returns:
        ``(..., 4)`` with ``qw >= 0``.
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = r.flatten(-2).unbind(-1)
    # four times the outer product q q^T: column c is q scaled by 4 q_c
    xx, yy, zz, ww = 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22, 1 + m00 + m11 + m22
    xy, xz, yz = m01 + m10, m02 + m20, m12 + m21
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    outer = torch.stack((xx, xy, xz, wx, xy, yy, yz, wy, xz, yz, zz, wz, wx, wy, wz, ww), -1).unflatten(-1, (4, 4))
    best = torch.stack((xx, yy, zz, ww), -1).argmax(-1)
    q = normalise(torch.gather(outer, -2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2))
    return torch.where(q[..., 3:] < 0, -q, q)


def _series(s: Tensor, *coefficients: float) -> Tensor:
    """Horner: ``c0 + c1 s + c2 s^2 + ...``."""
    out = coefficients[-1] * s + coefficients[-2]
    for c in coefficients[-3::-1]:
        out = out * s + c
    return out


# k = sin(t/2)/t, cos(t/2) and c = (t - sin t)/t^3 as series in s = t^2, lowest order first
_EXP_SERIES = torch.tensor(
    [
        [1 / 2, 1.0, 1 / 6],
        [-1 / 48, -1 / 8, -1 / 120],
        [1 / 3840, 1 / 384, 1 / 5040],
        [-1 / 645120, -1 / 46080, -1 / 362880],
    ],
    dtype=torch.float64,
)


def exp_terms(phi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Quaternion of a rotation vector, and the two coefficients of the left Jacobian of SO(3).

    Args:
        phi: ``(..., 3)`` radians.

    Returns:
        ``q (..., 4)``, ``b (..., 1)`` and ``c (..., 1)`` with ``V x = x + b phi x x + c phi x (phi x x)``,
        ``b = (1 - cos t) / t^2``, ``c = (t - sin t) / t^3``.
    """
    s = (phi * phi).sum(-1, keepdim=True)
    small = s < SMALL
    safe = torch.where(small, 1.0, s)
    low = torch.where(small, s, 0.0)  # the series would overflow on a huge angle and make its gradient NaN
    t = safe.sqrt()
    sin, cos = (0.5 * t).sin(), (0.5 * t).cos()
    closed = torch.cat((sin / t, cos, (t - 2 * sin * cos) / (safe * t)), -1)
    c0, c1, c2, c3 = _like(_EXP_SERIES, phi)
    k, w, c = torch.where(small, c0 + low * (c1 + low * (c2 + low * c3)), closed).split(1, -1)
    return torch.cat((k * phi, w), -1), 2 * k * k, c


def exp(phi: Tensor) -> Tensor:
    """Unit quaternions ``(..., 4)`` of rotation vectors ``phi (..., 3)`` in radians."""
    return exp_terms(phi)[0]


def log_terms(q: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation vector of a quaternion, and the coefficient of the inverse left Jacobian of SO(3).

    ``q`` and ``-q`` are the same rotation; the one with ``qw >= 0`` is taken, hence angles in ``[0, pi]``.

    Args:
        q: ``(..., 4)`` unit quaternions.

    Returns:
        ``phi (..., 3)`` radians and ``e (..., 1)`` with ``V^-1 x = x - phi x x / 2 + e phi x (phi x x)``,
        ``e = (1 - (t/2) cot(t/2)) / t^2``.
    """
    q = torch.where(q[..., 3:] < 0, -q, q)
    v, w = q[..., :3], q[..., 3:]
    n2 = (v * v).sum(-1, keepdim=True)
    small = n2 < SMALL * w * w
    n = torch.where(small, 1.0, n2).sqrt()
    safe_w = torch.where(small, w, 1.0)
    x2 = torch.where(small, n2, 0.0) / (safe_w * safe_w)
    closed = 2 * torch.atan2(n, w) / n
    f = torch.where(small, _series(x2, 2.0, -2 / 3, 2 / 5, -2 / 7, 2 / 9) / safe_w, closed)
    phi = f * v
    s = torch.where(small, (phi * phi).sum(-1, keepdim=True), 0.0)
    t2 = torch.where(small, 1.0, closed * closed * n2)
    e = torch.where(small, _series(s, 1 / 12, 1 / 720, 1 / 30240, 1 / 1209600), (1 - 0.5 * closed * w) / t2)
    return phi, e


def log(q: Tensor) -> Tensor:
    """Rotation vectors ``(..., 3)`` in radians, length at most pi, of unit quaternions ``q (..., 4)``."""
    return log_terms(q)[0]


def angle(q: Tensor) -> Tensor:
    """Rotation angle.

    Args:
        q: ``(..., 4)`` unit quaternions.

    Returns:
        ``(...)`` radians in ``[0, pi]``. The gradient at the identity is zero, not NaN.
    """
    phi = log(q)
    s = (phi * phi).sum(-1)
    zero = s == 0
    return torch.where(zero, 0.0, torch.where(zero, 1.0, s).sqrt())
