"""Pose of one frame against keyframes whose depths are known (motion-only adjustment of DROID-SLAM 3.4)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dvo.ba.kernels import Kernel
from dvo.geometry import se3
from dvo.models.dense_step import DenseMode, DenseOptions, DenseState, VolumeLookup, dense_step, frame_graph
from dvo.models.droid import DroidVO
from dvo.nets.correlation.frame_correlation import PairVolume
from dvo.odometry.droid.window import Agreement, Keyframe, agreement


@dataclass(frozen=True)
class Placed:
    """Pose of a frame and its support.

    Attributes:
        pose_cw: ``(7,)`` world to camera; as given if only the flow was looked for.
        found: agreement of the measurements; its flow is that from the newest keyframe.
    """

    pose_cw: Tensor
    found: Agreement


def place_frame(
    model: DroidVO,
    anchors: list[Keyframe],
    matching: Tensor,
    intrinsics: Tensor,
    pose_cw: Tensor,
    updates: int,
    mode: DenseMode = "motion",
    kernel: Kernel = Kernel(),  # noqa: B008 (frozen)
) -> Placed:
    """Estimate the pose of a frame, or its flow alone.

    Args:
        model: the network.
        anchors: keyframes, the newest first; their poses and depths stay.
        matching: ``(C, h, w)`` features of the frame.
        intrinsics: ``(4,)`` of its feature map.
        pose_cw: ``(7,)`` to start from.
        updates: number of steps.
        mode: ``motion``, or ``flow`` where depths are not known yet.
        kernel: robust kernel of the residuals, see :class:`dvo.models.dense_step.DenseOptions`.

    Returns:
        Pose and support.
    """
    config, count = model.config, len(anchors)
    h, w = matching.shape[-2:]
    device = matching.device
    graph = frame_graph(torch.arange(count, device=device), torch.full((count,), count, device=device), count + 1, h, w)
    last = anchors[0]
    state = DenseState(
        graph,
        torch.stack([*(a.pose_cw for a in anchors), pose_cw])[None],
        torch.stack([*(a.inverse_depth for a in anchors), torch.ones_like(last.inverse_depth)])[None],
        torch.stack([*(a.intrinsics for a in anchors), intrinsics])[None],
        torch.stack([a.gates for a in anchors])[None],
        torch.stack([a.hidden for a in anchors])[None],
    )
    lookup = VolumeLookup([PairVolume(a.matching, matching, config.pyramid, config.radius) for a in anchors])
    options = DenseOptions(mode, fixed=[True] * count + [False], kernel=kernel)
    for _ in range(updates):
        state = dense_step(model, state, lookup, options)
    return Placed(state.poses_cw[0, -1], agreement(state))


def predicted_pose(
    before: tuple[float, Tensor] | None, last: tuple[float, Tensor], time: float, damping: float
) -> Tensor:
    """Pose of a frame by a damped constant velocity.

    Args:
        before, last: time and ``T_cw`` of the two frames before it; None if there is only one.
        time: of the frame, seconds.
        damping: factor of the velocity.

    Returns:
        ``(7,)`` world to camera.
    """
    if before is None:
        return last[1]
    ratio = min(2.0, max(0.0, (time - last[0]) / max(last[0] - before[0], 1e-9)))
    return se3.retract(last[1], damping * ratio * se3.log(se3.relative(before[1], last[1])))
