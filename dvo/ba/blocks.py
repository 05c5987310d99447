"""State blocks of the common variables."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dvo.ba.edges import free_slots
from dvo.ba.limits import LARGEST, LARGEST_TURN, SHORTEST_FOCAL
from dvo.ba.problem import StateBlock
from dvo.geometry import se3, sim3

POSES, INVERSE_DEPTHS, INTRINSICS = "poses", "inverse_depths", "intrinsics"
"""Names of the blocks of :func:`dvo.ba.layer.layer.bundle_adjust`; poses are world to camera (or to body)."""

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
    return StateBlock(poses_cw, 6, se3.retract, slot, free, held or free == 0)


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
    return StateBlock(value, value.shape[-1], torch.add, None, value.shape[1], held)


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
