"""State blocks: the variables of a least-squares problem, their place among its unknowns, and the common ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Integral

import numpy as np
import torch
from torch import Tensor

from dvo.ba.limits import DEPTH_RANGE, LARGEST, LARGEST_TURN, SHORTEST_FOCAL
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


@dataclass(frozen=True)
class StateBlock:
    """Variables of one kind, and which of them are unknowns.

    Attributes:
        value: ``(B, N, ...)``.
        dim: size of the tangent of one element.
        retract: ``(value (B, N, ...), tangent (B, N, dim)) -> value``; the tangent of an eliminated block is
            ``(B, N)``.
        slot: ``(N,)`` unknown of each element; fixed elements have the value ``free``, elements with the same unknown
            move by the same tangent. None: each element is an unknown of its own.
        free: number of unknowns among the elements.
        held: the whole block stays in this call; it has no unknowns, whatever the value of ``slot``.
        eliminated: removed by Schur complement; at most one block, the last, with ``dim`` 1 and ``slot`` None.
        longest: a Gauss-Newton step with a larger number is not taken.
        difference: ``(value, other) -> tangent`` with ``retract(value, tangent) = other``; None: a prior of
            :func:`dvo.ba.marginal.marginalise` cannot hold it.
    """

    value: Tensor
    dim: int
    retract: Callable[[Tensor, Tensor], Tensor]
    slot: Tensor | None
    free: int
    held: bool = False
    eliminated: bool = False
    longest: float = LARGEST
    difference: Callable[[Tensor, Tensor], Tensor] | None = None

    @property
    def unknowns(self) -> int:
        """Number of unknowns in this call."""
        return 0 if self.held else self.free

    @cached_property
    def _stays(self) -> Tensor | None:
        """Mask of the fixed elements, to be broadcast over values; None if all are unknowns of their own."""
        if self.slot is None:
            return None
        return (self.slot == self.free).view(-1, *(1,) * (self.value.dim() - 2))

    def with_value(self, value: Tensor) -> StateBlock:
        """The same block with another value. Done in every step, hence without the cost of dataclasses.replace."""
        block = object.__new__(StateBlock)
        block.__dict__.update(self.__dict__, value=value)
        return block

    def spread(self, steps: Tensor) -> Tensor:
        """Tangents of the unknowns ``(B, free, dim)`` to tangents of all elements ``(B, N, dim)``, zero if fixed."""
        if self.slot is None:
            return steps
        return torch.nn.functional.pad(steps, (0, 0, 0, 1)).index_select(1, self.slot)

    def moved(self, steps: Tensor) -> StateBlock:
        """The block after steps of its unknowns ``(B, free, dim)``; fixed elements keep their value bit for bit."""
        if self.unknowns == 0:
            return self
        value = self.retract(self.value, self.spread(steps))
        if self._stays is not None:
            value = torch.where(self._stays, self.value, value)
        return self.with_value(value)


@dataclass(frozen=True)
class State:
    """State blocks by name, in the order of the unknowns: globals, poses, and last the eliminated block if any.

    Attributes:
        blocks: by name; a dict keeps its order.
        offsets: first row of each block in the reduced system.
        size: unknowns of the reduced system.
        landmarks: name of the eliminated block, or None.
    """

    blocks: Mapping[str, StateBlock]
    offsets: Mapping[str, int] = field(init=False)
    size: int = field(init=False)
    landmarks: str | None = field(init=False)

    def __post_init__(self) -> None:
        offsets: dict[str, int] = {}
        row, landmarks = 0, None
        for name, block in self.blocks.items():
            if block.eliminated:
                landmarks = name
                continue
            offsets[name] = row
            row += block.unknowns * block.dim
        for name, value in (("offsets", offsets), ("size", row), ("landmarks", landmarks)):
            object.__setattr__(self, name, value)

    def __getitem__(self, name: str) -> StateBlock:
        return self.blocks[name]

    def values(self) -> dict[str, Tensor]:
        """Value of each block."""
        return {name: block.value for name, block in self.blocks.items()}

    def with_values(self, values: Mapping[str, Tensor]) -> State:
        """The same blocks with other values."""
        return self._with({name: block.with_value(values[name]) for name, block in self.blocks.items()})

    def _with(self, blocks: Mapping[str, StateBlock]) -> State:
        state = object.__new__(State)
        state.__dict__.update(self.__dict__, blocks=blocks)
        return state

    def rows(self, name: str, index: Tensor) -> Tensor:
        """Rows ``(F, dim)`` of the reduced system for the elements ``index (F,)`` of a block that is not eliminated.

        ``size`` (one past the last row) where there is no unknown: a fixed element, or index -1.
        """
        block = self.blocks[name]
        if block.unknowns == 0:
            return torch.full((len(index), block.dim), self.size, dtype=torch.long, device=index.device)
        slot = index if block.slot is None else block.slot[index]
        row = self.offsets[name] + slot[:, None] * block.dim + torch.arange(block.dim, device=index.device)
        return torch.where(((index < 0) | (slot >= block.free))[:, None], self.size, row)

    def part(self, name: str, reduced: Tensor) -> Tensor:
        """The unknowns ``(B, unknowns, dim)`` of one block in a vector ``(B, size)`` of the reduced system."""
        block, start = self.blocks[name], self.offsets[name]
        return reduced[:, start : start + block.unknowns * block.dim].view(len(reduced), block.unknowns, block.dim)

    @property
    def longest(self) -> float:
        """The least :attr:`StateBlock.longest`."""
        return min(block.longest for block in self.blocks.values())

    def is_short(self, reduced: Tensor) -> Tensor:
        """``(B, 1)`` bool, elements of the batch with a step ``(B, size)`` within :attr:`StateBlock.longest`."""
        size = reduced.abs()
        short = torch.ones(len(size), 1, dtype=torch.bool, device=size.device)
        for name in self.offsets:
            short = short & (self.part(name, size) <= self.blocks[name].longest).flatten(1).all(1, keepdim=True)
        return short

    def moved(self, reduced: Tensor, landmarks: Tensor) -> State:
        """The state after a step ``(B, size)`` of the reduced system and ``(B, K)`` of the eliminated block."""
        changed = {
            name: block.moved(landmarks if block.eliminated else self.part(name, reduced))
            for name, block in self.blocks.items()
        }
        return self._with(changed)


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
    inverse_depths: Tensor, limits: tuple[float, float] = DEPTH_RANGE, held: bool = False
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
