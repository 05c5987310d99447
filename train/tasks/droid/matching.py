"""Classification of the true position of a pixel among all pixels of the other frame, a loss for matching features.

The look-up of the update operator shows the features a small neighbourhood of the present estimate, so that they learn
slowly while the estimates are poor. This loss compares every pixel with all others from the first step on: a softmax
over the all-pairs correlation, as the global matching of GMFlow (Xu et al., CVPR 2022) has it.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F


def matching_loss(
    features: Float[Tensor, "B N C h w"],
    ii: Int[Tensor, " E"],
    jj: Int[Tensor, " E"],
    positions: Float[Tensor, "B E h w 2"],
    valid: Bool[Tensor, "B E h w"],
) -> Tensor:
    """Cross-entropy of the true positions under the softmax of the correlation.

    Args:
        features: matching features.
        ii, jj: source and target frame of each edge.
        positions: true positions of the pixels of the source frames in the target frames, pixels of the map.
        valid: pixels whose position is known. Those outside of the map do not count.

    Returns:
        Scalar, a mean over the pixels that count, in nats; a position between pixels is shared by its four neighbours
        with the weights of bilinear interpolation, so that the least value is their entropy and not zero.
    """
    b, _, _, h, w = features.shape
    flat = features.flatten(3)
    logits = torch.einsum("becp,becq->bepq", flat[:, ii], flat[:, jj]).float()
    scores = F.log_softmax(logits, -1)
    x, y = (value.flatten(2) for value in positions.unbind(-1))
    inside = valid.flatten(2) & (x >= 0) & (x <= w - 1) & (y >= 0) & (y <= h - 1)
    x, y = torch.where(inside, x, 0.0), torch.where(inside, y, 0.0)
    left, top = x.floor().clamp(max=max(0, w - 2)), y.floor().clamp(max=max(0, h - 2))
    fx, fy = x - left, y - top
    loss = torch.zeros_like(x)
    for dx, wx in ((0, 1 - fx), (1, fx)):
        for dy, wy in ((0, 1 - fy), (1, fy)):
            column, row = (left + dx).clamp(max=w - 1), (top + dy).clamp(max=h - 1)
            index = (row * w + column).long()[..., None]
            loss = loss - wx * wy * scores.gather(-1, index)[..., 0]
    return torch.where(inside, loss, 0.0).sum() / inside.sum().clamp(min=1)
