"""Training task of :class:`dvo.models.patch_vo.PatchVO` without ground truth: a student that sees a clip degraded
learns the adjusted flow of a teacher that sees it clean (in the spirit of DeFlowSLAM's self-supervision)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor, nn

from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.losses.consistency import Limits
from dvo.models.patch_vo import PatchVO
from dvo.models.schedule import Stage, to_device, training_schedule
from train.data.augment import Augmentation, augment
from train.data.degrade import Degradation, degrade
from train.data.mixture import Mixture
from train.tasks.patch_vo.objective import LossConfig
from train.tasks.patch_vo.task import PatchVOTask
from train.tasks.selfsup.objective import ConsistencyConfig, student_loss
from train.tasks.selfsup.teacher import (
    Lesson,
    TeacherConfig,
    centres_before_crop,
    flat_weights,
    further_centres,
    teach,
    use_weights,
)
from train.tasks.task import Batch, StepContext, StepLoss, Task

_WINDOW, _COLOUR = 1, 2  # streams of random numbers beside that of the seed


class SelfSupervisedTask(Task):
    """Fine-tunes a patch-flow network on clips whose poses are nan; clips with poses count as in the task ``patch_vo``.

    Args:
        model: name of the preset.
        seed: draws patches, augmentation and degradation; step ``n`` draws the same whenever it is run.
        updates, initial, settle: schedule of the student, see :class:`train.tasks.patch_vo.task.PatchVOTask`.
        correlation_gradient: share of edges that train the features through the correlation.
        teacher: settings of the teacher.
        limits: within which the teacher's flow is a target.
        consistency: weights of the terms.
        supervised: weights of the terms of clips with poses; its balance may be ``none`` or ``fixed``.
        augmentation: random changes of the student's clip: crop-and-zoom, colours, exposure; None for none.
        degradation: little light, noise and blur in the student's clip; None for none.
        patches: patches a frame; None: those of the preset.
        selection: of the patches, a name in :data:`dvo.nets.patch.selection.SELECTIONS`; None: that of the preset.
        update_operator: name in :data:`dvo.nets.update.update.UPDATE_OPERATORS`; None: that of the preset.

    Raises:
        DvoError: a balance that follows gradients.
    """

    data_type = Mixture
    starts_from = ("patch_vo",)

    def __init__(
        self,
        model: str = "small",
        seed: int = 0,
        updates: int = 10,
        initial: int | None = 4,
        settle: int = 4,
        correlation_gradient: float = 0.3,
        teacher: TeacherConfig | None = None,
        limits: Limits | None = None,
        consistency: ConsistencyConfig | None = None,
        supervised: LossConfig | None = None,
        augmentation: Augmentation | None = None,
        degradation: Degradation | None = None,
        patches: int | None = None,
        selection: str | None = None,
        update_operator: str | None = None,
    ) -> None:
        self.seed, self.initial, self.settle = seed, initial, settle
        self.correlation_gradient = correlation_gradient
        self.teacher = teacher or TeacherConfig()
        self.limits = limits or Limits()
        self.consistency = consistency or ConsistencyConfig()
        self.augmentation, self.degradation = augmentation, degradation
        loss = supervised or LossConfig(flow=0.3, target=0.5, weighted=True)
        if loss.follows_gradients:
            remedy = "give none, or fixed and a beta"
            raise DvoError(f"the balance '{loss.balance}' follows gradients", field="supervised.balance", remedy=remedy)
        self.plain = PatchVOTask(
            model, seed, updates, initial, settle, warmup_until=0.0, correlation_gradient=correlation_gradient,
            loss=loss, augmentation=augmentation, patches=patches, selection=selection, update_operator=update_operator,
        )  # fmt: skip
        self._teacher_net: PatchVO | None = None
        self._stages: dict[tuple[int, int, torch.device], list[Stage]] = {}

    # -- the network and its state -------------------------------------------------------------------------------

    def network(self) -> nn.Module:
        """New network of the preset; the parameters of the teacher have the same order."""
        net = self.plain.network()
        self._size = sum(parameter.numel() for parameter in net.parameters())
        return net

    def parts(self, net: nn.Module) -> dict[str, nn.Module]:
        """Encoder and update operator."""
        return self.plain.parts(net)

    def buffers(self) -> dict[str, Tensor]:
        """``teacher``: its weights in one vector; ``trained``: there are weights to start from; ``teaching``: the
        teacher has been set to them."""
        if not hasattr(self, "_size"):
            self.network()
        flags = {name: torch.tensor(False) for name in ("trained", "teaching")}
        return {"teacher": torch.zeros(self._size), **flags}

    def trained_weights_loaded(self, buffers: Mapping[str, Tensor]) -> None:
        """Allow training, which a teacher that knows nothing would make pointless."""
        buffers["trained"].fill_(True)

    def measure(self, net: nn.Module, batch: Batch, seed: int) -> dict[str, float]:
        """Errors of a clip with ground truth, see :meth:`train.tasks.patch_vo.task.PatchVOTask.measure`."""
        return self.plain.measure(net, batch, seed)

    # -- a step --------------------------------------------------------------------------------------------------

    def compute_loss(self, context: StepContext, batch: Batch) -> StepLoss:
        """Loss of a student, or, on clips with poses, that of the task ``patch_vo``.

        Raises:
            DvoError: training from random weights.
        """
        buffers = context.buffers
        if not buffers["trained"]:
            remedy = "give --from small, weights of your own, or a training state"
            raise DvoError("there are no trained weights to start from", field="--from", remedy=remedy)
        if not buffers["teaching"]:
            buffers["teacher"].copy_(flat_weights(context.net))
            buffers["teaching"].fill_(True)
        if torch.isfinite(batch["poses_cw"]).all():
            found = self.plain.compute_loss(replace(context, buffers=self.plain.buffers()), batch)
            measures = {f"labelled_{name}": value for name, value in (found.measures | found.shown).items()}
            return StepLoss(found.loss, measures)
        return self._student(context, batch)

    def _student(self, context: StepContext, batch: Batch) -> StepLoss:
        net = cast(PatchVO, context.net)
        clean = seen = batch
        if self.augmentation is not None:
            crop = replace(self.augmentation, colour=0.0, exposure=0.0)
            clean = augment(batch, crop, self.seed + _WINDOW * 2**20, context.step)
            colours = replace(self.augmentation, zoom=0.0)
            seen = augment(clean, colours, self.seed + _COLOUR * 2**20, context.step)
        images, intrinsics = seen["images"], clean["intrinsics"]
        if self.degradation is not None:
            images = degrade(images, self.degradation, self.seed, context.step)
        b, n = images.shape[:2]
        generators = self.plain.generators(context.step, b)
        centres = net.draw_centres(images, generators)
        lesson = self.lesson(context, batch, centres, intrinsics, generators)
        states = net.unroll(
            images,
            intrinsics,
            self.plain.stages(net, n, "joint", images.device),
            poses_cw=se3.identity(b, n, device=images.device),
            generator=generators,
            correlation_gradient=self.correlation_gradient,
            centres=centres,
        )
        loss, measures = student_loss(states, lesson, clean["images"], intrinsics, self.consistency)
        shown = {name: measures.pop(name) for name in ("target_px<0.25", "trusted")}
        return StepLoss(loss, measures, shown)

    def lesson(
        self,
        context: StepContext,
        batch: Batch,
        centres: Tensor,
        intrinsics: Tensor,
        generators: list[torch.Generator],
    ) -> Lesson:
        """Run the teacher on the clean clip.

        Args:
            context: of the step.
            batch: the clip before any change.
            centres: ``(B, N, M, 2)`` of the student's patches, in feature pixels of its clip.
            intrinsics: ``(B, N, 4)`` of the student's clip.
            generators: of the teacher's further patches, one for each clip.
        """
        net = cast(PatchVO, context.net)
        teacher = self._network_of_teacher(net)
        use_weights(teacher, context.buffers["teacher"])
        images, stride = batch["images"], net.config.STRIDE
        n, (h, w) = images.shape[1], (-(-size // stride) for size in images.shape[-2:])
        there = centres_before_crop(centres, intrinsics, batch["intrinsics"], (h, w), stride)
        further = further_centres(n, self.teacher.patches, (h, w), generators).to(images.device)
        m = centres.shape[2]
        stages = self.teacher_stages(n, m + self.teacher.patches, net.config.self_edges, images.device)
        return teach(
            teacher, images, batch["intrinsics"], torch.cat([there, further], 2), stages, self.limits, m,
            self.teacher.backwards,
        )  # fmt: skip

    def teacher_stages(self, frames: int, patches: int, self_edges: bool, device: torch.device | str) -> list[Stage]:
        """Schedule of the teacher's updates."""
        key = (frames, patches, torch.device(device))
        if key not in self._stages:
            schedule = training_schedule(frames, patches, self.teacher.updates, self.initial, self.settle, self_edges)
            if schedule[-1].frames < frames:
                remedy = "give more, or leave out model.initial"
                raise DvoError("too few for all frames to join", field="model.teacher.updates", remedy=remedy)
            self._stages[key] = to_device(schedule, device)
        return self._stages[key]

    def _network_of_teacher(self, net: PatchVO) -> PatchVO:
        if self._teacher_net is None:
            self._teacher_net = PatchVO(net.config).requires_grad_(False).eval()
            self._teacher_net.to(next(net.parameters()).device)
        return self._teacher_net

    def accept_loss(self, context: StepContext, found: StepLoss) -> StepLoss:
        """Let the teacher follow the student's weights, if it is an average of them."""
        if self.teacher.decay < 1:
            context.buffers["teacher"].lerp_(flat_weights(context.net), 1 - self.teacher.decay)
        return found
