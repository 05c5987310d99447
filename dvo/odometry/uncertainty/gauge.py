"""Gauge of a window, under which the newest pose is compared between two solutions, or with the truth.

The pose is that relative to the reference, the oldest keyframe that a measurement still reaches. Scale is free in a
monocular window: the RMS distance of the keyframes in between from the reference is held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dvo.ba.patch_problem import PatchProblem
from dvo.geometry import se3


@dataclass(frozen=True)
class Gauge:
    """Frames of a window that are held, by their positions.

    Attributes:
        reference: oldest frame with a measurement.
        members: frames with measurements between the reference and the newest one; the RMS distance of their centres
            from that of the reference is held.
    """

    reference: int
    members: tuple[int, ...]


def window_gauge(problem: PatchProblem) -> Gauge | None:
    """Gauge of the covariance of the newest frame.

    Args:
        problem: of a window.

    Returns:
        The gauge; None if the newest frame has no measurements, or fewer than two other frames have.
    """
    n = len(problem.poses_cw)
    counts = torch.bincount(torch.cat([problem.ii, problem.jj]), minlength=n)
    found = [k for k, count in enumerate(counts.tolist()) if count]
    if len(found) < 3 or found[-1] != n - 1:
        return None
    return Gauge(found[0], tuple(found[1:-1]))


def relative_error(poses_cw: Tensor, others_cw: Tensor, gauge: Gauge, metric: bool = False) -> np.ndarray:
    """Difference of the newest pose between two solutions for the frames of a window, under the gauge.

    Args:
        poses_cw, others_cw: ``(n, 7)`` world to camera, on the CPU; the second may be the truth.
        gauge: of the window.
        metric: both are in metres, and the difference of their scales counts.

    Returns:
        ``(6,)`` right tangent ``[tau, phi]`` with ``T_wc_other = T_wc Exp(xi)``, in units of the first solution and
        radians.
    """
    members, first = list(gauge.members), gauge.reference
    both = poses_cw.double(), others_cw.double()
    found, other = (se3.relative(x[first : first + 1].expand_as(x), x) for x in both)
    scale = (found[members, :3].square().sum() / other[members, :3].square().sum()).sqrt()
    newest = other[-1] if metric else torch.cat([scale * other[-1, :3], other[-1, 3:]])
    return np.asarray(se3.log(se3.compose(found[-1], se3.inverse(newest))).numpy())
