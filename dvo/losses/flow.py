"""Flow loss: error of the reprojected patches (DPVO 3.3), plain or weighted by confidence (V2V)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def flow_error(
    estimate: Float[Tensor, "B E p p 2"], truth: Float[Tensor, "B E p p 2"], valid: Bool[Tensor, "B E p p"]
) -> Float[Tensor, "B E"]:
    """End-point error of each edge: the smallest among the pixels of its patch (DPVO 3.3).

    The minimum lets patches of constant depth survive depth edges: one pixel that moves right is enough.

    Args:
        estimate: reprojected pixel positions, feature pixels.
        truth: true positions.
        valid: pixels whose true position is known and in view.

    Returns:
        feature pixels; infinity for an edge without a valid pixel.
    """
    # The square root of exactly zero has no gradient.
    error = ((estimate - truth).square().sum(-1) + 1e-12).sqrt()
    return error.masked_fill(~valid, torch.inf).flatten(2).amin(-1)


def weighted_flow_error(
    estimate: Float[Tensor, "B E p p 2"],
    truth: Float[Tensor, "B E p p 2"],
    valid: Bool[Tensor, "B E p p"],
    confidence: Float[Tensor, "B E 2"],
) -> Float[Tensor, "B E"]:
    """:func:`flow_error` of residuals that are first multiplied by the confidence, axis by axis (V2V).

    Edges that bundle adjustment ignores then no longer dominate the gradient of the pose objective (variance reduction
    by the weights of the bundle adjustment; as in V2V's released code the weight is the network's own 2-vector, the
    same for all pixels of a patch). The confidence is a constant here: no gradient reaches it, or the cheapest way to a
    small loss would be to trust nothing.

    Args:
        estimate, truth, valid: see :func:`flow_error`.
        confidence: weight of each axis of each edge, in [0, 1].

    Returns:
        weighted feature pixels; infinity for an edge without a valid pixel.
    """
    w = confidence.detach()[:, :, None, None]
    return flow_error(estimate * w, truth * w, valid)


def flow_loss(error: Float[Tensor, "B E"], edges: Bool[Tensor, " E"]) -> Tensor:
    """Mean over the chosen edges with a finite error, averaged over the clips.

    Args:
        error: from :func:`flow_error` or :func:`weighted_flow_error`, feature pixels.
        edges: mask of the edges that count; DPVO takes those with ``0 < |i - j| <= 2``, V2V all of them.

    Returns:
        scalar, feature pixels; 0 if no edge counts, nan if an error is.

    Example:
        >>> near = (graph.ii - graph.jj).abs() <= 2
        >>> loss = flow_loss(flow_error(state.coords, truth, valid), near)
    """
    used = ~torch.isposinf(error) & edges  # a NaN must show in the loss
    total = torch.where(used, error, torch.zeros_like(error)).sum(1)
    return (total / used.sum(1).clamp(min=1)).mean()
