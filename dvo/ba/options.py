"""Options and result of :func:`dvo.ba.layer.layer.bundle_adjust`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import Literal, get_args

from torch import Tensor

from dvo.ba.checks import check_number, check_positive, check_range, check_size, check_switch, check_whole
from dvo.ba.kernels import Kernel
from dvo.ba.limits import DEPTH_RANGE, LARGEST
from dvo.core.errors import DvoError
from dvo.core.settings import shown

Refine = Literal["none", "focal", "all"]
_REFINE = get_args(Refine)


@dataclass(frozen=True)
class BADamping:
    """Damping of one Gauss-Newton step; the same constants serve training and tracking.

    For damping of each inverse depth by its own amount see :class:`dvo.ba.factors.DepthDamping`.

    Attributes:
        pose: added to the diagonal of the reduced system (poses, and intrinsics if refined), in weighted pixels squared
            per unit squared.
        relative: this fraction of that diagonal is added too.
        depth: added to the curvature of each inverse depth.

    Raises:
        DvoError: a value that is not a number from 0 to 1e30.
    """

    pose: float = 0.1
    relative: float = 1e-4
    depth: float = 1e-4

    def __post_init__(self) -> None:
        for name in ("pose", "relative", "depth"):
            check_number(getattr(self, name), f"damping.{name}", 0.0, 1e30)


COLD_UPDATES = 4
"""Number of first updates of a new graph with strong damping."""


def damping_at(update: int) -> BADamping:
    """Damping of bundle adjustment at an update of a graph, which may have no starting point.

    From identity poses and constant depth, rotation and sideways translation explain the flow almost equally well. An
    undamped first step takes a huge difference of the two, and the depths then converge to the wrong side of it (the
    bas-relief ambiguity). Damping relative to the diagonal of the reduced system slows such directions down until the
    depths have begun to separate them. With exact targets, 8 frames and 10 updates of 2 steps, about half of rendered
    clips ended within 2 % of the rotation without this, and nine tenths with it
    (``tests/train/tasks/test_objective.py``).

    Args:
        update: counted from 0.
    """
    return BADamping(relative=0.1) if update < COLD_UPDATES else BADamping()


@dataclass(frozen=True)
class Sensors:
    """Several rigidly mounted cameras, for example a stereo pair.

    Attributes:
        source, target: ``(E,)`` sensor of each edge in frame i and in frame j.
        from_body: ``(S, 7)`` or ``(B, S, 7)`` extrinsics, body to sensor: a pose of the problem, world to body, times
            this is world to sensor.
    """

    source: Tensor
    target: Tensor
    from_body: Tensor


@dataclass(frozen=True)
class BAOptions:
    """Options of :func:`dvo.ba.layer.layer.bundle_adjust`.

    Attributes:
        fixed: number of leading poses that stay, at most all, or which: bool ``(N,)``.
        iterations: number of Gauss-Newton steps.
        damping: see :class:`BADamping`.
        structure_only: poses stay.
        motion_only: inverse depths stay.
        bounds: ``(width, height)`` of the feature map, positive; a projection more than 64 px outside does not count.
        max_residual: pixels, positive, infinity for no limit; an edge with a longer residual does not count.
        depth_range: inverse depths are clamped to it; the smaller one first, from 0 to 1e8.
        kernel: robust kernel of the weighted residuals.
        refine_intrinsics: ``none``; ``focal`` (one common factor of fx and fy); ``all`` (fx, fy, cx, cy). The
            correction is shared by all frames, or is one for each sensor.
        sensors: cameras of a rig; then poses are world to body and intrinsics ``(B, S, 4)``.
        check: look at the values of the tensors, as :func:`dvo.ba.layer.layer.bundle_adjust` says; an accelerator is
            waited for once. False: they are taken as they are, and nothing is promised for invalid ones. None: True.
        report: fill ``cost`` and ``inliers`` of the result.
        covariance: frames whose joint covariance is wanted.
        sigma: standard deviation of a measurement of weight 1, for the covariance alone.

    Raises:
        DvoError: a value of another type or outside the limits above.
    """

    fixed: int | Tensor | Sequence[bool] = 1
    iterations: int = 2
    damping: BADamping = BADamping()  # noqa: RUF009 (frozen)
    structure_only: bool = False
    motion_only: bool = False
    bounds: tuple[float, float] | None = None
    max_residual: float = 128.0
    depth_range: tuple[float, float] = DEPTH_RANGE
    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)
    refine_intrinsics: Refine = "none"
    sensors: Sensors | None = None
    check: bool | None = None
    report: bool = False
    covariance: Sequence[int] | None = None
    sigma: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.refine_intrinsics, str) or self.refine_intrinsics not in _REFINE:
            known, value = ", ".join(_REFINE), shown(self.refine_intrinsics)
            raise DvoError(f"unknown value {value}", field="refine_intrinsics", remedy=f"use one of {known}")
        kinds = (("damping", BADamping), ("kernel", Kernel), ("sensors", Sensors | None))
        for name, kind in kinds:
            value = getattr(self, name)
            if not isinstance(value, kind):
                raise DvoError(f"is {shown(value)}", field=name, remedy=f"give a {name.rstrip('s')} object")
        check_whole(self.iterations, "iterations")
        for name in ("structure_only", "motion_only", "report"):
            check_switch(getattr(self, name), name)
        if self.check is not None:
            check_switch(self.check, "check")
        if self.bounds is not None:
            check_size(self.bounds)
        if self.max_residual != math.inf:
            check_positive(self.max_residual, "max_residual")
        check_range(self.depth_range, "depth_range", 0.0, LARGEST)
        check_positive(self.sigma, "sigma")
        if self.covariance is not None and not _whole_numbers(self.covariance):
            raise DvoError(
                f"is {shown(self.covariance)}, not frames", field="covariance", remedy="give a list of whole numbers"
            )


def _whole_numbers(values: object) -> bool:
    if isinstance(values, Tensor):
        return values.dim() == 1 and not (values.is_floating_point() or values.is_complex())
    return isinstance(values, Sequence) and all(isinstance(x, Integral) and not isinstance(x, bool) for x in values)


@dataclass(frozen=True)
class BAResult:
    """Outcome of :func:`dvo.ba.layer.layer.bundle_adjust`.

    Attributes:
        poses_cw: ``(B, N, 7)`` world to camera (to body with several sensors).
        patches: ``(B, K, 3, p, p)`` with refined inverse depths.
        intrinsics: as given, refined if that was wanted.
        cost: ``(B,)`` weighted sum of squared residuals of all factors at the result, kernel weights included, in
            weighted pixels squared; None unless ``report``. Without gradient.
        inliers: ``(B, E)`` bool, edges that count at the result; None unless ``report``.
        covariance: ``(B, 6m, 6m)`` joint marginal covariance of the left tangents ``[tau, phi]`` of the ``m`` poses in
            ``covariance``, see :func:`dvo.ba.covariance.pose_covariance`; None unless wanted. Without gradient.
        blocks: values of the further state blocks, by name.
    """

    poses_cw: Tensor
    patches: Tensor
    intrinsics: Tensor
    cost: Tensor | None = None
    inliers: Tensor | None = None
    covariance: Tensor | None = None
    blocks: Mapping[str, Tensor] = field(default_factory=dict)
