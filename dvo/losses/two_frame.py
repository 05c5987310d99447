"""Losses of two-frame odometry: translation up to scale and rotation (TartanVO 3.2), and flow of several levels.

Translations and rotation vectors are those of ``T_ab``, the second camera in the coordinates of the first one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dvo.geometry import se3

UpToScale = Literal["distance", "cosine"]
"""Forms of the translation loss, see :func:`translation_loss`."""

_EPSILON = 1e-6  # least length that a translation is divided by (TartanVO, eq. 3)


def translation_loss(
    estimate: Float[Tensor, "B 3"],
    truth: Float[Tensor, "B 3"],
    form: UpToScale = "distance",
    still: float = 1e-3,
) -> Float[Tensor, " B"]:
    """Error of the direction of a translation, whatever its length.

    Args:
        estimate: translations, of any length.
        truth: true translations.
        form: ``distance``: length of the difference of the two, each divided by its length or 1e-6 if that is more
            (TartanVO, eq. 3), in [0, 2]; ``cosine``: one minus the cosine of their angle (eq. 2), in [0, 2].
        still: length of a true translation, in its unit, up to which it has no direction.

    Returns:
        Error of each pair; zero, without a gradient, where the camera stood still.

    Example:
        >>> loss = translation_loss(motion.translation, truth).mean()
    """
    a, b = _unit(estimate), _unit(truth)
    error = 1 - (a * b).sum(-1) if form == "cosine" else _length(a - b)
    return torch.where(truth.norm(dim=-1) > still, error, torch.zeros_like(error))


def rotation_loss(estimate: Float[Tensor, "B 3"], truth: Float[Tensor, "B 3"]) -> Float[Tensor, " B"]:
    """Error of a rotation: length of the difference of the two rotation vectors, on so(3) (TartanVO, eq. 3).

    Args:
        estimate: rotation vectors, radians.
        truth: true rotation vectors, at most half a turn.

    Returns:
        Radians, with a finite gradient at zero.
    """
    return _length(estimate - truth)


def flow_errors(
    levels: Sequence[Tensor], truth: Float[Tensor, "B 2 h w"], valid: Bool[Tensor, "B h w"]
) -> Float[Tensor, " L"]:
    """Mean end-point error of the flow of each level.

    The levels are sampled where a pixel ``u`` lies on pixel ``2 u`` of the finer one: the truth of a coarser level is a
    subset of that of the finest.

    Args:
        levels: ``(B, 2, h / 2^k, w / 2^k)``, sizes rounded up, from coarse to fine or in another order, each in feature
            pixels of its own level.
        truth: true flow of the finest level, feature pixels.
        valid: pixels where it is known.

    Returns:
        Errors in feature pixels of the finest level, a mean over all valid pixels each; 0 where there is none.
    """
    errors = []
    for flow in levels:
        factor = round(truth.shape[-1] / flow.shape[-1])
        wanted, used = truth[..., ::factor, ::factor], valid[:, ::factor, ::factor]
        error = (factor * flow - wanted).square().sum(1).add(1e-12).sqrt()
        errors.append(torch.where(used, error, torch.zeros_like(error)).sum() / used.sum().clamp(min=1))
    return torch.stack(errors)


def true_flow(
    depth: Float[Tensor, "B h w"], poses_ab: Float[Tensor, "B 7"], intrinsics: Float[Tensor, "B 4"]
) -> tuple[Float[Tensor, "B 2 h w"], Bool[Tensor, "B h w"]]:
    """Flow that a motion of the camera gives a scene at rest.

    Args:
        depth: of the first frame, in the unit of the poses; nan where it is not known.
        poses_ab: second camera in the coordinates of the first one.
        intrinsics: ``fx fy cx cy`` of both frames, in pixels of the depth map.

    Returns:
        Flow in pixels of the depth map, zero where it is not valid; where it is: the depth is known and the point in
        front of the second camera, in view or not.
    """
    h, w = depth.shape[-2:]
    fx, fy, cx, cy = (value[:, None, None] for value in intrinsics.unbind(-1))
    x = torch.arange(w, device=depth.device, dtype=depth.dtype)
    y = torch.arange(h, device=depth.device, dtype=depth.dtype)[:, None]
    known = torch.isfinite(depth) & (depth > 0)
    z = torch.where(known, depth, torch.ones_like(depth))
    points = torch.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], -1)
    moved = se3.act(se3.inverse(poses_ab)[:, None, None], points)
    valid = known & (moved[..., 2] > 0.05 * z)
    ahead = torch.where(valid, moved[..., 2], torch.ones_like(z))
    flow = torch.stack([moved[..., 0] / ahead * fx + cx - x, moved[..., 1] / ahead * fy + cy - y], 1)
    return torch.where(valid[:, None], flow, torch.zeros_like(flow)), valid


def _length(vectors: Tensor) -> Tensor:
    """Length of vectors, with a gradient at zero."""
    return vectors.square().sum(-1).add(1e-12).sqrt()


def _unit(vectors: Tensor) -> Tensor:
    return vectors / _length(vectors)[..., None].clamp(min=_EPSILON)
