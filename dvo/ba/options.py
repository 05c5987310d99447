"""Options and result of :func:`dvo.ba.layer.layer.bundle_adjust`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.core.errors import DvoError

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
    """

    pose: float = 0.1
    relative: float = 1e-4
    depth: float = 1e-4


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
        fixed: number of leading poses that stay, or which: bool ``(N,)``.
        iterations: number of Gauss-Newton steps.
        damping: see :class:`BADamping`.
        structure_only: poses stay.
        motion_only: inverse depths stay.
        bounds: ``(width, height)`` of the feature map; a projection more than 64 px outside does not count.
        max_residual: pixels; an edge with a longer residual does not count.
        depth_range: inverse depths are clamped to it.
        kernel: robust kernel of the weighted residuals.
        refine_intrinsics: ``none``; ``focal`` (one common factor of fx and fy); ``all`` (fx, fy, cx, cy). The
            correction is shared by all frames, or is one for each sensor.
        sensors: cameras of a rig; then poses are world to body and intrinsics ``(B, S, 4)``.
        check: raise on edge indices out of range and on negative weights. None: only if the tensors are on the CPU, as
            an accelerator would have to be waited for.
        report: fill ``cost`` and ``inliers`` of the result.
        covariance: frames whose joint covariance is wanted.
        sigma: standard deviation of a measurement of weight 1, for the covariance alone.

    Raises:
        DvoError: unknown ``refine_intrinsics``, a negative number of iterations, or a ``sigma`` that is not positive.
    """

    fixed: int | Tensor | Sequence[bool] = 1
    iterations: int = 2
    damping: BADamping = BADamping()  # noqa: RUF009 (frozen)
    structure_only: bool = False
    motion_only: bool = False
    bounds: tuple[float, float] | None = None
    max_residual: float = 128.0
    depth_range: tuple[float, float] = (1e-3, 10.0)
    kernel: Kernel = Kernel()  # noqa: RUF009 (frozen)
    refine_intrinsics: Refine = "none"
    sensors: Sensors | None = None
    check: bool | None = None
    report: bool = False
    covariance: Sequence[int] | None = None
    sigma: float = 1.0

    def __post_init__(self) -> None:
        if self.refine_intrinsics not in _REFINE:
            known = ", ".join(_REFINE)
            raise DvoError(
                f"unknown value {self.refine_intrinsics!r}", field="refine_intrinsics", remedy=f"use one of {known}"
            )
        if self.iterations < 0:
            raise DvoError(f"is {self.iterations}, negative", field="iterations", remedy="give 0 or more")
        if not self.sigma > 0:
            raise DvoError(f"is {self.sigma}, not positive", field="sigma", remedy="give a positive number of pixels")


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
