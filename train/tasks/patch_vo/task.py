"""Training task of :class:`dvo.models.patch_vo.PatchVO`: DPVO's loss, V2V's weighting and balance, MambaVO's
penalty for trends, warm-up modes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, cast

import torch
from torch import Tensor, nn

from dvo.core.errors import DvoError
from dvo.geometry import se3
from dvo.losses.balance import Coefficient, gradient
from dvo.losses.pose import pose_errors
from dvo.losses.trend import TrendPenalty
from dvo.models.patch_vo import Mode, PatchVO
from dvo.models.schedule import Stage, to_device, training_schedule
from dvo.nets.patch.config import preset
from train.data.augment import Augmentation, augment, random_source
from train.data.clips import Renderings
from train.engine.ranks import mean_over_ranks, rank
from train.tasks.patch_vo.objective import LossConfig, Terms, Truth, clip_terms, truth_of
from train.tasks.patch_vo.variants import HEADS, flow_loss_variants
from train.tasks.task import Batch, StepContext, StepLoss, Task


@dataclass(frozen=True)
class _Detail:
    """Intermediate results of a step."""

    terms: Terms
    truth: Truth
    mode: Mode
    share: Tensor  # of target flow within a quarter feature pixel


class PatchVOTask(Task):
    """Trains a preset of the patch-flow network on clips.

    Args:
        model: name of the preset.
        seed: draws patches and the edges that train the features; step ``n`` draws the same whenever it is run.
        updates: updates a clip.
        initial: frames of the first patch graph; the others join one an update. None: all at once.
        settle: updates before the first frame joins.
        warmup_mode: mode of the updates at first, see :meth:`dvo.models.patch_vo.PatchVO.unroll`.
        warmup_until: until the running share of flow within a quarter feature pixel, of edges over one or two frames,
            reaches this (poses freed before the network sees flow spoil it for good); 0: no such phase.
        warmup_steps: the phase also ends after this many steps; None: only by the share.
        correlation_gradient: share of edges that train the features through the correlation.
        loss: weights of the terms.
        augmentation: random changes of the clips, None for none.
        patches: patches a frame; None: those of the preset.
        selection: of the patches, a name in :data:`dvo.nets.patch.selection.SELECTIONS`; None: that of the preset.
        update_operator: name in :data:`dvo.nets.update.update.UPDATE_OPERATORS`; None: that of the preset.
        train_only: beginning of the names of the parameters that learn, the others are held; None: all.

    Attributes:
        beta, rotation: weights of the flow and of the rotation, which V2V's balance moves.
        trend: further weight of the flow, which the trends of the losses move.
    """

    data_type = Renderings
    units: ClassVar[Mapping[str, str]] = {
        "flow": "px of the feature map", "rotation_deg": "degrees", "translation": "median depths",
    }  # fmt: skip
    starts_from = ("distil",)

    def __init__(
        self,
        model: str = "small",
        seed: int = 0,
        updates: int = 10,
        initial: int | None = None,
        settle: int = 4,
        warmup_mode: Mode = "flow",
        warmup_until: float = 0.5,
        warmup_steps: int | None = None,
        correlation_gradient: float = 0.3,
        loss: LossConfig | None = None,
        augmentation: Augmentation | None = None,
        patches: int | None = None,
        selection: str | None = None,
        update_operator: str | None = None,
        train_only: str | None = None,
    ) -> None:
        self.model, self.seed, self.train_only = model, seed, train_only
        self.changes = {"training_patches": patches, "selection": selection, "update_operator": update_operator}
        self.updates, self.initial, self.settle = updates, initial, settle
        self.warmup_mode, self.warmup_until, self.warmup_steps = warmup_mode, warmup_until, warmup_steps
        self.correlation_gradient = correlation_gradient
        self.loss = loss or LossConfig()
        self.augmentation = augmentation
        fixed = self.loss.balance != "none"
        self.beta = Coefficient(self.loss.beta if fixed else 1.0, self.loss.balance_window)
        self.rotation = Coefficient(self.loss.rotation if fixed else 1.0, self.loss.balance_window)
        self.trend = TrendPenalty(self.loss.trend_window)
        self._stages: dict[tuple[int, int, Mode, torch.device], list[Stage]] = {}

    # -- the network and its state -------------------------------------------------------------------------------

    def network(self) -> nn.Module:
        """New network of the preset.

        Raises:
            DvoError: it lacks the parameter on which gradients are compared.
        """
        changes = {name: value for name, value in self.changes.items() if value is not None}
        net = PatchVO(replace(preset(self.model), **changes))
        wanted = self.loss.balance_parameter
        if self.loss.follows_gradients and wanted not in dict(net.named_parameters()):
            remedy = "name one of this update operator, such as update.history.enter.weight of 'mamba'"
            raise DvoError(f"no parameter '{wanted}'", field="balance_parameter", remedy=remedy)
        if self.train_only is not None:
            self._hold_others(net, self.train_only)
        return net

    def _hold_others(self, net: nn.Module, beginning: str) -> None:
        """Hold the parameters whose names begin otherwise."""
        for name, parameter in net.named_parameters():
            parameter.requires_grad_(name.startswith(beginning))
        if not any(parameter.requires_grad for parameter in net.parameters()):
            known = ", ".join(dict.fromkeys(name.split(".")[0] for name, _ in net.named_parameters()))
            raise DvoError(f"no parameter begins with '{beginning}'", field="train_only", remedy=f"name one of {known}")
        if self.loss.follows_gradients and not net.get_parameter(self.loss.balance_parameter).requires_grad:
            remedy = "choose the balance none or fixed"
            raise DvoError("holds the parameter that the balance compares on", field="train_only", remedy=remedy)

    def parts(self, net: nn.Module) -> dict[str, nn.Module]:
        """Encoder and update operator."""
        net = cast(PatchVO, net)
        return {"encoder": net.patchify, "update": net.update}

    def buffers(self) -> dict[str, Tensor]:
        """``within_quarter``: running share of good flow; ``warming``: whether the warm-up goes on."""
        return {"within_quarter": torch.zeros(()), "warming": torch.tensor(self.warmup_until > 0)}

    def trained_weights_loaded(self, buffers: Mapping[str, Tensor]) -> None:
        """End the warm-up, which is for a network that does not see flow yet."""
        buffers["warming"].fill_(False)

    def state_dict(self) -> dict[str, Any]:
        """State of the balance."""
        parts = {"beta": self.beta, "rotation": self.rotation, "trend": self.trend}
        return {name: part.state_dict() for name, part in parts.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the balance, if there is one."""
        if self.loss.follows_gradients:
            self.beta.load_state_dict(state["beta"])
            self.rotation.load_state_dict(state["rotation"])
        if self.loss.balance == "trend" and "trend" in state:  # states of other balances may be older than it
            self.trend.load_state_dict(state["trend"])

    # -- a step --------------------------------------------------------------------------------------------------

    def stages(self, net: PatchVO, frames: int, mode: Mode, device: torch.device | str = "cpu") -> list[Stage]:
        """Schedule of the updates on clips of so many frames."""
        config = net.config
        key = (frames, config.training_patches, mode, torch.device(device))
        if key not in self._stages:
            patches, self_edges = config.training_patches, config.self_edges
            if mode == "flow":  # edges that the correlation can reach without the help of bundle adjustment
                schedule = training_schedule(frames, patches, self.updates, self_edges=self_edges, reach=2)
            else:
                schedule = training_schedule(frames, patches, self.updates, self.initial, self.settle, self_edges)
            self._stages[key] = to_device(schedule, device)
        return self._stages[key]

    def generators(self, step: int, clips: int) -> list[torch.Generator]:
        """A source of random numbers for each clip of a step, the same however the clips are spread over processes."""
        first = self.seed * 1_000_003 + step
        numbers = range(rank() * clips, (rank() + 1) * clips)
        return [random_source(first + number * 2**40) for number in numbers]

    def terms(self, context: StepContext, batch: Batch, mode: Mode) -> tuple[Terms, dict[str, Tensor], Truth]:
        """Run the updates on a batch; see :func:`train.tasks.patch_vo.objective.clip_terms`."""
        net = cast(PatchVO, context.net)
        truth = truth_of(batch, net.config.STRIDE)
        b, n = batch["images"].shape[:2]
        device = batch["images"].device
        states = net.unroll(
            batch["images"],
            batch["intrinsics"],
            self.stages(net, n, mode, device),
            poses_cw=truth.poses_cw if mode == "structure" else se3.identity(b, n, device=device),
            mode=mode,
            generator=self.generators(context.step, b),
            correlation_gradient=self.correlation_gradient,
        )
        terms, measures = clip_terms(states, truth, self.loss, mode)
        return terms, measures, truth

    def compute_loss(self, context: StepContext, batch: Batch) -> StepLoss:
        """Loss under the weights that the balance has found so far."""
        warming = context.buffers["warming"]
        if self.warmup_steps is not None and context.step >= self.warmup_steps:
            warming.fill_(False)
        mode: Mode = self.warmup_mode if warming else "joint"
        if self.augmentation is not None:
            batch = augment(batch, self.augmentation, self.seed, context.step)
        terms, measures, truth = self.terms(context, batch, mode)
        share = measures.pop("target_px<0.25")
        total = terms.total(self.loss, self.beta.value * self.trend.value, self.rotation.value)
        return StepLoss(total, measures, {"target_px<0.25": share}, _Detail(terms, truth, mode, share))

    def accept_loss(self, context: StepContext, found: StepLoss) -> StepLoss:
        """Loss after the balance has been measured, and the progress of the warm-up."""
        detail: _Detail = found.detail
        measures = dict(found.measures)
        rotation = self.rotation.value  # of the last comparison: V2V has summed the pose loss when it compares anew
        if self._compares(detail.mode, context.step):
            measures |= self._compare(context.net, detail.terms, rotation)
        sums = {name: value.detach() for name, value in detail.terms.sums(self.loss).items()}
        if self.loss.balance == "trend" and detail.mode == "joint":
            pose = mean_over_ranks(sums["translation"] + rotation * sums["rotation"])
            measures["trend_penalty"] = torch.tensor(
                self.trend.follow(float(pose), float(mean_over_ranks(sums["flow"])))
            )
        loss = detail.terms.total(self.loss, self.beta.value * self.trend.value, rotation)
        if torch.isfinite(detail.truth.inverse_depth).any():
            self.follow(context, mean_over_ranks(detail.share))
        measures |= {f"loss_{name}": value for name, value in sums.items()}
        measures |= {"beta": torch.tensor(self.beta.value), "rotation_coefficient": torch.tensor(rotation)}
        measures |= {"warming": context.buffers["warming"].float(), "within_quarter": context.buffers["within_quarter"]}
        return replace(found, loss=loss, measures=measures)

    def follow(self, context: StepContext, share: Tensor) -> None:
        """Running share of good flow; once high enough, the warm-up is over for good."""
        within = context.buffers["within_quarter"]
        within.lerp_(share, 0.02)
        if within > self.warmup_until:
            context.buffers["warming"].fill_(False)

    # -- balance by gradients ------------------------------------------------------------------------------------

    def _compares(self, mode: Mode, step: int) -> bool:
        every = self.loss.balance_every
        return self.loss.follows_gradients and mode == "joint" and step > 0 and step % every == 0

    def _compare(self, net: nn.Module, terms: Terms, rotation: float) -> dict[str, Tensor]:
        """Measure gradients on one parameter and move the coefficients."""
        parameter = net.get_parameter(self.loss.balance_parameter)
        sums = terms.sums(self.loss)
        g = {name: gradient(sums[name], parameter) for name in ("flow", "translation", "rotation")}
        norms = {name: float(value.norm()) for name, value in g.items()}
        norms["pose"] = float((g["translation"] + rotation * g["rotation"]).norm())
        if all(torch.isfinite(value).all() for value in g.values()):
            self.beta.follow(norms["pose"], norms["flow"])
            if self.loss.balance == "v2v":
                self.rotation.follow(norms["translation"], norms["rotation"])
        return {f"balance_gradient_{name}": torch.tensor(value) for name, value in norms.items()}

    # -- studies -------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def measure(self, net: nn.Module, batch: Batch, seed: int) -> dict[str, float]:
        """Errors of a clip after the last update.

        Returns:
            ``pose`` (translation in median depths + rotation in radians, unweighted), ``rotation_deg``,
            ``rotation_ratio`` (over true motion), ``translation`` and ``flow`` (plain, feature pixels).
        """
        net = cast(PatchVO, net)
        truth = truth_of(batch, net.config.STRIDE)
        b, n = batch["images"].shape[:2]
        states = list(
            net.unroll(
                batch["images"], batch["intrinsics"], self.stages(net, n, "joint"), poses_cw=se3.identity(b, n),
                generator=torch.Generator().manual_seed(seed),
            )
        )  # fmt: skip
        _, measures = clip_terms(states[-1:], truth, LossConfig())
        errors = pose_errors(states[-1].poses_cw, truth.poses_cw)
        kept = ("rotation_deg", "rotation_ratio", "translation", "flow")
        pose = float(errors.translation + errors.rotation)
        return {"pose": pose} | {name: float(measures[name]) for name in kept}

    def loss_variants(self, net: nn.Module, batch: Batch, seed: int) -> dict[str, Tensor]:
        """Flow losses, plain and weighted by confidence; see :mod:`train.tasks.patch_vo.variants`."""
        net = cast(PatchVO, net)
        stages = self.stages(net, batch["images"].shape[1], "joint")
        return flow_loss_variants(net, batch, stages, seed, self.loss)

    def probed_parameters(self, net: nn.Module) -> list[str]:
        """Last layers of the heads for flow revision and confidence."""
        return list(HEADS)
