"""Pose losses: over all ordered pairs of frames after alignment of scale (DPVO 3.3), or over edges (DROID-SLAM 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dvo.geometry import se3


@dataclass(frozen=True)
class PoseErrors:
    """Mean norms over all ordered pairs of frames, one number a clip.

    Attributes:
        translation: ``(B,)`` in the unit of the ground truth.
        rotation: ``(B,)`` radians.
    """

    translation: Tensor
    rotation: Tensor


def alignment_scale(
    estimate: Float[Tensor, "B N 3"], truth: Float[Tensor, "B N 3"], limit: float = 10.0
) -> Float[Tensor, " B"]:
    """Scale that aligns the estimated camera centres with the true ones (DPVO's ``kabsch_umeyama``).

    Variance of the truth over the sum of the singular values of the covariance; detached.

    Args:
        estimate, truth: camera centres in the world frame; the unit of the result is that of the truth.
        limit: highest scale, for estimates that hardly move.

    Returns:
        factor for the estimate, one a clip.
    """
    with torch.no_grad():
        a = (truth - truth.mean(1, keepdim=True)).double()
        b = (estimate - estimate.mean(1, keepdim=True)).double()
        variance = a.square().sum(-1).mean(-1)
        covariance = a.mT @ b / a.shape[1]
        singular = torch.linalg.svdvals(torch.nan_to_num(covariance)).sum(-1)
        scale = variance / singular.clamp(min=1e-12)
        return scale.clamp(max=limit).to(estimate.dtype)


def pose_errors(estimate_cw: Float[Tensor, "B N 7"], truth_cw: Float[Tensor, "B N 7"]) -> PoseErrors:
    """Errors of all relative motions ``i -> j``, ``i != j``; only the scale of the estimate is aligned (DPVO 3.3).

    Args:
        estimate_cw: estimated poses, world to camera.
        truth_cw: true poses, world to camera; their unit is that of the translation error.

    Returns:
        mean norms of the two halves of ``log(truth_ij estimate_ij^-1)``, with gradients to ``estimate_cw`` (finite also
        where the error is zero).

    Example:
        >>> errors = pose_errors(state.poses_cw, truth_cw)
        >>> loss = (errors.translation + errors.rotation).mean()
    """
    estimate, truth = se3.inverse(estimate_cw), se3.inverse(truth_cw)
    scale = alignment_scale(estimate[..., :3], truth[..., :3])
    estimate = torch.cat([estimate[..., :3] * scale[:, None, None], estimate[..., 3:]], dim=-1)
    n = estimate.shape[1]
    i, j = (~torch.eye(n, dtype=torch.bool, device=estimate.device)).nonzero(as_tuple=True)
    moved = se3.compose(se3.inverse(estimate)[:, i], estimate[:, j])
    wanted = se3.compose(se3.inverse(truth)[:, i], truth[:, j])
    error = se3.log(se3.compose(wanted, se3.inverse(moved)))
    tau, phi = (error[..., :3].square().sum(-1) + 1e-16).sqrt(), (error[..., 3:].square().sum(-1) + 1e-16).sqrt()
    return PoseErrors(tau.mean(1), phi.mean(1))


def edge_pose_errors(
    estimate_cw: Float[Tensor, "B N 7"], truth_cw: Float[Tensor, "B N 7"], ii: Tensor, jj: Tensor
) -> PoseErrors:
    """Errors of the relative motions of edges, in a scale that is known (geodesic loss of DROID-SLAM 3.3).

    Args:
        estimate_cw: estimated poses, world to camera.
        truth_cw: true poses, world to camera.
        ii, jj: ``(E,)`` frames of each edge.

    Returns:
        mean norms of the two halves of ``log(estimate_ij truth_ij^-1)`` with ``T_ij = T_cw[j] T_cw[i]^-1``, with
        gradients to ``estimate_cw`` (finite also where the error is zero).
    """
    estimate, truth = (se3.relative(x[:, ii], x[:, jj]) for x in (estimate_cw, truth_cw))
    error = se3.log(se3.compose(estimate, se3.inverse(truth)))
    tau, phi = (error[..., :3].square().sum(-1) + 1e-16).sqrt(), (error[..., 3:].square().sum(-1) + 1e-16).sqrt()
    return PoseErrors(tau.mean(1), phi.mean(1))
