"""Edges of a pose graph whose motions all lie in the plane ``z = 0``: three coordinates instead of six.

What :func:`dvo.ba.pose_graph.residuals_and_jacobians` has in the coordinates :data:`PLANE`, from angles and a few
products. The other coordinates are no unknowns: they and their gradient are zero, and so they stay, even where so
little information holds the poses in the plane that chi2 would be lower outside it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dvo.geometry import se3

PLANE = (0, 1, 5)
"""Coordinates of a motion in the plane."""


def in_plane(poses_cw: Tensor, measurements: Tensor, information: Tensor | None) -> bool:
    """Whether all motions lie in the plane, and no information ties the other coordinates to it.

    Args:
        poses_cw: ``(N, 7)``, or ``(N, 8)``, which never do.
        measurements: ``(E, 7)``.
        information: ``(E, 6, 6)`` or None.
    """
    if poses_cw.shape[-1] != 7 or any(bool((x[:, 2:5] != 0).any()) for x in (poses_cw, measurements)):
        return False
    return information is None or not bool((information[:, PLANE][:, :, (2, 3, 4)] != 0).any())


def flattened(poses: Tensor) -> Tensor:
    """Poses ``(N, 7)`` in the plane without what rounding left outside it."""
    return se3.normalise(poses * poses.new_tensor([1, 1, 0, 0, 0, 1, 1]))


def cotangent_terms(square: Tensor) -> tuple[Tensor, Tensor]:
    """``f = (1 - theta/2 cot(theta/2)) / theta^2`` and ``f' / theta`` for ``theta^2`` of at most ``pi^2``."""
    small = square < 0.04
    safe = torch.where(small, 1.0, square)
    theta = safe.sqrt()
    half = theta / 2
    cot = half.cos() / half.sin()
    f = torch.where(
        small, _even(square, 1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160), (1 - half * cot) / safe
    )
    slope = ((half * (1 + cot * cot) - cot) / (2 * theta) - 2 * f) / safe
    return f, torch.where(small, _even(square, 1 / 360, 1 / 7560, 1 / 201600, 1 / 5987520), slope)


def _even(square: Tensor, *coefficients: float) -> Tensor:
    """``sum c_k square^k``."""
    out = torch.zeros_like(square)
    for c in reversed(coefficients):
        out = out * square + c
    return out


def planar_edges(
    poses_cw: Tensor, ii: Tensor, jj: Tensor, measurements: Tensor, chart: str, jacobians: bool
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Errors ``(E, 3)`` and, where asked for, their derivatives ``J_i`` and ``J_j (E, 3, 3)``.

    Args:
        poses_cw, ii, jj, measurements, chart: as of :func:`dvo.ba.pose_graph.optimise_pose_graph`, all in the plane.
        jacobians: whether they are asked for.
    """
    turn = 2 * torch.atan2(poses_cw[:, 5], poses_cw[:, 6])
    delta = turn[jj] - turn[ii]
    x, y = _moved(delta, poses_cw[ii, 0], poses_cw[ii, 1])
    x, y = poses_cw[jj, 0] - x, poses_cw[jj, 1] - y  # of T_j T_i^-1
    angle = 2 * torch.atan2(measurements[:, 5], measurements[:, 6]) - delta
    cos, sin = angle.cos(), angle.sin()
    angle = torch.atan2(sin, cos)
    u, v = measurements[:, 0] - (cos * x - sin * y), measurements[:, 1] - (sin * x + cos * y)
    if chart == "log":
        f, slope = cotangent_terms(angle.square())
        h = 1 - f * angle.square()
        e = torch.stack((h * u + 0.5 * angle * v, h * v - 0.5 * angle * u, angle), -1)
    else:
        e = torch.stack((u, v, angle if chart == "split" else (0.5 * angle).sin()), -1)
    if not jacobians:
        return e, None, None
    by_right = e.new_zeros(len(e), 3, 3)
    if chart == "log":
        steep = -angle * (2 * f + slope * angle.square())  # dh / d angle
        by_right[:, 0, 0] = by_right[:, 1, 1] = h * cos + 0.5 * angle * sin
        by_right[:, 1, 0] = h * sin - 0.5 * angle * cos
        by_right[:, 0, 1] = -by_right[:, 1, 0]
        by_right[:, 0, 2], by_right[:, 1, 2] = steep * u + 0.5 * v, steep * v - 0.5 * u
        by_right[:, 2, 2] = 1
    else:
        by_right[:, 0, 0] = by_right[:, 1, 1] = cos
        by_right[:, 1, 0], by_right[:, 0, 1] = sin, -sin
        by_right[:, 2, 2] = 1 if chart == "split" else 0.5 * (0.5 * angle).cos()
    adjoint = e.new_zeros(len(e), 3, 3)
    adjoint[:, 0, 0] = adjoint[:, 1, 1] = delta.cos()
    adjoint[:, 1, 0], adjoint[:, 2, 2] = delta.sin(), 1
    adjoint[:, 0, 1] = -adjoint[:, 1, 0]
    adjoint[:, 0, 2], adjoint[:, 1, 2] = y, -x
    return e, by_right @ adjoint, -by_right


def _moved(angle: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """A point turned by an angle."""
    cos, sin = angle.cos(), angle.sin()
    return cos * x - sin * y, sin * x + cos * y
