"""Loss of the score of patches (:class:`dvo.nets.score.ScoreHead`): what a patch brought to bundle adjustment."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from dvo.models.step import UpdateState

ERROR = 0.25
"""Error of a measurement at which it counts half, feature pixels."""


def usefulness(
    confidence: Float[Tensor, "B E 2"], error: Float[Tensor, "B E"], state: UpdateState
) -> tuple[Float[Tensor, "B K"], Bool[Tensor, "B K"]]:
    """Usefulness of patches: mean over the edges of ``confidence / (1 + (error / ERROR)^2)``.

    Args:
        confidence: of the edges.
        error: of their measured positions, feature pixels; infinite where the truth is not known.
        state: with the edges; those of a patch with its own frame do not count.

    Returns:
        Usefulness in [0, 1), and which patches have an edge that counts.
    """
    graph = state.graph
    counted = (torch.isfinite(error) & (graph.ii != graph.jj)).to(confidence.dtype)
    value = confidence.mean(-1) / (1 + (error / ERROR).square()) * counted
    zeros = value.new_zeros(len(value), state.patches.shape[1])
    sums, edges = zeros.index_add(1, graph.kk, value), zeros.index_add(1, graph.kk, counted)
    return sums / edges.clamp(min=1), edges > 0


def score_loss(state: UpdateState, error: Float[Tensor, "B E"]) -> tuple[Tensor, Tensor]:
    """Cross entropy of the scores with the usefulness, which receives no gradient.

    Args:
        state: after the last update, with ``scores``; patches of frames that have not joined do not count.
        error: see :func:`usefulness`.

    Returns:
        Scalar loss, and the detached correlation of scores and usefulness over the patches.
    """
    assert state.scores is not None and state.confidence is not None
    with torch.no_grad():
        wanted, counted = usefulness(state.confidence.detach().float(), error.detach().float(), state)
    scores = state.scores[:, : wanted.shape[1]][counted].float()
    wanted = wanted[counted]
    if not len(wanted):
        zero = state.scores.sum() * 0.0
        return zero, zero.detach()
    pair = torch.stack([scores.detach().sigmoid(), wanted])
    pair = pair - pair.mean(1, keepdim=True)
    correlation = pair.prod(0).sum() / pair.square().sum(1).prod().sqrt().clamp(min=1e-12)
    return F.binary_cross_entropy_with_logits(scores, wanted), correlation
