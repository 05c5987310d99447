"""Training task of :class:`dvo.models.droid.DroidVO`: flow and pose losses over the updates of a clip."""

from __future__ import annotations

from collections import deque
from typing import cast

import torch
from torch import Tensor, nn

from dvo.geometry import se3
from dvo.losses.pose import pose_errors
from dvo.models.dense_step import DenseMode
from dvo.models.droid import DroidVO, neighbour_edges
from dvo.nets.droid.droid import preset
from train.data.augment import Augmentation, augment, random_source
from train.data.clips import Renderings
from train.tasks.droid.matching import matching_loss
from train.tasks.droid.objective import LossConfig, measures, objective, true_positions, truth_of
from train.tasks.task import Batch, StepContext, StepLoss, Task


class DroidTask(Task):
    """Trains a preset of the dense network on clips.

    As in DROID-SLAM the true poses of the first two frames are given, which sets the scale; the other frames begin at
    the second pose, inverse depths at 1.

    Args:
        model: name of the preset.
        seed: of the augmentation and of the further edges; step ``n`` draws the same whenever it is run.
        updates: updates a clip.
        reach: edges join frames at most so far apart.
        further: edges between frames farther apart, drawn anew in every step.
        known: number of leading poses that are given; with 1 the scale is free, and the pose loss aligns it.
        flow_steps: first steps that train the flow alone, at lower cost.
        loss: weights of the terms.
        augmentation: random changes of the clips, None for none.
    """

    data_type = Renderings

    def __init__(
        self,
        model: str = "small",
        seed: int = 0,
        updates: int = 5,
        reach: int = 2,
        further: int = 0,
        known: int = 2,
        flow_steps: int = 0,
        loss: LossConfig | None = None,
        augmentation: Augmentation | None = None,
    ) -> None:
        self.model, self.seed = model, seed
        self.updates, self.reach, self.further = updates, reach, further
        self.known, self.flow_steps = known, flow_steps
        self.loss = loss or LossConfig()
        self.augmentation = augmentation

    def network(self) -> nn.Module:
        """New network of the preset."""
        return DroidVO(preset(self.model))

    def parts(self, net: nn.Module) -> dict[str, nn.Module]:
        """Encoders, recurrent unit and heads."""
        net = cast(DroidVO, net)
        update = net.update
        return {
            "fnet": net.fnet, "cnet": net.cnet, "gru": update.gru, "delta": update.delta, "weight": update.weight,
            "agg": update.agg,
        }  # fmt: skip

    def edges(self, frames: int, step: int) -> tuple[Tensor, Tensor]:
        """Edges of the clips of a step: all between near frames, and some between others.

        Args:
            frames: length of the clips.
            step: of training.

        Returns:
            Source and target frames ``(E,)``.
        """
        ii, jj = neighbour_edges(frames, self.reach)
        if self.further:
            draw = random_source(self.seed * 1_000_003 + step)
            i, j = neighbour_edges(frames, frames)
            far = ((i - j).abs() > self.reach).nonzero()[:, 0]
            chosen = far[torch.randperm(len(far), generator=draw)[: self.further]]
            ii, jj = torch.cat((ii, i[chosen])), torch.cat((jj, j[chosen]))
        return ii, jj

    def compute_loss(self, context: StepContext, batch: Batch) -> StepLoss:
        """Loss of the updates of the clips."""
        mode: DenseMode = "flow" if context.step < self.flow_steps else "joint"
        if self.augmentation is not None:
            batch = augment(batch, self.augmentation, self.seed, context.step)
        net = cast(DroidVO, context.net)
        truth = truth_of(batch, net.STRIDE)
        frames = truth.poses_cw.shape[1]
        known = min(self.known, frames)
        given = truth.poses_cw[:, :known]
        start = torch.cat([given, given[:, -1:].expand(-1, frames - known, -1)], 1)
        features, (ii, jj) = net.encode(batch["images"]), self.edges(frames, context.step)
        states = net.unroll(
            batch["images"], batch["intrinsics"], ii, jj, updates=self.updates, poses_cw=start, fixed=known, mode=mode,
            features=features,
        )  # fmt: skip
        loss, found = objective(states, truth, self.loss, mode, known)
        if self.loss.matching:
            exact = true_positions(truth.inverse_depth, truth.poses_cw, truth.intrinsics, ii, jj, self.loss.margin)
            matching = self.loss.matching * matching_loss(features.matching, ii, jj, *exact)
            loss, found = loss + matching, found | {"loss_matching": matching.detach()}
        return StepLoss(loss, found, {name: found.pop(name) for name in ("target", "flow")})

    @torch.no_grad()
    def measure(self, net: nn.Module, batch: Batch, seed: int) -> dict[str, float]:
        """Errors of a clip, solved from nothing: no pose is given, the scale is aligned.

        Args:
            net: the network.
            batch: one clip, as a batch of one.
            seed: not used; nothing is drawn.

        Returns:
            ``pose`` (translation in median depths plus rotation in radians, unweighted) and the measures of
            :func:`train.tasks.droid.objective.measures`.
        """
        net = cast(DroidVO, net)
        truth = truth_of(batch, net.STRIDE)
        b, n = batch["images"].shape[:2]
        ii, jj = neighbour_edges(n, self.reach)
        start = se3.identity(b, n, device=batch["images"].device)
        states = net.unroll(batch["images"], batch["intrinsics"], ii, jj, updates=self.updates, poses_cw=start)
        state = deque(states, maxlen=1)[0]
        seen = true_positions(truth.inverse_depth, truth.poses_cw, truth.intrinsics, ii, jj, self.loss.margin)
        errors = pose_errors(state.poses_cw, truth.poses_cw)
        found = {name: float(value) for name, value in measures(state, truth, *seen).items()}
        return {"pose": float((errors.translation + errors.rotation).mean())} | found
