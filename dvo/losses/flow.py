"""Flow loss: how far the patches land from where they should (DPVO 3.3), plain or weighted by confidence (V2V)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def flow_error(
    estimate: Float[Tensor, "B E p p 2"], truth: Float[Tensor, "B E p p 2"], valid: Bool[Tensor, "B E p p"]
) -> Float[Tensor, "B E"]:
    """Smallest end-point error among the pixels of each patch, in feature pixels.

    The minimum lets patches of constant depth survive depth edges: one pixel that moves right is enough. An edge
    without a valid pixel is infinite.
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
    """:func:`flow_error` of residuals that are first multiplied by the confidence, axis by axis.

    Edges that bundle adjustment is told to ignore stop drowning the pose objective in their gradient (V2V: variance
    reduction by the weights of the bundle adjustment; as in its released code the weight is the network's own 2-vector,
    the same for all pixels of a patch). The confidence is a constant here: no gradient reaches it, or the cheapest way
    to a small loss would be to trust nothing.
    """
    w = confidence.detach()[:, :, None, None]
    return flow_error(estimate * w, truth * w, valid)


def flow_loss(error: Float[Tensor, "B E"], edges: Bool[Tensor, " E"]) -> Tensor:
    """Mean over the chosen edges with a finite error, averaged over the clips.

    Args:
        error: from :func:`flow_error`.
        edges: which edges count; DPVO takes those with ``0 < |i - j| <= 2``, V2V all of them.
    """
    used = ~torch.isposinf(error) & edges  # a NaN must show in the loss
    total = torch.where(used, error, torch.zeros_like(error)).sum(1)
    return (total / used.sum(1).clamp(min=1)).mean()
