"""Displacement in the image that the error of a pose causes, and the probability that it is small."""

from __future__ import annotations

import math

import numpy as np
import torch

TOLERANCE = 0.5
"""Reprojection error that the confidence is the probability of staying below, pixels of an image of 320x240."""

_PIXELS = 320 * 240
_GRID = (np.stack(np.meshgrid(np.arange(4), np.arange(3)), -1).reshape(-1, 2) + 0.5) / (4, 3)  # as shares of the image


def flow_metric(intrinsics: np.ndarray, size: tuple[int, int], inverse_depth: float) -> np.ndarray:
    """Matrix ``M`` of the mean squared displacement ``xi^T M xi`` that a pose error causes in the image.

    The mean is over a grid of 12 points of the image at one depth, in pixels of an image of 320x240 (as many pixels, if
    the aspect differs).

    Args:
        intrinsics: ``(4,)`` fx fy cx cy.
        size: width and height of the image or feature map that they belong to.
        inverse_depth: of the points, in inverse units of the segment.

    Returns:
        ``(6, 6)`` float64.
    """
    fx, fy, cx, cy = intrinsics
    points = _GRID * size
    x, y = (points[:, 0] - cx) / fx, (points[:, 1] - cy) / fy
    o, d = np.zeros_like(x), np.full_like(x, inverse_depth)
    along_x, along_y = (d, o, -d * x, -x * y, 1 + x * x, -y), (o, d, -d * y, -1 - y * y, x * y, x)
    rows = np.stack([fx * np.stack(along_x), fy * np.stack(along_y)]) * math.sqrt(_PIXELS / (size[0] * size[1]))
    return np.asarray(np.einsum("aip,ajp->ij", rows, rows) / len(points))


def confidence_of(covariance: np.ndarray, metric: np.ndarray, tolerance: float = TOLERANCE) -> float:
    """Probability that the RMS displacement that the pose error causes in the image is below a tolerance.

    Under a Gaussian error the squared displacement is a sum of weighted chi-squares; the gamma distribution with its
    mean and variance stands for it (Satterthwaite, "An approximate distribution of estimates of variance components",
    1946).

    Args:
        covariance: ``(6, 6)`` of the pose error.
        metric: of :func:`flow_metric`.
        tolerance: pixels of an image of 320x240.

    Returns:
        In [0, 1]; 0 for a covariance that is not finite.
    """
    if not np.isfinite(covariance).all():
        return 0.0
    product = covariance @ metric
    mean, half_variance = float(np.trace(product)), float((product * product.T).sum())
    if not (mean > 0 and half_variance > 0):
        return 0.0
    shape = mean**2 / (2 * half_variance)
    arguments = torch.tensor([shape, shape * tolerance**2 / mean], dtype=torch.float64)
    return float(torch.special.gammainc(*arguments))
