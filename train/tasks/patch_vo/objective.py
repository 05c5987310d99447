"""Objective of a training step: pose and flow losses summed over the updates (DPVO 3.3), weighted and balanced as in
V2V if wanted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.core.settings import check_settings, shown
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.losses.balance import PARAMETER
from dvo.losses.flow import flow_error, flow_loss, weighted_flow_error
from dvo.losses.pose import PoseErrors, pose_errors
from dvo.map.edges import PatchGraph
from dvo.models.patch_vo import Mode, UpdateState
from dvo.nets.patch.patchifier import crop_patches

LOSS_TERMS = Registry("loss term", "dvo.loss_terms")
"""Further terms of the loss by name, those of other packages; ``LossConfig.terms`` gives them a weight. A term is a
function of the state after an update and of the truth (:class:`dvo.models.patch_vo.UpdateState`, :class:`Truth`), and
gives a scalar tensor with a graph."""

TERMS = "target", "flow", "translation", "rotation"
"""Names of the terms that are always there."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms.

    Attributes:
        pose: of the mean translation (in units of median scene depth) plus rotation (rad) error.
        flow: of the flow error after bundle adjustment, feature pixels.
        target: of the error of the flow that bundle adjustment is given, feature pixels; trains the flow head directly
            (similar to DROID-SLAM's residual loss).
        target_limit: cap of one edge's target error; beyond the reach of the correlation there is nothing to learn.
        terms: of further terms, by their names (:data:`LOSS_TERMS`).
        pose_from: first update whose poses count.
        margin: an edge counts while the true position of its centre is within this many feature pixels of the map.
        weighted: the flow error is weighted by the confidence, held constant, over all edges (V2V); otherwise it is
            the plain one over edges of one or two frames (DPVO).
        balance: ``none``; ``fixed`` multiplies the flow by ``beta`` and the rotation by ``rotation``; ``v2v`` starts
            there and follows the gradients; ``trend`` starts there, follows the gradients with the flow alone, and
            multiplies it by MambaVO's penalty for trends (:mod:`dvo.losses.trend`).
        beta, rotation: see ``balance``.
        balance_parameter: name of the parameter on which gradients are compared.
        balance_every: steps between comparisons.
        balance_window: comparisons in the running mean.
        trend_window: steps in the mean that the losses of a step are compared with.
    """

    pose: float = 10.0
    flow: float = 0.1
    target: float = 0.1
    target_limit: float = 8.0
    pose_from: int = 2
    margin: float = 4.0
    weighted: bool = False
    balance: Literal["none", "fixed", "v2v", "trend"] = "none"
    beta: float = 1.0
    rotation: float = 1.0
    balance_parameter: str = PARAMETER
    balance_every: int = 20
    balance_window: int = 50
    trend_window: int = 4
    terms: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_settings(self, {"trend_window": (1, 10_000)})
        for name, weight in self.terms.items():
            LOSS_TERMS.target(name)  # an unknown one is an error
            if name in TERMS:
                raise DvoError(f"another loss term '{name}'", field="terms", remedy=f"none of {', '.join(TERMS)}")
            if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not math.isfinite(weight):
                raise DvoError(f"must be a number, got {shown(weight)}", field=f"terms: {name}", remedy="give a weight")

    @property
    def follows_gradients(self) -> bool:
        """True if the balance compares gradients."""
        return self.balance in ("v2v", "trend")


@dataclass(frozen=True)
class Truth:
    """Ground truth of a batch of clips, lengths in feature pixels and median scene depths.

    Attributes:
        poses_cw: ``(B, N, 7)``.
        inverse_depth: ``(B, N, h, w)`` at the feature positions; nan where it is not known.
        intrinsics: ``(B, N, 4)`` of the feature map.
    """

    poses_cw: Tensor
    inverse_depth: Tensor
    intrinsics: Tensor


def truth_of(batch: dict[str, Tensor], stride: int) -> Truth:
    """Ground truth at feature resolution: feature ``(u, v)`` is centred on image pixel ``(4u, 4v)``.

    Args:
        batch: ``depth (B, N, H, W)`` in median scene depths, nan where it is not known; ``poses_cw (B, N, 7)``;
            ``intrinsics (B, N, 4)`` in image pixels.
        stride: image pixels to a feature pixel.
    """
    depth = batch["depth"][:, :, ::stride, ::stride]
    return Truth(batch["poses_cw"], 1.0 / depth.clamp(min=1e-2), batch["intrinsics"] / stride)


def true_reprojection(
    truth: Truth, patches: Tensor, graph: PatchGraph, frames: int, margin: float
) -> tuple[Tensor, Tensor]:
    """True positions of the pixels of the patches.

    Args:
        truth: of the clips.
        patches: ``(B, K, 3, p, p)``; only their pixel positions are used.
        graph: ``E`` edges.
        frames: frames present.
        margin: an edge counts while the position of its centre is within this many feature pixels of the map.

    Returns:
        feature pixels ``(B, E, p, p, 2)``, and which of them count, ``(B, E, p, p)`` bool.
    """
    b, k, _, p, _ = patches.shape
    centres = patches[:, :, :2, p // 2, p // 2].round().long().unflatten(1, (frames, -1))
    disparity = crop_patches(truth.inverse_depth[:, :frames, None], centres, p).flatten(1, 2)
    known = torch.isfinite(disparity)
    disparity = torch.where(known, disparity, 1.0)
    exact = torch.cat([patches[:, :, :2], disparity], dim=2)
    poses, intrinsics = truth.poses_cw[:, :frames], truth.intrinsics[:, :frames]
    there = reproject(poses, exact, intrinsics, graph.ii, graph.jj, graph.kk)
    h, w = truth.inverse_depth.shape[-2:]
    x, y = there.coords[..., p // 2, p // 2, None, None, :].unbind(-1)
    inside = (x > -margin) & (x < w - 1 + margin) & (y > -margin) & (y < h - 1 + margin)
    seen = known[:, :, 0].index_select(1, graph.kk)
    return there.coords, there.valid & inside & seen


def _measures(prefix: str, error: Tensor, edges: Tensor) -> dict[str, Tensor]:
    used = torch.isfinite(error) & edges
    total = used.sum(1).clamp(min=1)
    return {f"{prefix}{px}": (((error < float(px)) & used).sum(1) / total).mean() for px in ("0.25", "1", "4")}


@dataclass
class Terms:
    """Terms of the loss, one entry an update, before any weight.

    Attributes:
        target, flow: scalars.
        translation, rotation: ``(B,)``, one number a clip.
        further: scalars, by name.
    """

    target: list[Tensor] = field(default_factory=list)
    flow: list[Tensor | None] = field(default_factory=list)
    translation: list[Tensor | None] = field(default_factory=list)
    rotation: list[Tensor | None] = field(default_factory=list)
    further: dict[str, list[Tensor]] = field(default_factory=dict)

    def total(self, config: LossConfig, beta: float = 1.0, rotation: float = 1.0) -> Tensor:
        """Weighted sum of all terms.

        Args:
            config: weights.
            beta: further weight of the flow.
            rotation: weight of the rotation against the translation.
        """
        total = self.target[0].new_zeros(())
        for target, flow, tau, phi in zip(self.target, self.flow, self.translation, self.rotation, strict=True):
            total = total + config.target * target
            if flow is not None:
                total = total + config.flow * beta * flow
            if tau is not None and phi is not None:
                total = total + config.pose * (tau + rotation * phi).mean()
        for name, values in self.further.items():
            total = total + config.terms[name] * torch.stack(values).sum()
        return total

    def sums(self, config: LossConfig) -> dict[str, Tensor]:
        """The terms summed over the updates with the weights of the configuration, those of the balance left out:
        ``target``, ``flow``, ``translation``, ``rotation``, and further ones by their names."""

        def add(values: Sequence[Tensor | None], weight: float) -> Tensor:
            found = [v.mean() for v in values if v is not None]
            return weight * torch.stack(found).sum() if found else self.target[0].new_zeros(())

        return {
            "target": add(self.target, config.target),
            "flow": add(self.flow, config.flow),
            "translation": add(self.translation, config.pose),
            "rotation": add(self.rotation, config.pose),
            **{name: add(values, config.terms[name]) for name, values in self.further.items()},
        }


def clip_terms(
    states: Iterable[UpdateState], truth: Truth, config: LossConfig, mode: Mode = "joint"
) -> tuple[Terms, dict[str, Tensor]]:
    """Terms of the loss of a batch of clips, and measures for the log.

    Args:
        states: of :meth:`dvo.models.patch_vo.PatchVO.unroll`.
        truth: of the clips.
        config: weights of the terms.
        mode: of the updates; the pose loss needs ``joint``, the flow after bundle adjustment any but ``flow``.

    Returns:
        the terms, and detached measures of the last update: ``flow``, ``target``, ``translation``,
        ``rotation_deg``, ``rotation_ratio`` (error over true motion), ``confidence`` and the shares of patch flow
        ``px<0.25`` ...
    """
    terms = Terms()
    further = {name: LOSS_TERMS.resolve(name) for name in config.terms}
    there: tuple[Tensor, Tensor] | None = None
    graph: PatchGraph | None = None
    measures: dict[str, Tensor] = {}
    measured: Callable[[], dict[str, Tensor]] = dict
    for update, state in enumerate(states):
        if there is None or state.graph is not graph:
            graph = state.graph
            there = true_reprojection(truth, state.patches.detach(), graph, state.frames, config.margin)
        coords, valid = there
        distance = (graph.ii - graph.jj).abs()
        near = (distance > 0) & (distance <= 2)
        error = flow_error(state.coords, coords, valid)
        flow = flow_loss(error, near)
        p = coords.shape[2] // 2
        wanted = (state.targets - coords[:, :, p, p]).square().sum(-1).add(1e-12).sqrt()
        wanted = wanted.clamp(max=config.target_limit).masked_fill(~valid[:, :, p, p], torch.inf)
        target = flow_loss(wanted, distance > 0)
        terms.target.append(target)
        counted = flow
        if config.weighted and mode != "flow":
            weighted = weighted_flow_error(state.coords, coords, valid, state.confidence)
            counted = flow_loss(weighted, torch.ones_like(near))
        terms.flow.append(counted if mode != "flow" else None)
        errors = None
        if mode == "joint" and update >= config.pose_from:
            errors = pose_errors(state.poses_cw, truth.poses_cw[:, : state.frames])
        terms.translation.append(None if errors is None else errors.translation)
        terms.rotation.append(None if errors is None else errors.rotation)
        for name, term in further.items():
            terms.further.setdefault(name, []).append(term(state, truth))
        measures = {"flow": flow, "target": target, "confidence": state.confidence.mean()}
        # Only the last update is measured further.
        measured = partial(_further_measures, truth, state, mode, errors, error, wanted, near)
    return terms, {name: value.detach() for name, value in (measures | measured()).items()}


@torch.no_grad()
def _further_measures(
    truth: Truth, state: UpdateState, mode: Mode, errors: PoseErrors | None, error: Tensor, wanted: Tensor, near: Tensor
) -> dict[str, Tensor]:
    measures = _measures("px<", error, near) | _measures("target_px<", wanted, near)
    if mode == "joint":
        poses = truth.poses_cw[:, : state.frames]
        errors = errors or pose_errors(state.poses_cw, poses)
        motion = pose_errors(se3.identity(*poses.shape[:2], device=poses.device), poses).rotation
        measures |= {
            "translation": errors.translation.mean(),
            "rotation_deg": errors.rotation.mean().rad2deg(),
            "rotation_ratio": (errors.rotation / motion.clamp(min=1e-4)).median(),
        }
    return measures
