"""Objective of DROID-SLAM (Teed and Deng, 2021, 3.3): flow and pose losses summed over the updates of a clip."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.ba.layer.dense import dense_patches
from dvo.core.settings import check_settings
from dvo.geometry import se3
from dvo.geometry.projection import reproject
from dvo.losses.pose import edge_pose_errors, pose_errors
from dvo.models.dense_step import DenseMode, DenseState
from dvo.nets.droid.dense_update import upsample_map


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms, each summed over the updates.

    Attributes:
        pose: of the mean translation (in units of median scene depth) plus rotation (rad) error.
        flow: of the error of the flow after bundle adjustment, feature pixels, over all edges.
        target: of the error of the flow that bundle adjustment is given, feature pixels; trains the flow head directly.
        residual: of the distance between the two, feature pixels.
        upsampled: of the error of the flow of the upsampled depth, feature pixels, for networks that upsample; of the
            last update, between neighbouring frames.
        matching: of the classification of the true position among all pixels of the other frame
            (:func:`train.tasks.droid.matching.matching_loss`), nats; of no update; 0: none. DROID-SLAM has it not.
        decay: factor of the weight from each update to the one before it.
        target_limit: cap of the error of one pixel's target; beyond the reach of the correlation there is nothing to
            learn.
        flow_limit: cap of the error of one pixel's flow after bundle adjustment.
        pose_from: first update whose poses count.
        margin: a pixel counts while its true position is within this many feature pixels of the map.

    Raises:
        DvoError: a value of another type, not finite or out of range.
    """

    pose: float = 10.0
    flow: float = 0.4
    target: float = 0.4
    residual: float = 0.01
    upsampled: float = 0.4
    matching: float = 0.0
    decay: float = 0.9
    target_limit: float = 8.0
    flow_limit: float = 32.0
    pose_from: int = 0
    margin: float = 2.0

    def __post_init__(self) -> None:
        check_settings(self, {"decay": (0, 1), "pose_from": (0, 1000)})


@dataclass(frozen=True)
class Truth:
    """Ground truth of a batch of clips, lengths in feature pixels and median scene depths.

    Attributes:
        poses_cw: ``(B, N, 7)``.
        inverse_depth: ``(B, N, h, w)`` at the feature positions; nan where it is not known.
        intrinsics: ``(B, N, 4)`` of the feature map.
        fine: ``(B, N, H, W)`` inverse depth of the image.
    """

    poses_cw: Tensor
    inverse_depth: Tensor
    intrinsics: Tensor
    fine: Tensor


def truth_of(batch: dict[str, Tensor], stride: int) -> Truth:
    """Ground truth at feature resolution: feature ``(u, v)`` is centred on image pixel ``(8u, 8v)``.

    Args:
        batch: ``depth (B, N, H, W)`` in median scene depths, nan where it is not known; ``poses_cw (B, N, 7)``;
            ``intrinsics (B, N, 4)`` in image pixels.
        stride: image pixels to a feature pixel.

    Returns:
        The truth.
    """
    fine = 1.0 / batch["depth"].float().clamp(min=1e-2)
    poses_cw, intrinsics = batch["poses_cw"].float(), batch["intrinsics"].float() / stride
    return Truth(poses_cw, fine[:, :, ::stride, ::stride], intrinsics, fine)


def true_positions(
    inverse_depth: Tensor, poses_cw: Tensor, intrinsics: Tensor, ii: Tensor, jj: Tensor, margin: float
) -> tuple[Tensor, Tensor]:
    """True positions of the pixels of the source frames in the target frames.

    Args:
        inverse_depth: ``(B, N, h, w)``; nan where it is not known.
        poses_cw: ``(B, N, 7)``.
        intrinsics: ``(B, N, 4)`` of the map.
        ii, jj: ``(E,)`` edges.
        margin: see :class:`LossConfig`.

    Returns:
        ``(B, E, h, w, 2)`` pixels of the map, and which of them count, ``(B, E, h, w)`` bool.
    """
    known = torch.isfinite(inverse_depth)
    patches = dense_patches(torch.where(known, inverse_depth, 1.0))
    there = reproject(poses_cw, patches, intrinsics, ii, jj, ii)
    h, w = inverse_depth.shape[-2:]
    x, y = there.coords.unbind(-1)
    inside = (x > -margin) & (x < w - 1 + margin) & (y > -margin) & (y < h - 1 + margin)
    return there.coords, there.valid & inside & known[:, ii]


def mean_error(positions: Tensor, truth: Tensor, valid: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """End-point error, averaged over the pixels that count and over the clips.

    Args:
        positions, truth: ``(B, E, h, w, 2)``.
        valid: ``(B, E, h, w)`` bool.
        limit: cap of the error of a pixel.

    Returns:
        Scalar, 0 if no pixel counts; and the errors ``(B, E, h, w)``, infinite where a pixel does not count.
    """
    error = (positions - truth).square().sum(-1).add(1e-12).sqrt()
    counted = torch.where(valid, error.clamp(max=limit), 0.0)
    mean = (counted.flatten(1).sum(1) / valid.flatten(1).sum(1).clamp(min=1)).mean()
    return mean, torch.where(valid, error.detach(), torch.inf)


def objective(
    states: Iterable[DenseState], truth: Truth, config: LossConfig, mode: DenseMode = "joint", known: int = 2
) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss of a batch of clips, and measures for the log.

    Args:
        states: of :meth:`dvo.models.droid.DroidVO.unroll`.
        truth: of the clips.
        config: weights of the terms.
        mode: of the updates; ``flow`` counts the targets alone.
        known: number of leading poses that were given; with two or more the scale is known, otherwise it is aligned.

    Returns:
        Scalar with a graph, and detached measures: those of :func:`measures` and the weighted terms ``loss_target``,
        ``loss_flow``, ``loss_residual``, ``loss_pose`` and ``loss_upsampled``.
    """
    states = list(states)
    graph = states[0].graph
    exact, valid = true_positions(
        truth.inverse_depth, truth.poses_cw, truth.intrinsics, graph.ii, graph.jj, config.margin
    )
    terms: dict[str, list[Tensor]] = {name: [] for name in ("target", "flow", "residual", "pose", "upsampled")}
    for update, state in enumerate(states):
        assert state.targets is not None and state.coords is not None
        share = config.decay ** (len(states) - 1 - update)
        terms["target"].append(share * config.target * mean_error(state.targets, exact, valid, config.target_limit)[0])
        if mode == "flow":
            continue
        terms["flow"].append(share * config.flow * mean_error(state.coords, exact, valid, config.flow_limit)[0])
        left = mean_error(state.targets, state.coords, valid, config.target_limit)[0]
        terms["residual"].append(share * config.residual * left)
        if update >= config.pose_from:
            if known >= 2:
                errors = edge_pose_errors(state.poses_cw, truth.poses_cw, graph.ii, graph.jj)
            else:
                errors = pose_errors(state.poses_cw, truth.poses_cw)
            terms["pose"].append(share * config.pose * (errors.translation + errors.rotation).mean())
    if mode == "joint" and states[-1].mask is not None:
        terms["upsampled"].append(config.upsampled * upsampled_error(states[-1], truth, config))
    sums = {name: torch.stack(values).sum() for name, values in terms.items() if values}
    found = measures(states[-1], truth, exact, valid, mode)
    return torch.stack(list(sums.values())).sum(), found | {f"loss_{k}": v.detach() for k, v in sums.items()}


def upsampled_error(state: DenseState, truth: Truth, config: LossConfig) -> Tensor:
    """Error of the flow of the upsampled depth between neighbouring frames.

    Args:
        state: with a mask.
        truth: of the clips.
        config: limits.

    Returns:
        Scalar, feature pixels.
    """
    assert state.mask is not None
    b, n, height, width = truth.fine.shape
    fine = upsample_map(state.inverse_depth.flatten(0, 1), state.mask.flatten(0, 1)).unflatten(0, (b, n))
    fine = fine[..., :height, :width]
    near = (state.graph.ii - state.graph.jj).abs() == 1
    ii, jj = state.graph.ii[near], state.graph.jj[near]
    scale = fine.shape[-1] / truth.inverse_depth.shape[-1]
    intrinsics = truth.intrinsics * scale
    exact, valid = true_positions(truth.fine, truth.poses_cw, intrinsics, ii, jj, config.margin * scale)
    there = reproject(state.poses_cw, dense_patches(fine), intrinsics, ii, jj, ii).coords
    return mean_error(there, exact, valid, config.flow_limit * scale)[0] / scale


@torch.no_grad()
def measures(
    state: DenseState, truth: Truth, exact: Tensor, valid: Tensor, mode: DenseMode = "joint"
) -> dict[str, Tensor]:
    """Errors of a batch of clips after an update.

    Args:
        state: after the update.
        truth: of the clips.
        exact, valid: of :func:`true_positions`.
        mode: of the updates.

    Returns:
        ``target`` and ``flow`` (mean end-point errors, feature pixels), the shares ``target_px<0.5``, ``target_px<1``,
        ``px<0.5`` and ``px<1``, ``confidence``, and in mode ``joint`` the errors of the poses after alignment of scale:
        ``translation`` (median depths), ``rotation_deg`` and ``rotation_ratio`` (error over true motion).
    """
    assert state.targets is not None and state.coords is not None and state.confidence is not None
    count = valid.sum().clamp(min=1)
    found = {"confidence": state.confidence.mean()}
    for name, prefix, positions in (("target", "target_", state.targets), ("flow", "", state.coords)):
        found[name], error = mean_error(positions, exact, valid, torch.inf)
        found |= {f"{prefix}px<{px}": (error < px).sum() / count for px in (0.5, 1)}
    if mode == "joint":
        errors = pose_errors(state.poses_cw, truth.poses_cw)
        still = se3.identity(*truth.poses_cw.shape[:2], device=truth.poses_cw.device)
        motion = pose_errors(still, truth.poses_cw).rotation
        found |= {
            "translation": errors.translation.mean(),
            "rotation_deg": errors.rotation.mean().rad2deg(),
            "rotation_ratio": (errors.rotation / motion.clamp(min=1e-4)).median(),
        }
    return found
