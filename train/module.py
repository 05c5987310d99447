"""The training program of :class:`dvo.nets.patch_vo.PatchVO` as a LightningModule."""

from __future__ import annotations

import copy
import time
from typing import Any

import lightning as L
import torch
from torch import Tensor

from dvo.geometry import se3
from dvo.nets.config import preset
from dvo.nets.patch_vo import Mode, PatchVO
from dvo.nets.schedule import Stage, to_device, training_schedule
from train.objective import LossConfig, Truth, clip_losses, truth_of


class PatchVOTraining(L.LightningModule):
    """Trains a preset on clips.

    Args:
        model: name of the preset.
        seed: draws patches and the edges that train the features; step ``n`` draws the same whenever it is run.
        updates: updates a clip.
        initial: frames of the first patch graph; the others join one an update. None: all at once.
        settle: updates before the first frame joins.
        learning_rate, weight_decay, clip: AdamW and the limit of the gradient norm.
        warmup: steps of linear warm-up; the rate is constant after it.
        decay_from, decay_steps: start and length of a linear decay to zero that ends a run; None: no decay.
        ema: decay of the moving average of the weights, which is what is shipped.
        warmup_mode: how the updates run at first, see :meth:`dvo.nets.patch_vo.PatchVO.unroll`.
        warmup_until: until the running share of flow within a quarter feature pixel, of edges over one or two frames,
            reaches this (poses freed before the flow has clicked spoil it for good); 0: no such phase.
        correlation_gradient: share of edges that train the features through the correlation.
        loss: weights of the terms.
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
        ema: float = 0.998,
        warmup_mode: Mode = "flow",
        warmup_until: float = 0.5,
        correlation_gradient: float = 0.3,
        loss: LossConfig | None = None,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["loss"])
        self.net = PatchVO(preset(model))
        self.average = copy.deepcopy(self.net).requires_grad_(False)
        self.loss = loss or LossConfig()
        self.register_buffer("within_quarter", torch.zeros(()))
        self.register_buffer("warming", torch.tensor(warmup_until > 0))
        self.register_buffer("skipped", torch.zeros((), dtype=torch.long))
        self._stages: dict[tuple[int, Mode, torch.device], list[Stage]] = {}
        self._clock = time.perf_counter()

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

    def training_step(self, batch: dict[str, Tensor], index: int) -> Tensor | None:
        waited = time.perf_counter() - self._clock
        truth: Truth = truth_of(batch, self.net.config.STRIDE)
        mode: Mode = self.hparams.warmup_mode if self.warming else "joint"
        b, n = batch["images"].shape[:2]
        start = truth.poses_cw if mode == "structure" else se3.identity(b, n, device=self.device)
        generator = torch.Generator().manual_seed(self.hparams.seed * 1_000_003 + self.global_step)
        states = self.net.unroll(
            batch["images"],
            batch["intrinsics"],
            self.stages(n, mode),
            poses_cw=start,
            mode=mode,
            generator=generator,
            correlation_gradient=self.hparams.correlation_gradient,
        )
        loss, measures = clip_losses(states, truth, self.loss, mode)
        if not torch.isfinite(loss):
            self.skipped += 1
            return None
        share = measures.pop("target_px<0.25")
        self._follow(share)
        measures |= {"warming": self.warming.float()}
        measures |= {"skipped": self.skipped.float(), "within_quarter": self.within_quarter}
        measures |= {"wait_s": torch.tensor(waited)}
        self.log_dict(measures, batch_size=b)
        self.log_dict({"loss": loss.detach(), "target_px<0.25": share}, prog_bar=True, batch_size=b)
        return loss

    def _follow(self, share: Tensor) -> None:
        """Running share of good flow; once high enough, the warm-up is over for good."""
        self.within_quarter.lerp_(share, 0.02)
        if self.within_quarter > self.hparams.warmup_until:
            self.warming.fill_(False)

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), self.hparams.clip)
        self.log("gradient_norm", norm)
        if not torch.isfinite(norm):
            self.skipped += 1
            optimizer.zero_grad()

    def on_train_batch_end(self, outputs: Any, batch: dict[str, Tensor], batch_idx: int) -> None:
        with torch.no_grad():
            keep = min(self.hparams.ema, (1 + self.global_step) / (10 + self.global_step))
            for mean, now in zip(self.average.parameters(), self.net.parameters(), strict=True):
                mean.lerp_(now, 1 - keep)
        self.trainer.datamodule.clips_seen += len(batch["images"])
        self.log("step_s", time.perf_counter() - self._clock)
        self._clock = time.perf_counter()

    def configure_optimizers(self) -> dict[str, Any]:
        h = self.hparams
        optimizer = torch.optim.AdamW(self.net.parameters(), h.learning_rate, weight_decay=h.weight_decay)

        def rate(step: int) -> float:
            factor = min(1.0, (step + 1) / max(1, h.warmup))
            if h.decay_from is not None:
                factor *= min(1.0, max(0.0, 1 - (step - h.decay_from) / h.decay_steps))
            return factor

        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}
