"""Objective of TartanVO: flow of all levels, direction of the translation, and rotation, trained together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.core.context import full_precision
from dvo.core.settings import check_settings
from dvo.geometry import se3, so3
from dvo.losses.two_frame import (
    UpToScale,
    flow_errors,
    rotation_loss,
    translation_loss,
    true_flow,
)
from dvo.models.tartanvo import TwoFrameMotion
from train.tasks.tartanvo.virtual_motions import VirtualPairs

Passes = Sequence[tuple[Tensor, Tensor]]
"""Translation and rotation vector after each pass of the pose network, ``(P, 3)``."""

_RANGES = {name: (0, math.inf) for name in ("flow", "translation", "rotation", "still", "margin")}
_RANGES["level_decay"] = (0, 1)


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms.

    Attributes:
        flow: of the end-point error, feature pixels, summed over the levels.
        level_decay: factor of the weight from each level to the next coarser one.
        translation: of the error of the direction of the translation, in [0, 2].
        rotation: of the error of the rotation vector, radians.
        form: of the translation error, see :data:`dvo.losses.two_frame.UpToScale`.
        still: length of a true step, in median depths, up to which its direction does not count.
        margin: a flow counts while it ends within this many feature pixels of the map.

    Raises:
        DvoError: a value of another type, not finite, negative, or an unknown form.
    """

    flow: float = 0.2
    level_decay: float = 0.7
    translation: float = 1.0
    rotation: float = 20.0
    form: UpToScale = "distance"
    still: float = 1e-3
    margin: float = 16.0

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)


@dataclass(frozen=True)
class PairTruth:
    """Ground truth of pairs of neighbouring frames, in feature pixels and median scene depths.

    Attributes:
        translation, rotation: ``(P, 3)`` of ``T_ab``, the second camera in the coordinates of the first one.
        flow: ``(P, 2, h, w)`` from the first frame to the second.
        valid: ``(P, h, w)`` bool, where the flow is known and counts.
    """

    translation: Tensor
    rotation: Tensor
    flow: Tensor
    valid: Tensor


def truth_of(batch: dict[str, Tensor], stride: int, margin: float) -> PairTruth:
    """Ground truth of the neighbouring frames of a batch of clips, clip by clip.

    Args:
        batch: ``depth (B, N, H, W)`` in median scene depths, nan where it is not known; ``poses_cw (B, N, 7)``;
            ``intrinsics (B, N, 4)`` in image pixels.
        stride: image pixels to a feature pixel; feature ``(u, v)`` is centred on image pixel ``(4u, 4v)``.
        margin: see :class:`LossConfig`.

    Returns:
        ``P = B (N - 1)`` pairs.
    """
    with full_precision(batch["depth"].device):
        motions = se3.steps(batch["poses_cw"].float()).flatten(0, 1)
        translation, rotation = motions[:, :3], so3.log(motions[:, 3:])
        depth = batch["depth"][:, :-1, ::stride, ::stride].flatten(0, 1).float()
        intrinsics = batch["intrinsics"][:, :-1].flatten(0, 1).float() / stride
        poses_ab = torch.cat([translation, so3.exp(rotation)], -1)
        flow, valid = true_flow(depth, poses_ab, intrinsics)
    h, w = depth.shape[-2:]
    x = flow[:, 0] + torch.arange(w, device=flow.device)
    y = flow[:, 1] + torch.arange(h, device=flow.device)[:, None]
    valid = valid & (x > -margin) & (x < w - 1 + margin) & (y > -margin) & (y < h - 1 + margin)
    return PairTruth(translation, rotation, flow, valid)


def objective(motion: TwoFrameMotion, truth: PairTruth, config: LossConfig) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss of a batch of pairs, and measures for the log.

    Args:
        motion: of the network.
        truth: of the same pairs.
        config: weights of the terms.

    Returns:
        Scalar with a graph, and detached measures: those of :func:`measures` and the weighted terms ``loss_flow``,
        ``loss_translation`` and ``loss_rotation``.
    """
    levels = [*motion.flows.levels[:-1], motion.flows.coarse, motion.flows.levels[-1]]
    errors = flow_errors(levels, truth.flow, truth.valid)
    decay = [config.level_decay**k for k in reversed(range(len(levels)))]
    passes = motion.passes or ((motion.translation, motion.rotation),)
    terms = {"flow": config.flow * (errors * errors.new_tensor(decay)).sum()}
    terms |= motion_terms(passes, truth.translation, truth.rotation, config)
    loss = torch.stack(list(terms.values())).sum()
    found = measures(motion, truth, config.still) | {f"loss_{name}": value.detach() for name, value in terms.items()}
    return loss, found


def motion_terms(
    passes: Passes, translation: Tensor, rotation: Tensor, config: LossConfig, valid: Tensor | None = None
) -> dict[str, Tensor]:
    """Weighted terms of the motion, each a mean over the passes of the pose network and over the pairs.

    Args:
        passes: translation and rotation vector after each pass, ``(P, 3)``.
        translation, rotation: the truth, ``(P, 3)``.
        config: weights of the terms.
        valid: ``(P,)`` bool, pairs that count; None: all.

    Returns:
        ``translation`` and ``rotation``, scalars with a graph.
    """
    weight = torch.ones_like(translation[:, 0]) if valid is None else valid.to(translation)
    weight = weight / weight.sum().clamp(min=1) / len(passes)
    found = {"translation": weight.new_zeros(()), "rotation": weight.new_zeros(())}
    for t, r in passes:
        found["translation"] = (
            found["translation"] + (weight * translation_loss(t, translation, config.form, config.still)).sum()
        )
        found["rotation"] = found["rotation"] + (weight * rotation_loss(r, rotation)).sum()
    return {"translation": config.translation * found["translation"], "rotation": config.rotation * found["rotation"]}


def motion_loss(
    passes: Passes, translation: Tensor, rotation: Tensor, config: LossConfig, valid: Tensor | None = None
) -> Tensor:
    """Sum of :func:`motion_terms`, with the same arguments."""
    return torch.stack(list(motion_terms(passes, translation, rotation, config, valid).values())).sum()


@torch.no_grad()
def virtual_measures(motion: tuple[Tensor, Tensor], pairs: VirtualPairs, still: float) -> dict[str, Tensor]:
    """Errors of virtual pairs, for the log.

    Args:
        motion: translation and rotation vector of the last pass.
        pairs: with their truth.
        still: see :class:`LossConfig`.

    Returns:
        Means over the valid pairs: ``virtual_rotation_ratio`` (error over true rotation), ``virtual_rotation_deg`` and
        ``virtual_direction_deg``.
    """
    direction, ratio, rotation = motion_errors(motion, pairs.translation, pairs.rotation, still, pairs.valid)
    return {
        "virtual_direction_deg": direction, "virtual_rotation_ratio": ratio, "virtual_rotation_deg": rotation,
    }  # fmt: skip


def motion_errors(
    motion: tuple[Tensor, Tensor], translation: Tensor, rotation: Tensor, still: float, valid: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean errors of motions.

    Args:
        motion: translations and rotation vectors, ``(P, 3)``.
        translation, rotation: the truth.
        still: see :class:`LossConfig`.
        valid: ``(P,)`` bool, pairs that count.

    Returns:
        Angle between the translations of pairs that move, degrees; rotation error over true rotation; rotation error,
        degrees.
    """
    moving = (translation.norm(dim=-1) > still) & valid
    cosine = torch.cosine_similarity(motion[0], translation, dim=-1).clamp(-1, 1)
    turn = so3.multiply(so3.conjugate(so3.exp(rotation)), so3.exp(motion[1]))
    count, degrees = valid.sum().clamp(min=1), 180 / math.pi
    error = torch.where(valid, so3.angle(turn), 0.0).sum() / count
    true = torch.where(valid, rotation.norm(dim=-1), 0.0).sum() / count
    direction = torch.where(moving, cosine.acos(), 0.0).sum() / moving.sum().clamp(min=1)
    return direction * degrees, error / true.clamp(min=1e-9), error * degrees


@torch.no_grad()
def measures(motion: TwoFrameMotion, truth: PairTruth, still: float) -> dict[str, Tensor]:
    """Errors of a batch of pairs.

    Args:
        motion: of the network.
        truth: of the same pairs.
        still: see :class:`LossConfig`.

    Returns:
        ``flow`` (mean end-point error, feature pixels), ``direction_deg`` (angle between the translations, of pairs
        that move), ``rotation_deg``, ``rotation_ratio`` (error over true motion), and the shares of flow ``px<1`` and
        ``px<4``.
    """
    every = torch.ones_like(truth.translation[:, 0], dtype=torch.bool)
    found = motion.translation, motion.rotation
    direction, ratio, rotation = motion_errors(found, truth.translation, truth.rotation, still, every)
    distance = (motion.flows.flow - truth.flow).norm(dim=1)[truth.valid]
    count = max(1, distance.numel())
    return {
        "flow": distance.sum() / count,
        "direction_deg": direction,
        "rotation_deg": rotation,
        "rotation_ratio": ratio,
        "px<1": (distance < 1).sum() / count,
        "px<4": (distance < 4).sum() / count,
    }
