"""Trust in the flow of a teacher, as the target of a student that sees the same clip worse (self-supervision).

A target is the flow after the teacher's bundle adjustment. It counts where the teacher's network was confident, where
the adjustment agreed with what the network had measured, and where the clip played backwards gave the same flow
(forward-backward consistency: Sundaram, Brox, Keutzer, ECCV 2010, here of adjusted flow).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dvo.core.settings import check_settings


@dataclass(frozen=True)
class Limits:
    """Limits within which a target counts.

    Attributes:
        confidence: least mean of the two confidences of an edge, in [0, 1].
        residual: largest distance of the network's flow from the adjusted one, feature pixels.
        disagreement: largest distance between the flow of the clip forwards and backwards, feature pixels.
        share: least share of trusted edges of a clip; one with fewer teaches nothing.

    Raises:
        DvoError: a limit that is none.
    """

    confidence: float = 0.2
    residual: float = 0.5
    disagreement: float = 0.5
    share: float = 0.3

    def __post_init__(self) -> None:
        inf = float("inf")
        check_settings(
            self, {"confidence": (0, 1), "residual": (0, inf), "disagreement": (0, inf), "share": (0, 1)}
        )  # fmt: skip


def trusted_edges(
    confidence: Float[Tensor, "B E"],
    residual: Float[Tensor, "B E"],
    disagreement: Float[Tensor, "B E"] | None,
    valid: Bool[Tensor, "B E"],
    limits: Limits,
) -> Bool[Tensor, "B E"]:
    """Edges whose flow may be a target.

    Args:
        confidence: of the teacher, in [0, 1], mean over the axes.
        residual: of its bundle adjustment, feature pixels.
        disagreement: of forward and backward flow, feature pixels; None: it was not measured.
        valid: edges that there are, projected in front of the camera.
        limits: see :class:`Limits`; a value that is nan is beyond them.

    Returns:
        Mask; all false for a clip of which less than ``limits.share`` of the valid edges are within the limits.
    """
    trusted = valid & (confidence >= limits.confidence) & (residual <= limits.residual)
    if disagreement is not None:
        trusted = trusted & (disagreement <= limits.disagreement)
    share = trusted.sum(1) / valid.sum(1).clamp(min=1)
    return trusted & (share >= limits.share)[:, None]


def masked_mean(error: Float[Tensor, "B E"], used: Bool[Tensor, "B E"]) -> Tensor:
    """Mean error of each clip over the edges that count, averaged over the clips.

    Args:
        error: finite where it counts.
        used: edges that count.

    Returns:
        Scalar; a clip without an edge that counts adds 0, with a gradient of zero.
    """
    total = torch.where(used, error, torch.zeros_like(error)).sum(1)
    return (total / used.sum(1).clamp(min=1)).mean()
