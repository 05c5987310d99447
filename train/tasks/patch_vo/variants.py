"""Flow losses whose gradients the study of the signal-to-noise ratio compares: plain (DPVO) and weighted (V2V)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.losses.flow import flow_error, flow_loss, weighted_flow_error
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import Stage
from train.tasks.patch_vo.objective import LossConfig, true_reprojection, truth_of
from train.tasks.task import Batch

HEADS = ("update.d.1.weight", "update.w.1.weight")
"""Parameters of the heads for flow revision and confidence."""

VARIANTS = {
    "plain, near edges (DPVO)": (False, False),
    "weighted, all edges (V2V)": (True, True),
    "plain, all edges": (False, True),
    "weighted, near edges": (True, False),
}
"""Name to (weighted by the confidence, over all edges); near edges are those with 0 < |i - j| <= 2."""


def flow_loss_variants(
    model: PatchVO, batch: Batch, stages: list[Stage], seed: int, config: LossConfig
) -> dict[str, Tensor]:
    """Every flow loss of :data:`VARIANTS` of one clip, from one forward pass.

    Args:
        model: the network.
        batch: a clip, as a batch of one.
        stages: schedule of the updates.
        seed: of the patches drawn.
        config: ``flow`` is the weight of the loss (it matters because the heads clamp their gradients), ``margin`` the
            border within which edges count.

    Returns:
        scalars with a graph, summed over the updates.
    """
    truth = truth_of(batch, model.config.STRIDE)
    b, n = batch["images"].shape[:2]
    sums: dict[str, Tensor] = {}
    there: Any = None
    graph = None
    states = model.unroll(
        batch["images"], batch["intrinsics"], stages, poses_cw=se3.identity(b, n),
        generator=torch.Generator().manual_seed(seed),
    )  # fmt: skip
    for state in states:
        if state.graph is not graph:
            graph = state.graph
            there = true_reprojection(truth, state.patches.detach(), graph, state.frames, config.margin)
        distance = (state.graph.ii - state.graph.jj).abs()
        near = (distance > 0) & (distance <= 2)
        errors = {
            False: flow_error(state.coords, *there),
            True: weighted_flow_error(state.coords, *there, state.confidence),
        }
        for name, (weighted, all_edges) in VARIANTS.items():
            edges = torch.ones_like(near) if all_edges else near
            term = config.flow * flow_loss(errors[weighted], edges)
            sums[name] = sums[name] + term if name in sums else term
    return sums
