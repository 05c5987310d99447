"""Least-squares alignment of point sets."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.geometry import sim3, so3

AlignMode = Literal["none", "scale", "se3", "sim3"]

_RANK = 1e-9  # a direction whose spread is smaller than this fraction of the largest counts as zero


def align(source: Tensor | np.ndarray, target: Tensor | np.ndarray, mode: AlignMode = "sim3") -> Tensor:
    """Least-squares alignment: minimises ``sum |s R source + t - target|^2`` (Umeyama 1991).

    Args:
        source: ``(N, 3)`` points, for example estimated camera centres.
        target: ``(N, 3)`` the same points in the other frame.
        mode: ``none``; ``scale`` (about the common origin, no rotation, no translation); ``se3``; ``sim3``.

    Returns:
        ``(8,)`` float64 similarity, see :mod:`dvo.geometry.sim3`. Undetermined parts take their neutral value: the
        scale is 1 if either set has no extent, and of the rotations that map one line onto another the smallest is
        taken.

    Raises:
        DvoError: shapes that differ, no points, numbers that are not finite, or an unknown mode.

    Example:
        >>> from dvo.geometry import sim3
        >>> aligned = sim3.act(align(estimated_centres, true_centres), estimated_centres)
    """
    x, y = (torch.as_tensor(p).detach().to("cpu", torch.float64) for p in (source, target))
    if mode not in get_args(AlignMode):
        known = ", ".join(get_args(AlignMode))
        raise DvoError(f"unknown alignment {mode!r}", field="align", remedy=f"use one of {known}")
    if x.shape != y.shape or x.dim() != 2 or x.shape[-1] != 3 or len(x) == 0:
        raise DvoError(f"cannot align points of shapes {tuple(x.shape)} and {tuple(y.shape)}", remedy="give two (N, 3)")
    if not bool(torch.isfinite(x).all() and torch.isfinite(y).all()):
        raise DvoError("cannot align points that are not finite")
    sim = sim3.identity(dtype=torch.float64)
    if mode == "none":
        return sim
    if mode == "scale":
        sim[7] = _ratio((x * y).sum(), (x * x).sum())
        return sim
    middle_x, middle_y = x.mean(0), y.mean(0)
    x, y = x - middle_x, y - middle_y
    r, spread = _best_rotation(x, y)
    sim[3:7] = so3.from_matrix(r)
    if mode == "sim3":
        sim[7] = _ratio(spread, (x * x).sum())
    sim[:3] = middle_y - sim[7] * (r @ middle_x)
    return sim


def _ratio(top: Tensor, bottom: Tensor) -> float:
    """Ratio as a scale, 1 where it is not determined."""
    return float(top / bottom) if top > 0 and bottom > 0 and torch.isfinite(top / bottom) else 1.0


def _best_rotation(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation ``R (3, 3)`` that maximises ``sum y . R x``, and the maximum."""
    u, d, vt = torch.linalg.svd(y.T @ x)
    sign = torch.ones_like(d)
    sign[2] = torch.sign(torch.det(u) * torch.det(vt))
    if d[0] == 0:
        return torch.eye(3, dtype=x.dtype), d[0]
    if d[1] > _RANK * d[0]:
        return (u * sign) @ vt, (d * sign).sum()
    # One line onto another: rotate about their common normal.
    a, b = vt[0], u[:, 0]
    axis = torch.linalg.cross(a, b)
    if a @ b < -1 + 1e-12:
        axis = vt[1]  # half a turn, about any normal
    q = torch.cat((axis, (1 + a @ b).clamp(min=0)[None]))
    return so3.matrix(q / q.norm()), d[0]
