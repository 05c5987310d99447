"""The training program of :class:`dvo.models.patch_vo.PatchVO` as a LightningModule."""

from __future__ import annotations

import copy
import time
from typing import Any

import lightning as L
import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.losses.balance import Coefficient, gradient
from dvo.models.patch_vo import Mode, PatchVO
from dvo.models.schedule import Stage, to_device, training_schedule
from dvo.nets.config import preset
from train.data.augment import Augmentation, augment
from train.engine.ranks import all_agree, mean_over_ranks, rank, world_size
from train.engine.rates import constant_rate, one_cycle_rate
from train.engine.recovery import LastGood, weights_finite
from train.tasks.patch_vo.objective import LossConfig, Terms, Truth, clip_terms, truth_of


class PatchVOTraining(L.LightningModule):
    """Trains a preset on clips.

    A step whose loss, gradient or weights are not finite changes nothing and is counted (``skipped``); after
    ``bad_steps`` of them in a row, or when the weights themselves are bad, the run returns to the last good state.

    Args:
        model: name of the preset.
        seed: draws patches and the edges that train the features; step ``n`` draws the same whenever it is run.
        updates: updates a clip.
        initial: frames of the first patch graph; the others join one an update. None: all at once.
        settle: updates before the first frame joins.
        learning_rate, weight_decay, clip: AdamW and the limit of the gradient norm.
        warmup: steps of linear warm-up; the rate is constant after it.
        decay_from, decay_steps: start and length of a linear decay to zero that ends a run; None: no decay.
        cycle: length of a OneCycle schedule (DPVO) that replaces warm-up, constant rate and decay; None: those.
        ema: decay of the moving average of the weights, which is what is shipped.
        warmup_mode: how the updates run at first, see :meth:`dvo.models.patch_vo.PatchVO.unroll`.
        warmup_until: until the running share of flow within a quarter feature pixel, of edges over one or two frames,
            reaches this (poses freed before the flow has clicked spoil it for good); 0: no such phase.
        warmup_steps: the phase also ends after this many steps; None: only by the share.
        correlation_gradient: share of edges that train the features through the correlation.
        loss: weights of the terms.
        augmentation: random changes of the clips, None for none.
        bad_steps: steps that fail in a row before the last good state is restored.
        keep_every: steps between copies of the good state.
    """

    def __init__(
        self,
        model: str = "small",
        seed: int = 0,
        updates: int = 10,
        initial: int | None = None,
        settle: int = 4,
        learning_rate: float = 5e-4,
        weight_decay: float = 1e-6,
        clip: float = 10.0,
        warmup: int = 100,
        decay_from: int | None = None,
        decay_steps: int = 1000,
        cycle: int | None = None,
        ema: float = 0.998,
        warmup_mode: Mode = "flow",
        warmup_until: float = 0.5,
        warmup_steps: int | None = None,
        correlation_gradient: float = 0.3,
        loss: LossConfig | None = None,
        augmentation: Augmentation | None = None,
        bad_steps: int = 5,
        keep_every: int = 50,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["loss", "augmentation"])
        self.net = PatchVO(preset(model))
        self.average = copy.deepcopy(self.net).requires_grad_(False)
        self.loss = loss or LossConfig()
        self.augmentation = augmentation
        fixed = self.loss.balance != "none"
        self.beta = Coefficient(self.loss.beta if fixed else 1.0, self.loss.balance_window)
        self.rotation = Coefficient(self.loss.rotation if fixed else 1.0, self.loss.balance_window)
        self.register_buffer("within_quarter", torch.zeros(()))
        self.register_buffer("warming", torch.tensor(warmup_until > 0))
        self.register_buffer("skipped", torch.zeros((), dtype=torch.long))
        self.recovered = 0
        self._bad_in_a_row = 0
        self._bad = False
        self._last_good = LastGood()
        self._stages: dict[tuple[int, Mode, torch.device], list[Stage]] = {}
        self._clock = time.perf_counter()

    # -- one step ------------------------------------------------------------------------------------------------

    def stages(self, frames: int, mode: Mode) -> list[Stage]:
        """The schedule of clips of so many frames."""
        key = (frames, mode, self.device)
        if key not in self._stages:
            h = self.hparams
            config = self.net.config
            patches, self_edges = config.training_patches, config.self_edges
            if mode == "flow":  # edges that the correlation can reach without the help of bundle adjustment
                schedule = training_schedule(frames, patches, h.updates, self_edges=self_edges, reach=2)
            else:
                schedule = training_schedule(frames, patches, h.updates, h.initial, h.settle, self_edges)
            self._stages[key] = to_device(schedule, self.device)
        return self._stages[key]

    def generators(self, clips: int) -> list[torch.Generator]:
        """A source of random numbers for each clip of this step, the same however the clips are spread over
        processes."""
        first = self.hparams.seed * 1_000_003 + self.global_step
        numbers = range(rank() * clips, (rank() + 1) * clips)
        return [torch.Generator().manual_seed(first + number * 2**40) for number in numbers]

    def forward_terms(self, batch: dict[str, Tensor], mode: Mode) -> tuple[Terms, dict[str, Tensor]]:
        """Run the updates on a batch; see :func:`train.tasks.patch_vo.objective.clip_terms`."""
        truth: Truth = truth_of(batch, self.net.config.STRIDE)
        b, n = batch["images"].shape[:2]
        states = self.net.unroll(
            batch["images"],
            batch["intrinsics"],
            self.stages(n, mode),
            poses_cw=truth.poses_cw if mode == "structure" else se3.identity(b, n, device=self.device),
            mode=mode,
            generator=self.generators(b),
            correlation_gradient=self.hparams.correlation_gradient,
        )
        return clip_terms(states, truth, self.loss, mode)

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor | None:
        waited = time.perf_counter() - self._clock
        h, b = self.hparams, len(batch["images"])
        self._count_clips(b)
        if h.warmup_steps is not None and self.global_step >= h.warmup_steps:
            self.warming.fill_(False)
        mode: Mode = h.warmup_mode if self.warming else "joint"
        if self.augmentation is not None:
            batch = augment(batch, self.augmentation, h.seed, self.global_step)
        try:
            terms, measures = self.forward_terms(batch, mode)
            fine = torch.isfinite(terms.total(self.loss, self.beta.value, self.rotation.value))
        except torch.linalg.LinAlgError:  # of numbers that overflowed on the way; the other processes must be told
            terms, measures, fine = Terms(), {}, torch.tensor(False, device=self.device)
        self._bad = not all_agree(fine)
        if self._bad:
            return self._no_loss() if world_size() > 1 else None
        rotation = self.rotation.value  # of the last comparison: V2V has summed the pose loss when it compares anew
        if self._compares(mode):
            measures |= self._compare(terms, rotation)
        loss = terms.total(self.loss, self.beta.value, rotation)
        share = measures.pop("target_px<0.25")
        if torch.isfinite(truth_of(batch, self.net.config.STRIDE).inverse_depth).any():
            self._follow(mean_over_ranks(share))
        sums = terms.sums(self.loss)
        measures |= {f"loss_{name}": value.detach() for name, value in sums.items()}
        measures |= {"beta": torch.tensor(self.beta.value), "rotation_coefficient": torch.tensor(rotation)}
        measures |= {"warming": self.warming.float(), "within_quarter": self.within_quarter}
        measures |= {"skipped": self.skipped.float(), "recovered": torch.tensor(float(self.recovered))}
        measures |= {"wait_s": torch.tensor(waited)}
        self.log_dict(measures, batch_size=b)
        self.log_dict({"loss": loss.detach(), "target_px<0.25": share}, prog_bar=True, batch_size=b)
        return loss + self._no_loss() if world_size() > 1 else loss

    def _no_loss(self) -> Tensor:
        """Zero with a zero gradient for every parameter: a distributed step waits for all of them."""
        return torch.stack([torch.nan_to_num(p).sum() for p in self.net.parameters()]).sum() * 0.0

    def _follow(self, share: Tensor) -> None:
        """Running share of good flow; once high enough, the warm-up is over for good."""
        self.within_quarter.lerp_(share, 0.02)
        if self.within_quarter > self.hparams.warmup_until:
            self.warming.fill_(False)

    def _count_clips(self, clips: int) -> None:
        """The position in the data is saved with the weights, so it moves before a checkpoint can be written."""
        data = getattr(self._trainer, "datamodule", None)
        if data is not None:
            data.clips_seen += clips * world_size()

    # -- balance -------------------------------------------------------------------------------------------------

    def _compares(self, mode: Mode) -> bool:
        step = self.global_step
        return self.loss.balance == "v2v" and mode == "joint" and step > 0 and step % self.loss.balance_every == 0

    def _compare(self, terms: Terms, rotation: float) -> dict[str, Tensor]:
        """Measure gradients on one parameter and move both coefficients."""
        parameter = self.net.get_parameter(self.loss.balance_parameter)
        sums = terms.sums(self.loss)
        g = {name: gradient(sums[name], parameter) for name in ("flow", "translation", "rotation")}
        norms = {name: float(value.norm()) for name, value in g.items()}
        norms["pose"] = float((g["translation"] + rotation * g["rotation"]).norm())
        if all(torch.isfinite(value).all() for value in g.values()):
            self.beta.follow(norms["pose"], norms["flow"])
            self.rotation.follow(norms["translation"], norms["rotation"])
        return {f"balance_gradient_{name}": torch.tensor(value) for name, value in norms.items()}

    # -- the optimiser -------------------------------------------------------------------------------------------

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        for name, part in (("encoder", self.net.patchify), ("update", self.net.update)):
            norms = [p.grad.norm() for p in part.parameters() if p.grad is not None]
            if norms:
                self.log(f"gradient_norm_{name}", torch.stack(norms).norm())
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), self.hparams.clip)
        self.log("gradient_norm", norm)
        self._bad = self._bad or not all_agree(torch.isfinite(norm))
        if self._bad:
            optimizer.zero_grad()  # parameters without a gradient stay as they are

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None) -> None:
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        self._after_step(optimizer.optimizer if hasattr(optimizer, "optimizer") else optimizer)

    def _after_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Moving average; or, if the step was bad, the way back. All of it before a checkpoint can be written."""
        modules = [self.net, self.average]
        sound = all_agree(weights_finite([self.net]))
        if self._bad or not sound:
            self.skipped += 1
            self._bad_in_a_row += 1
            if not sound or self._bad_in_a_row >= self.hparams.bad_steps:
                self.recovered += self._last_good.restore(modules, optimizer)
                self._bad_in_a_row = 0
            return
        self._bad_in_a_row = 0
        steps = self.global_step + 1
        with torch.no_grad():
            keep = min(self.hparams.ema, (1 + steps) / (10 + steps))
            for mean, now in zip(self.average.parameters(), self.net.parameters(), strict=True):
                mean.lerp_(now, 1 - keep)
        if steps % self.hparams.keep_every == 0:
            self._last_good.keep(modules, optimizer)

    def on_train_start(self) -> None:
        optimizer = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, torch.optim.Optimizer)
        if bool(weights_finite([self.net])):
            self._last_good.keep([self.net, self.average], optimizer)
        self._clock = time.perf_counter()

    def on_train_batch_end(self, outputs: Any, batch: dict[str, Tensor], batch_idx: int) -> None:
        seconds = time.perf_counter() - self._clock
        self.log("step_s", seconds)
        self.log("clips_per_s", len(batch["images"]) * world_size() / seconds)
        self._clock = time.perf_counter()

    def leave_out_of_timing(self, seconds: float) -> None:
        """Time between two steps that was spent on something else than training."""
        self._clock += seconds

    def configure_optimizers(self) -> dict[str, Any]:
        h = self.hparams
        optimizer = torch.optim.AdamW(self.net.parameters(), h.learning_rate, weight_decay=h.weight_decay)
        rate = one_cycle_rate(h.cycle) if h.cycle else constant_rate(h.warmup, h.decay_from, h.decay_steps)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    # -- what a checkpoint holds beside weights and optimiser ----------------------------------------------------

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["training"] = {
            "beta": self.beta.state_dict(),
            "rotation": self.rotation.state_dict(),
            "recovered": self.recovered,
            "bad_in_a_row": self._bad_in_a_row,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        state = checkpoint.get("training")  # absent in checkpoints of the time before the balance
        if state is None:
            return
        if self.loss.balance == "v2v":
            self.beta.load_state_dict(state["beta"])
            self.rotation.load_state_dict(state["rotation"])
        self.recovered, self._bad_in_a_row = state["recovered"], state["bad_in_a_row"]
