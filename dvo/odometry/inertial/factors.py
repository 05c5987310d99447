"""Preintegrated intervals as factors of bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dvo.ba.inertial_factor import BiasWalk, InertialFactor
from dvo.ba.kernels import Kernel
from dvo.core.errors import DvoError
from dvo.data.inertial import ImuNoise
from dvo.geometry.poses import matrix_to_quaternion
from dvo.odometry.inertial.preintegration import Preintegration

STANDARD_GRAVITY = 9.80665  # m/s^2


def inertial_factors(
    intervals: Preintegration,
    noise: ImuNoise,
    T_camera_imu: np.ndarray,
    *,
    gravity: Sequence[float] | np.ndarray = (0.0, 0.0, -STANDARD_GRAVITY),
    time_offset: float = 0.0,
    ii: Tensor | None = None,
    jj: Tensor | None = None,
    state_i: Tensor | None = None,
    state_j: Tensor | None = None,
    kernel: Kernel = Kernel(),  # noqa: B008 (frozen)
) -> tuple[InertialFactor, BiasWalk]:
    """Factors of intervals, for a batch of one, in double precision.

    Args:
        intervals: ``K`` of them, all covered by samples.
        noise: whose walks the biases follow.
        T_camera_imu: ``(7,)`` inertial sensor to camera, metres.
        gravity: ``(3,)`` in the world of the poses, m/s^2; where its direction is unknown, its length alone counts.
        time_offset: that the times of the intervals were given with: inertial stamps minus those of the camera.
        ii, jj: ``(K,)`` poses at start and end; None: interval k leads from pose k to pose k + 1.
        state_i, state_j: ``(K,)`` velocities and biases there; None: they have the numbers of the poses.
        kernel: robust kernel of the whitened residual of an interval.

    Returns:
        The factor of the motions, and that of the walks of the biases.

    Raises:
        DvoError: an interval that the samples do not cover, or a covariance that is not positive definite.
    """
    if not intervals.covered.all():
        which = np.flatnonzero(~intervals.covered).tolist()
        raise DvoError(
            f"no samples for intervals {which}",
            field="intervals",
            remedy="leave them out",
        )
    count = len(intervals)
    try:
        # phi, v and p differ by orders of magnitude: of a scaled matrix the inverse is exact to more digits
        scale = np.sqrt(np.diagonal(intervals.covariance, axis1=1, axis2=2))[:, None]
        lower = np.linalg.cholesky(intervals.covariance / (scale * np.swapaxes(scale, 1, 2)))
        root = np.tril(np.linalg.inv(lower)) / scale
    except np.linalg.LinAlgError:
        raise DvoError(
            "a covariance is not positive definite", field="intervals", remedy="give noise densities above zero"
        ) from None
    by_bias = np.zeros((count, 9, 6))
    by_bias[:, :3, :3] = intervals.rotation_by_gyro
    by_bias[:, 3:6, :3], by_bias[:, 3:6, 3:] = intervals.velocity_by_gyro, intervals.velocity_by_accel
    by_bias[:, 6:, :3], by_bias[:, 6:, 3:] = intervals.position_by_gyro, intervals.position_by_accel
    first = torch.arange(count)
    ii, jj = first if ii is None else ii, first + 1 if jj is None else jj

    def tensor(x: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(x, dtype=np.float64))[None]

    factor = InertialFactor(
        duration=tensor(intervals.duration),
        rotation=tensor(matrix_to_quaternion(intervals.rotation)),
        velocity=tensor(intervals.velocity),
        position=tensor(intervals.position),
        by_bias=tensor(by_bias),
        root=tensor(root),
        bias=tensor(np.concatenate([intervals.gyro_bias, intervals.accel_bias], 1)),
        rates=tensor(intervals.rates),
        forces=tensor(intervals.forces),
        offset=tensor(np.full(count, float(time_offset))),
        gravity=tensor(np.asarray(gravity)),
        extrinsics=tensor(T_camera_imu),
        ii=ii,
        jj=jj,
        state_i=state_i,
        state_j=state_j,
        kernel=kernel,
    )
    walk = np.repeat([[noise.gyro_walk, noise.accel_walk]], 3, 1) ** 2 * intervals.duration[:, None]
    if not (walk > 0).all():
        raise DvoError("the walk of a bias is zero", field="noise", remedy="give walks above zero")
    states = ii if state_i is None else state_i, jj if state_j is None else state_j
    return factor, BiasWalk(tensor(1 / walk), *states)
