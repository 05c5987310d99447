"""Uncertainty of the newest pose of a tracker: its covariance, from the marginal of the window, and a confidence.

The covariance is that of the pose relative to the *reference*, held fixed: the oldest keyframe of the window that a
measurement of bundle adjustment still reaches. (All measurements of the keyframes before it have left the window;
these keyframes wait to be archived.) Scale is a gauge: the RMS distance from the reference of the keyframes between the
two is held fixed as well, at its value in the segment, unless depths of the window are measured (by a depth camera or
a right image): these determine the scale, and their priors are measurements like the others. All other poses and the
inverse depths are marginalised.

Measurements have the variance ``sigma^2 / confidence`` (:attr:`dvo.odometry.config.TrackerConfig.sigma`). Their errors
are not independent: a patch that is off is off in all frames. :attr:`TrackerConfig.covariance_scale`, the mean
normalised error squared on rendered sequences, accounts for it (docs/uncertainty.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from dvo.ba.blocks import INVERSE_DEPTHS
from dvo.ba.covariance import marginal_covariance, size_gradient
from dvo.ba.linearisation import NormalEquations
from dvo.ba.options import BADamping, BAOptions
from dvo.ba.window_equations import window_equations
from dvo.graph.window import Window
from dvo.odometry.config import TrackerConfig
from dvo.odometry.depth_factor import depth_factors
from dvo.odometry.window_measurements import Later, Waiting, WindowMeasurements
from dvo.odometry.window_step import WindowStep

TOLERANCE = 0.5
"""Reprojection error that the confidence is the probability of staying below, pixels of an image of 320x240."""
DAMPING = BADamping(pose=1e-6, relative=0.0)
"""Prior of the marginal, which matters only to unknowns that nothing measures."""

_PIXELS = 320 * 240
_DEPTH_FRAMES = 3  # newest frames whose median depth is taken for that of the scene
_GRID = (np.stack(np.meshgrid(np.arange(4), np.arange(3)), -1).reshape(-1, 2) + 0.5) / (4, 3)  # as shares of the image


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of the newest pose of a window.

    Attributes:
        covariance: ``(6, 6)`` float64, see :attr:`dvo.odometry.protocol.Estimate.covariance`; None if the measurements
            do not determine the pose.
        reference: time of the reference, seconds.
        confidence: in [0, 1], see :func:`confidence_of`.
    """

    covariance: np.ndarray | None = None
    reference: float | None = None
    confidence: float = 0.0


UNKNOWN = Uncertainty()
"""Uncertainty without a pose."""


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


@dataclass(frozen=True)
class LaterUncertainty:
    """Uncertainty that is computed when a value of it is first read; see :class:`Uncertainty` for the values.

    Attributes:
        found: the uncertainty.
    """

    found: Later[Uncertainty]

    def covariance(self) -> np.ndarray | None:
        """See :attr:`Uncertainty.covariance`."""
        return self.found().covariance

    def reference(self) -> float | None:
        """See :attr:`Uncertainty.reference`."""
        return self.found().reference

    def confidence(self) -> float:
        """See :attr:`Uncertainty.confidence`."""
        return self.found().confidence


def later_uncertainty(
    step: WindowStep, config: TrackerConfig, waiting: Waiting[Uncertainty] | None = None
) -> LaterUncertainty:
    """:func:`newest_uncertainty` of the window as it is now, computed when it is first read, with the same bytes.

    Args:
        step, config: see :func:`newest_uncertainty`.
        waiting: keeps the number of windows bounded that are held for this; None for no bound.

    Returns:
        The uncertainty.
    """
    found = Later(partial(_uncertainty, WindowMeasurements.of(step), config))
    if waiting is not None:
        waiting.add(found)
    return LaterUncertainty(found)


def window_gauge(window: Window | WindowMeasurements) -> Gauge | None:
    """Gauge of the covariance of the newest frame.

    Args:
        window: keyframes and edges.

    Returns:
        The gauge; None if the newest frame has no measurements, or fewer than two other frames have.
    """
    n = len(window.poses_cw)
    counts = torch.bincount(torch.cat([window.kk // window.per_frame, window.jj]), minlength=n)
    found = [k for k, count in enumerate(counts.tolist()) if count]
    if len(found) < 3 or found[-1] != n - 1:
        return None
    return Gauge(found[0], tuple(found[1:-1]))


def newest_uncertainty(step: WindowStep, config: TrackerConfig) -> Uncertainty:
    """Uncertainty of the pose of the newest frame of a window. Nothing changes.

    Args:
        step: of the model on the window, after a step.
        config: scale of the covariance.

    Returns:
        The uncertainty; without covariance and with a confidence of zero where the measurements do not determine the
        pose.
    """
    return _uncertainty(WindowMeasurements.of(step), config)


@torch.no_grad()
def _uncertainty(window: WindowMeasurements, config: TrackerConfig) -> Uncertainty:
    gauge = window_gauge(window)
    if gauge is None:
        return UNKNOWN
    reference = window.timestamps[gauge.reference]
    covariance = config.sigma**2 * config.covariance_scale * _marginal(window, gauge)
    if not np.isfinite(covariance).all():
        return Uncertainty(None, reference)
    intrinsics = window.camera[-1].double().cpu().numpy()
    metric = flow_metric(intrinsics, window.bounds, _median(window.centres[:, 2], window.per_frame))
    return Uncertainty(covariance, reference, confidence_of(covariance, metric))


def _marginal(w: WindowMeasurements, gauge: Gauge) -> np.ndarray:
    """Covariance ``(6, 6)`` of the newest pose for measurements of the variance ``1 / confidence``; on the CPU.

    The problem is that of the frames from the reference on. The weights are the confidence also where measurements are
    aligned: ``sigma`` belongs to it.
    """
    n, first, m = len(w.poses_cw), gauge.reference, w.per_frame
    kk = w.kk.cpu()
    source = int(kk.min()) // m  # frame of the oldest patches with a measurement
    centres = w.centres[source * m :].cpu()
    prior = _depth_information(w.depths[source:], centres[:, 2], m)
    # A scale that weak priors determine is a small difference of large sums.
    kind = centres.dtype if prior is None else torch.float64
    patches = centres.to(kind).unflatten(0, (-1, m))
    intrinsics = torch.stack(w.camera[first:])
    poses, intrinsics, targets, confidence = (
        x.cpu().to(kind) for x in (w.poses_cw[first:], intrinsics, w.targets, w.confidence)
    )
    equations = window_equations(
        poses, patches[..., :2], patches[..., 2], intrinsics, targets, confidence, w.jj.cpu() - first,
        kk - source * m, source - first, BAOptions(bounds=w.bounds, kernel=w.kernel),
    )  # fmt: skip
    free = torch.tensor([*gauge.members, n - 1]) - first
    rows = (6 * free[:, None] + torch.arange(6)).flatten()
    h_pp, h_pl = equations.h_pp[0, rows][None, :, rows], equations.h_pl[:, rows]
    h_ll = equations.h_ll + DAMPING.depth
    size = None
    if prior is None:
        size = size_gradient(poses[None], 0, free[:-1].tolist())[:, free].flatten(1)
    else:
        h_ll = h_ll + prior
    equations = NormalEquations(h_pp, h_pl, h_ll, equations.g_p[:, rows], equations.g_l)
    found = marginal_covariance(equations, torch.arange(len(rows) - 6, len(rows)), DAMPING, size)[0]
    return ((found + found.T) / 2).numpy()


def _depth_information(depths: tuple[Tensor | None, ...], inverse_depth: Tensor, m: int) -> Tensor | None:
    """Weights ``(1, K)`` of the priors of measured depths, the robust kernel included; None without a measured one."""
    known = [torch.zeros(m, 2) if one is None else one.cpu() for one in depths]
    prior = torch.zeros(1, len(inverse_depth), dtype=torch.float64)
    for factor in depth_factors(torch.cat(known).double()):
        linear = factor.linearise({INVERSE_DEPTHS: inverse_depth[None].double()})
        prior[:, linear.indices[0]] += linear.weight[..., 0]
    return prior if bool((prior > 0).any()) else None


def median_inverse_depth(window: Window) -> float:
    """Median inverse depth of the patches of the newest frames of a window."""
    return _median(window.patches[:, 2, 0, 0], window.per_frame)


def _median(inverse_depths: Tensor, per_frame: int) -> float:
    return float(inverse_depths[-_DEPTH_FRAMES * per_frame :].median())


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
