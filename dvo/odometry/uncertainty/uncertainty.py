"""Uncertainty of the newest pose of a tracker: its covariance, from the marginal of the window, and a confidence.

The covariance is that of the pose relative to the *reference*, held fixed: the oldest keyframe of the window that a
measurement of bundle adjustment still reaches. (All measurements of the keyframes before it have left the window;
these keyframes wait to be archived.) Scale is a gauge: the RMS distance from the reference of the keyframes between the
two is held fixed as well, at its value in the segment, unless depths of the window are measured (by a depth camera or
a right image): these determine the scale, and their priors are measurements like the others. All other poses and the
inverse depths are marginalised.

Measurements have the variance ``sigma^2 / confidence`` (:attr:`dvo.odometry.patch.config.TrackerConfig.sigma`). Their
errors are not independent: a patch that is off is off in all frames. :attr:`TrackerConfig.covariance_scale`, the mean
normalised error squared on rendered sequences, accounts for it (docs/uncertainty.md).

While a window may have a second solution, covariance and confidence are those of the mixture of the two
(:mod:`dvo.odometry.uncertainty.second_solution`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from dvo.ba.blocks import INVERSE_DEPTHS
from dvo.ba.covariance import marginal_covariance, size_gradient
from dvo.ba.kernels import Kernel
from dvo.ba.layer.linearisation import NormalEquations
from dvo.ba.layer.window_equations import window_equations
from dvo.ba.multistart import Solution
from dvo.ba.options import BADamping, BAOptions
from dvo.ba.patch_problem import PatchProblem
from dvo.core.context import in_own_context
from dvo.map.measurements import depth_factors
from dvo.map.window import Window
from dvo.odometry.uncertainty.displacement import confidence_of, flow_metric
from dvo.odometry.uncertainty.gauge import Gauge, window_gauge
from dvo.odometry.uncertainty.second_solution import second_solutions, window_solutions
from dvo.odometry.window.patch_window import PatchWindow

DAMPING = BADamping(pose=1e-6, relative=0.0)
"""Prior of the marginal, which matters only to unknowns that nothing measures."""
_DEPTH_FRAMES = 3  # newest frames whose median depth is taken for that of the scene


@dataclass(frozen=True)
class WindowMeasurements:
    """Measurements of a window at a moment, for what is computed from them later, and only if somebody asks.

    Attributes:
        problem: of the patch centres, weighted by the confidence of the network, with measured depths as factors. It
            shares tensors with the window, which replaces its own.
        timestamps: of the frames, seconds.
        bounds, kernel: of bundle adjustment.
    """

    problem: PatchProblem
    timestamps: tuple[float, ...]
    bounds: tuple[int, int]
    kernel: Kernel

    @classmethod
    def of(cls, window: PatchWindow) -> WindowMeasurements:
        """Measurements of a window.

        Args:
            window: after a step.

        Returns:
            What no later step changes.
        """
        data: Window = window.window
        middle = data.patches.shape[-1] // 2
        centres = data.patches[:, :, middle : middle + 1, middle : middle + 1].clone()
        depths = depth_factors(data.measured)
        problem = data.problem().with_values(patches=centres, weights=data.confidence, factors=depths)
        times = tuple(frame.timestamp for frame in data.frames)
        return cls(problem, times, window.bounds, window.settings.kernel)

    def with_frame(
        self, timestamp: float, pose_cw: np.ndarray, kk: np.ndarray, targets: np.ndarray, confidence: np.ndarray
    ) -> WindowMeasurements:
        """Same measurements with those of a frame that is not in the window.

        Args:
            timestamp: of the frame, seconds, after the others.
            pose_cw: ``(7,)`` world to camera.
            kk: ``(e,)`` patches of the window that were measured in it.
            targets, confidence: ``(e, 2)`` feature pixels, and as of the network.

        Returns:
            The measurements with one frame more, whose own patches have none.
        """
        p, m = self.problem, self.problem.per_frame
        index = torch.from_numpy(kk).to(p.kk)
        values = (p.poses_cw, pose_cw[None]), (p.targets, targets), (p.weights, confidence)
        poses, measured, weights = (torch.cat([own, torch.from_numpy(new).to(own)]) for own, new in values)
        problem = p.with_values(
            poses_cw=poses, targets=measured, weights=weights,
            patches=torch.cat([p.patches, p.patches[-m:]]), intrinsics=torch.cat([p.intrinsics, p.intrinsics[-1:]]),
            ii=torch.cat([p.ii, index // m]), jj=torch.cat([p.jj, torch.full_like(index, len(p.poses_cw))]),
            kk=torch.cat([p.kk, index]),
        )  # fmt: skip
        return replace(self, problem=problem, timestamps=(*self.timestamps, timestamp))

    def at(self, problem: PatchProblem) -> WindowMeasurements:
        """Same measurements at another solution.

        Args:
            problem: at the solution.

        Returns:
            The measurements with its poses and patches.
        """
        own = self.problem
        now = own.with_values(poses_cw=problem.poses_cw.to(own.poses_cw), patches=problem.patches.to(own.patches))
        return replace(self, problem=now)


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of the newest pose of a window.

    Attributes:
        covariance: ``(6, 6)`` float64, see :attr:`dvo.odometry.protocol.Estimate.covariance`; None if the measurements
            do not determine the pose.
        reference: time of the reference, seconds.
        confidence: in [0, 1], see :func:`dvo.odometry.uncertainty.displacement.confidence_of`.
    """

    covariance: np.ndarray | None = None
    reference: float | None = None
    confidence: float = 0.0


UNKNOWN = Uncertainty()
"""Uncertainty without a pose."""


class LaterUncertainty:
    """:func:`newest_uncertainty` of the window as it is now, computed when a value of it is first read.

    The bytes are those that it would have had at once. Until then the measurements of the window are held.

    Args:
        window: its measurements now.
        variance, ambiguous: see :func:`newest_uncertainty`.
    """

    def __init__(self, window: WindowMeasurements, variance: float, ambiguous: bool = False) -> None:
        self._compute: Callable[[], Uncertainty] | None
        self._compute = partial(_uncertainty, window, variance, ambiguous)
        self._found = UNKNOWN

    @in_own_context
    def _value(self) -> Uncertainty:
        compute = self._compute  # of two threads that ask at once, both compute the same
        if compute is not None:
            self._found = compute()
            self._compute = None  # with the measurements
        return self._found

    def covariance(self) -> np.ndarray | None:
        """See :attr:`Uncertainty.covariance`."""
        return self._value().covariance

    def reference(self) -> float | None:
        """See :attr:`Uncertainty.reference`."""
        return self._value().reference

    def confidence(self) -> float:
        """See :attr:`Uncertainty.confidence`."""
        return self._value().confidence


def newest_uncertainty(window: PatchWindow, variance: float, ambiguous: bool = False) -> Uncertainty:
    """Uncertainty of the pose of the newest frame of a window. Nothing changes.

    Args:
        window: after a step.
        variance: of a measurement of confidence 1, and what is beyond it
            (:attr:`dvo.odometry.patch.config.TrackerConfig.variance`), feature pixels squared.
        ambiguous: the window may have a second solution, which is looked for.

    Returns:
        The uncertainty; without covariance and with a confidence of zero where the measurements do not determine the
        pose.
    """
    return _uncertainty(WindowMeasurements.of(window), variance, ambiguous)


def window_metric(window: WindowMeasurements) -> np.ndarray:
    """:func:`dvo.odometry.uncertainty.displacement.flow_metric` of the newest frame of a window.

    Args:
        window: its measurements.

    Returns:
        ``(6, 6)`` float64.
    """
    problem = window.problem
    depths = problem.inverse_depths[-_DEPTH_FRAMES * problem.per_frame :]
    return flow_metric(problem.intrinsics[-1].double().cpu().numpy(), window.bounds, float(depths.median()))


@torch.no_grad()
def has_second_solution(window: PatchWindow, variance: float, solved: Sequence[Solution]) -> bool:
    """Tell if another solution of a window is nearly as good as the present one.

    Args:
        window: at the first of the solutions.
        variance: of a measurement of confidence 1, and what is beyond it
            (:attr:`dvo.odometry.patch.config.TrackerConfig.variance`), feature pixels squared.
        solved: solutions of the window.

    Returns:
        True if covariance and confidence have to take another one into account.
    """
    measured = WindowMeasurements.of(window)
    gauge = window_gauge(measured.problem)
    if gauge is None or len(solved) < 2:
        return False
    covariance = _covariance(measured, gauge, variance)
    return covariance is not None and bool(second_solutions(solved, gauge, covariance, window_metric(measured)))


@torch.no_grad()
def _uncertainty(window: WindowMeasurements, variance: float, ambiguous: bool) -> Uncertainty:
    gauge = window_gauge(window.problem)
    if gauge is None:
        return UNKNOWN
    reference = window.timestamps[gauge.reference]
    covariance = _covariance(window, gauge, variance)
    if covariance is None:
        return Uncertainty(None, reference)
    metric = window_metric(window)
    confidence = confidence_of(covariance, metric)
    others = second_solutions(window_solutions(window.problem), gauge, covariance, metric) if ambiguous else []
    if not others:
        return Uncertainty(covariance, reference, confidence)
    share = 1 - sum(other.probability for other in others)
    mixture = share * covariance
    for other in others:
        own = _covariance(window.at(other.solution.problem), gauge, variance)
        own = covariance if own is None else own
        mixture = mixture + other.probability * (own + np.outer(other.error, other.error))
    return Uncertainty(mixture, reference, share * confidence)


def _covariance(window: WindowMeasurements, gauge: Gauge, variance: float) -> np.ndarray | None:
    """Covariance ``(6, 6)`` of the newest pose, of one solution; None if the measurements do not determine it."""
    covariance = variance * _marginal(window, gauge)
    return covariance if np.isfinite(covariance).all() else None


def _marginal(w: WindowMeasurements, gauge: Gauge) -> np.ndarray:
    """Covariance ``(6, 6)`` of the newest pose for measurements of the variance ``1 / confidence``; on the CPU.

    The problem is that of the frames from the reference on. The weights are the confidence also where measurements are
    aligned: ``sigma`` belongs to it.
    """
    p, first, m = w.problem, gauge.reference, w.problem.per_frame
    n, kk = len(p.poses_cw), p.kk.cpu()
    source = int(kk.min()) // m  # frame of the oldest patches with a measurement
    prior = _depth_information(p)
    # A scale that weak priors determine is a small difference of large sums.
    kind = p.patches.dtype if prior is None else torch.float64
    real = p.poses_cw[first:], p.intrinsics[first:], p.targets, p.weights, p.patches[source * m :, :, 0, 0]
    poses, intrinsics, targets, confidence, centres = (x.cpu().to(kind) for x in real)
    patches = centres.unflatten(0, (-1, m))
    equations = window_equations(
        poses, patches[..., :2], patches[..., 2], intrinsics, targets, confidence, p.jj.cpu() - first,
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
        h_ll = h_ll + prior[:, source * m :]
    equations = NormalEquations(h_pp, h_pl, h_ll, equations.g_p[:, rows], equations.g_l)
    found = marginal_covariance(equations, torch.arange(len(rows) - 6, len(rows)), DAMPING, size)[0]
    return ((found + found.T) / 2).numpy()


def _depth_information(problem: PatchProblem) -> Tensor | None:
    """Weights ``(1, K)`` of the priors of measured depths, the robust kernel included; None without a measured one."""
    depths = problem.inverse_depths.cpu().double()[None]
    prior = torch.zeros_like(depths)
    for factor in problem.factors:
        linear = factor.exact().linearise({INVERSE_DEPTHS: depths})
        prior[:, linear.indices[0]] += linear.weight[..., 0]
    return prior if bool((prior > 0).any()) else None
