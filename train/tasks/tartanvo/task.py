"""Training task of :class:`dvo.models.tartanvo.TartanVO`: flow and motion of neighbouring frames, trained together."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from dvo.core.errors import DvoError
from dvo.core.settings import check_seed, shown
from dvo.models.tartanvo import TartanVO, TwoFrameMotion
from dvo.nets.two_frame.tartanvo import preset
from train.data.augment import Augmentation, augment
from train.data.clips import Renderings
from train.tasks.tartanvo.objective import (
    LossConfig,
    PairTruth,
    measures,
    motion_loss,
    objective,
    truth_of,
    virtual_measures,
)
from train.tasks.tartanvo.virtual_motions import VirtualMotions, virtual_pairs
from train.tasks.task import Batch, StepContext, StepLoss, Task


class TartanVOTask(Task):
    """Trains a preset of the two-frame network on the neighbouring frames of clips.

    Random crop-and-resize (TartanVO 3.3) is the ``zoom`` of the augmentation, which carries the intrinsics along;
    ``zoom_range: 1.3`` enlarges by up to 2.5, as in the paper.

    Args:
        model: name of the preset.
        seed: of the augmentation; step ``n`` draws the same whenever it is run.
        loss: weights of the terms, and the form of the translation loss.
        augmentation: random changes of the clips, None for none.
        virtual: further pairs for the pose network, whose flow follows from the depth maps of the batch; None: none.
        matching_from: step up to which the virtual pairs alone count: the pose network learns from many more pairs in
            the same time than beside the matching network, and ``data.batch_size: 1`` gives depth maps enough.
        true_flow_until: step up to which the pose network reads the true flow where it is known, as in the first part
            of TartanVO's training; from then on it reads the estimate, and its loss reaches the matching network.

    Raises:
        DvoError: no such preset, or another argument out of range.
    """

    data_type = Renderings

    def __init__(
        self,
        model: str = "small",
        seed: int = 0,
        loss: LossConfig | None = None,
        augmentation: Augmentation | None = None,
        true_flow_until: int = 0,
        virtual: VirtualMotions | None = None,
        matching_from: int = 0,
    ) -> None:
        preset(model)
        check_seed(seed)
        for name, steps in (("true_flow_until", true_flow_until), ("matching_from", matching_from)):
            whole = isinstance(steps, int) and not isinstance(steps, bool)
            if not (whole and steps >= 0):
                message = f"no number of steps: {shown(steps)}"
                raise DvoError(message, field=name, remedy="give a whole number, 0 for none")
        if matching_from and not (virtual and virtual.pairs):
            raise DvoError("there are no virtual pairs", field="matching_from", remedy="give virtual, or leave it at 0")
        self.model, self.seed = model, seed
        self.loss = loss or LossConfig()
        self.augmentation, self.virtual = augmentation, virtual
        self.true_flow_until, self.matching_from = true_flow_until, matching_from

    def network(self) -> nn.Module:
        """New network of the preset."""
        return TartanVO(preset(self.model))

    def parts(self, net: nn.Module) -> dict[str, nn.Module]:
        """Matching network and pose network."""
        net = cast(TartanVO, net)
        return {"matching": net.matching, "pose": net.pose}

    def compute_loss(self, context: StepContext, batch: Batch) -> StepLoss:
        """Loss of all pairs of neighbouring frames of the clips."""
        if self.augmentation is not None:
            batch = augment(batch, self.augmentation, self.seed, context.step)
        net = cast(TartanVO, context.net)
        if context.step < self.matching_from:
            loss, found = self._virtual_loss(net, batch, context.step)
            shown = {name: found[f"virtual_{name}"] for name in ("direction_deg", "rotation_deg")}
            return StepLoss(loss, found, shown)
        truth = truth_of(batch, net.STRIDE, self.loss.margin)
        motion = self._motion(net, batch, truth if context.step < self.true_flow_until else None)
        loss, found = objective(motion, truth, self.loss)
        if self.virtual is not None and self.virtual.pairs:
            extra, more = self._virtual_loss(net, batch, context.step)
            loss, found = loss + extra, found | more
        shown = {name: found.pop(name) for name in ("flow", "direction_deg", "rotation_deg")}
        return StepLoss(loss, found, shown)

    def _motion(self, net: TartanVO, batch: Batch, truth: PairTruth | None = None) -> TwoFrameMotion:
        """Flow and motion of the pairs, in the order of :func:`train.tasks.tartanvo.objective.truth_of`."""
        b, n = batch["images"].shape[:2]
        features = [level.unflatten(0, (b, n)) for level in net.encode(batch["images"].flatten(0, 1))]
        first = [level[:, :-1].flatten(0, 1) for level in features]
        second = [level[:, 1:].flatten(0, 1) for level in features]
        intrinsics = batch["intrinsics"][:, :-1].flatten(0, 1)
        if truth is None:
            return net.between(first, second, intrinsics)
        flows = net.matching.match(first, second)
        flow = torch.where(truth.valid[:, None], truth.flow, flows.flow.detach())
        found = net.motions(flow, intrinsics)
        return TwoFrameMotion(*found[-1], flows, found)

    def _virtual_loss(self, net: TartanVO, batch: Batch, step: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the pose network on virtual pairs, and their errors for the log."""
        assert self.virtual is not None
        stride, depth = net.STRIDE, batch["depth"]
        maps = depth.flatten(0, 1)[:, ::stride, ::stride]
        height, width = depth.shape[-2:]
        pairs = virtual_pairs(maps, stride, self.virtual, self.seed, step, (height, width))
        passes = net.motions(pairs.flow, pairs.intrinsics)
        loss = motion_loss(passes, pairs.translation, pairs.rotation, self.loss, pairs.valid)
        return loss, virtual_measures(passes[-1], pairs, self.loss.still)

    @torch.no_grad()
    def measure(self, net: nn.Module, batch: Batch, seed: int) -> dict[str, float]:
        """Errors of a clip.

        Args:
            net: the network.
            batch: one clip, as a batch of one.
            seed: not used; nothing is drawn.

        Returns:
            ``pose`` (error of the direction of the translation, in [0, 2], plus rotation in radians, unweighted) and
            the measures of :func:`train.tasks.tartanvo.objective.measures`.
        """
        net = cast(TartanVO, net)
        truth = truth_of(batch, net.STRIDE, self.loss.margin)
        motion = self._motion(net, batch)
        found = {name: float(value) for name, value in measures(motion, truth, self.loss.still).items()}
        plain = LossConfig(flow=0.0, translation=1.0, rotation=1.0, still=self.loss.still, margin=self.loss.margin)
        return {"pose": float(objective(motion, truth, plain)[0])} | found

    def loss_variants(self, net: nn.Module, batch: Batch, seed: int) -> dict[str, Tensor]:
        """Weighted sum of all terms, and the terms of the motion in both forms of the translation loss."""
        net = cast(TartanVO, net)
        truth = truth_of(batch, net.STRIDE, self.loss.margin)
        motion = self._motion(net, batch)
        pose = {"distance": LossConfig(flow=0.0, form="distance"), "cosine": LossConfig(flow=0.0, form="cosine")}
        joint = {"joint": objective(motion, truth, self.loss)[0]}
        return joint | {name: objective(motion, truth, config)[0] for name, config in pose.items()}
