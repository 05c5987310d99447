"""The scale that measured depths fix in bundle adjustment, which images leave open.

The first pose alone is held, and scale is a free direction of the reprojection error: the priors of measured depths
(:func:`dvo.map.measurements.depth_factors`) decide it.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from dvo.map.archive import ArchivedKeyframe
from dvo.map.window import Window

MEASURED_SHARE = 0.5
"""Share of the patches with a measured depth above which these decide the relief, so that it needs no other start."""

_SCALE_REACH = 0.02  # logarithm of a scale that iterations reach: beyond it the kernel takes the influence away


def measured_share(measured: Tensor | None) -> float:
    """Share of the patches whose depth was measured.

    Args:
        measured: see :func:`dvo.map.measurements.depth_factors`.

    Returns:
        In [0, 1].
    """
    return 0.0 if measured is None or not len(measured) else float((measured[:, 1] > 0).double().mean())


def metres_of_unit(depths: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Metres that the unit of a map is long, by each patch whose depth was measured.

    Args:
        depths: ``(K,)`` inverse depths in the unit of the map.
        measured: ``(K, 2)`` see :func:`dvo.map.measurements.depth_factors`.

    Returns:
        ``(P,)`` of the patches with a measured depth, in order.
    """
    known = (measured[:, 1] > 0) & (depths > 0)
    return depths[known] / measured[known, 0]


def match_window(window: Window) -> None:
    """Bring a window to the scale of its measured depths if it is far from that, so that iterations converge.

    Args:
        window: poses and inverse depths are changed in place; lengths are scaled from the origin of the world.
    """
    if window.measured is None:
        return
    poses, depths = to_measured(window.poses_cw, window.patches[:, 2], window.measured)
    window.poses_cw, window.patches = poses, torch.cat([window.patches[:, :2], depths[:, None]], 1)


def to_measured(poses_cw: Tensor, depths: Tensor, measured: Tensor | None) -> tuple[Tensor, Tensor]:
    """Scale a solution to measured depths if it is far from them.

    Args:
        poses_cw: ``(N, 7)``; lengths are scaled from the origin of the world.
        depths: ``(K, ...)`` or ``(N, M)`` inverse depths of patches, of all of their pixels or of the centres.
        measured: ``(K, 2)`` see :func:`dvo.map.measurements.depth_factors`.

    Returns:
        Poses and inverse depths of the same shapes.
    """
    if measured is None:
        return poses_cw, depths
    centres = depths.reshape(len(measured), -1)[:, 0].double().cpu().numpy()
    factors = metres_of_unit(centres, measured.double().cpu().numpy())
    scale = float(np.median(factors)) if len(factors) else 1.0
    if abs(math.log(scale)) <= _SCALE_REACH:
        return poses_cw, depths
    return torch.cat([poses_cw[:, :3] * scale, poses_cw[:, 3:]], 1), depths / scale


def far_scale(frames: list[ArchivedKeyframe]) -> float:
    """Factor by which archived keyframes have to be scaled first, so that iterations reach their measured depths.

    Args:
        frames: of one world.

    Returns:
        Metres that the unit is long; 1 if it is nearly a metre already, or nothing was measured.
    """
    factors = [metres_of_unit(f.inverse_depth, f.measured) for f in frames if f.measured is not None]
    scale = float(np.median(np.concatenate(factors))) if sum(map(len, factors)) else 1.0
    return scale if abs(math.log(scale)) > _SCALE_REACH else 1.0
