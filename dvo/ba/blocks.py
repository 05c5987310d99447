"""State blocks of the common variables."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral

import numpy as np
import torch
from torch import Tensor

from dvo.ba.limits import LARGEST, LARGEST_TURN, SHORTEST_FOCAL
from dvo.ba.problem import StateBlock
from dvo.core.errors import DvoError
from dvo.core.settings import shown
from dvo.geometry import se3, sim3, so3

POSES, INVERSE_DEPTHS, INTRINSICS = "poses", "inverse_depths", "intrinsics"
"""Names of the blocks of :func:`dvo.ba.layer.layer.bundle_adjust`; poses are world to camera (or to body)."""
VELOCITY, IMU_BIAS = "velocity", "imu_bias"
"""Of each frame: velocity of the inertial sensor in the world, m/s; biases of gyroscope and accelerometer."""
GRAVITY, LOG_SCALE, TIME_OFFSET, T_CAMERA_IMU = "gravity", "log_scale", "time_offset", "T_camera_imu"
"""Globals of :class:`dvo.ba.inertial_factor.InertialFactor`."""

REFINED = {"focal": 1, "all": 4}
"""Unknowns of the intrinsics by what is refined: one common factor of fx and fy; fx, fy, cx, cy."""


def pose_block(poses_cw: Tensor, fixed: int | Tensor | Sequence[bool] = 1, held: bool = False) -> StateBlock:
    """Poses ``(B, N, 7)`` with tangents ``[tau, phi]`` on the left.

    Args:
        poses_cw: world to camera.
        fixed: number of leading poses that stay, or which: bool ``(N,)``.
        held: none of them moves.
    """
    slot, free = free_slots(fixed, poses_cw.shape[1], poses_cw.device)
    return StateBlock(poses_cw, 6, se3.retract, slot, free, held or free == 0, difference=pose_difference)


def pose_difference(pose: Tensor, other: Tensor) -> Tensor:
    """Left tangent ``(..., 6)`` that takes a pose ``(..., 7)`` to another one."""
    return se3.log(se3.relative(pose, other))


def sim3_block(sims: Tensor, fixed: int | Tensor | Sequence[bool] = 1, held: bool = False) -> StateBlock:
    """Similarities ``(B, N, 8)`` with tangents ``[tau, phi, sigma]`` on the left; see :func:`pose_block`."""
    slot, free = free_slots(fixed, sims.shape[1], sims.device)
    return StateBlock(sims, 7, sim3.retract, slot, free, held or free == 0)


def inverse_depth_block(
    inverse_depths: Tensor, limits: tuple[float, float] = (1e-3, 10.0), held: bool = False
) -> StateBlock:
    """Inverse depths ``(B, K)``, kept within ``limits`` after each step; the eliminated block."""

    def retract(value: Tensor, step: Tensor) -> Tensor:
        return (value + step).clamp(*limits)

    return StateBlock(inverse_depths, 1, retract, None, inverse_depths.shape[1], held, eliminated=True)


def vector_block(value: Tensor, held: bool = False) -> StateBlock:
    """Vectors ``(B, N, D)`` that add, for example velocities or biases.

    Args:
        value: at the start.
        held: none of them moves.
    """
    return StateBlock(value, value.shape[-1], torch.add, None, value.shape[1], held, difference=_vector_difference)


def _vector_difference(value: Tensor, other: Tensor) -> Tensor:
    return other - value


def direction_block(value: Tensor, held: bool = False) -> StateBlock:
    """Unit vectors ``(B, N, 3)``, for example of gravity; two tangents along :func:`tangent_basis`.

    Args:
        value: at the start.
        held: none of them moves.
    """
    count = value.shape[1]
    return StateBlock(
        value, 2, _retract_direction, None, count, held, longest=LARGEST_TURN, difference=_direction_difference
    )


def tangent_basis(direction: Tensor) -> Tensor:
    """Two orthonormal vectors across each unit vector.

    Args:
        direction: ``(..., 3)``.

    Returns:
        ``(..., 3, 2)``, columns.
    """
    # The axis that the direction is farthest from is a constant of every derivative.
    axis = torch.nn.functional.one_hot(direction.detach().abs().argmin(-1), 3).to(direction)
    first = torch.nn.functional.normalize(so3.cross(direction, axis), dim=-1)
    return torch.stack((first, so3.cross(direction, first)), -1)


def _retract_direction(direction: Tensor, step: Tensor) -> Tensor:
    along = (tangent_basis(direction) @ step[..., None])[..., 0]
    # turned about the axis that carries the direction along the step
    turned = so3.rotate(so3.exp(so3.cross(direction, along)), direction)
    return torch.nn.functional.normalize(turned, dim=-1)


def _direction_difference(direction: Tensor, other: Tensor) -> Tensor:
    across = (tangent_basis(direction).mT @ other[..., None])[..., 0]
    sine = across.norm(dim=-1, keepdim=True)
    small = sine < 1e-12
    angle = torch.atan2(sine, (direction * other).sum(-1, keepdim=True))
    return across * torch.where(small, 1.0, angle / torch.where(small, 1.0, sine))


def extrinsics_block(T_camera_imu: Tensor, held: bool = False) -> StateBlock:
    """Extrinsics of an inertial sensor, with tangents on the left.

    Args:
        T_camera_imu: ``(B, 1, 7)``, six tangents ``[tau, phi]``; or ``(B, 1, 4)`` quaternions, whose rotation alone is
            an unknown.
        held: they stay.
    """
    if T_camera_imu.shape[-1] == 7:
        return StateBlock(T_camera_imu, 6, se3.retract, None, 1, held, difference=pose_difference)
    return StateBlock(
        T_camera_imu, 3, _retract_rotation, None, 1, held, longest=LARGEST_TURN, difference=_rotation_difference
    )


def _retract_rotation(q: Tensor, step: Tensor) -> Tensor:
    return so3.normalise(so3.multiply(so3.exp(step), q))


def _rotation_difference(q: Tensor, other: Tensor) -> Tensor:
    return so3.log(so3.multiply(other, so3.conjugate(q)))


def inertial_blocks(
    velocity: Tensor,
    bias: Tensor,
    *,
    gravity: Tensor | None = None,
    log_scale: Tensor | None = None,
    time_offset: Tensor | None = None,
    T_camera_imu: Tensor | None = None,
) -> dict[str, StateBlock]:
    """State blocks of :class:`dvo.ba.inertial_factor.InertialFactor`; a global that is not given is no unknown.

    Args:
        velocity: ``(B, N, 3)`` of the inertial sensor in the world, m/s.
        bias: ``(B, N, 6)`` gyro (rad/s) and accel (m/s^2).
        gravity: ``(B, 3)`` direction of gravity in the world, of any length.
        log_scale: ``(B,)`` logarithm of the metres in one unit of the poses.
        time_offset: ``(B,)`` seconds, inertial stamps minus those of the camera.
        T_camera_imu: ``(B, 7)``, or ``(B, 4)`` for its rotation alone; see :func:`extrinsics_block`.

    Returns:
        Blocks by name.
    """
    blocks = {VELOCITY: vector_block(velocity), IMU_BIAS: vector_block(bias)}
    if gravity is not None:
        blocks[GRAVITY] = direction_block(torch.nn.functional.normalize(gravity, dim=-1)[:, None])
    for name, value in ((LOG_SCALE, log_scale), (TIME_OFFSET, time_offset)):
        if value is not None:
            blocks[name] = vector_block(value[:, None, None])
    if T_camera_imu is not None:
        blocks[T_CAMERA_IMU] = extrinsics_block(T_camera_imu[:, None])
    return blocks


def intrinsics_block(intrinsics: Tensor, refine: str = "none", shared: bool = True) -> StateBlock:
    """Intrinsics ``(B, N, 4)`` = fx fy cx cy in pixels.

    Args:
        intrinsics: of each camera.
        refine: ``none``, ``focal`` (tangent: log of a common factor of fx and fy) or ``all`` (tangent: log fx, log fy,
            cx / fx, cy / fy).
        shared: the rows are frames of one camera and move by one common step, rather than cameras of their own.
    """
    count = intrinsics.shape[1]
    slot = torch.zeros(count, dtype=torch.long, device=intrinsics.device) if shared else None
    free = min(count, 1) if shared else count
    held = refine == "none"
    return StateBlock(intrinsics, REFINED.get(refine, 1), _retract_intrinsics, slot, free, held, longest=LARGEST_TURN)


def _retract_intrinsics(intrinsics: Tensor, step: Tensor) -> Tensor:
    focal, centre = intrinsics.split(2, -1)
    grown = (focal * step[..., :2].exp()).clamp(SHORTEST_FOCAL, LARGEST)
    return torch.cat((grown, centre if step.shape[-1] == 1 else centre + focal * step[..., 2:]), -1)


def free_slots(fixed: int | Tensor | Sequence[bool], frames: int, device: torch.device) -> tuple[Tensor, int]:
    """Row of each frame among the free ones ``(N,)``, and their number ``n``; fixed frames share the row ``n``.

    Args:
        fixed: number of leading frames that stay, or which: bool ``(N,)``.
        frames: number of frames ``N``.
        device: of the result.

    Raises:
        DvoError: a number that is negative or greater than that of the frames, or no mask of all frames.
    """
    if isinstance(fixed, Integral) and not isinstance(fixed, bool):
        leading = int(fixed)
        if not 0 <= leading <= frames:
            raise DvoError(f"is {leading}, of {frames} frames", field="fixed", remedy=f"give 0 to {frames}")
        free = frames - leading
        slot = torch.arange(frames, device=device) - leading
        return torch.where(slot < 0, free, slot), free
    stays = _mask(fixed, frames).to(device)
    free = int((~stays).sum())
    return torch.where(stays, free, (~stays).cumsum(0) - 1), free


def _mask(fixed: object, frames: int) -> Tensor:
    """A mask of all frames, or DvoError. Numbers are no mask: they could be meant as indices."""
    if isinstance(fixed, Sequence) and all(isinstance(x, (bool, np.bool_)) for x in fixed):
        fixed = torch.tensor(fixed, dtype=torch.bool)
    if isinstance(fixed, np.ndarray) and fixed.dtype == bool:
        fixed = torch.from_numpy(fixed)
    if isinstance(fixed, Tensor) and fixed.dtype == torch.bool and fixed.shape == (frames,):
        return fixed
    found = f"{fixed.dtype} of shape {tuple(fixed.shape)}" if isinstance(fixed, Tensor) else shown(fixed)
    what = f"is {found}, neither a number of frames nor a mask of {frames}"
    raise DvoError(what, field="fixed", remedy=f"give a whole number, or bool ({frames},)")
