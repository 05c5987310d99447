"""Interruption of a run without loss of a step, and refusal of a run that learns nothing."""

from __future__ import annotations

import signal
from pathlib import Path
from types import FrameType
from typing import Any

import lightning as L
import torch

from dvo.core.errors import DvoError
from train.engine.run import LAST


class StopGently(L.Callback):
    """Finishes the running step and saves ``last.ckpt`` on Ctrl-C; ``--resume`` goes on from there.

    A second Ctrl-C stops at once.

    Args:
        dirpath: folder of the checkpoint; None: that of the run.
    """

    def __init__(self, dirpath: str | None = None) -> None:
        self.folder = dirpath
        self._before: Any = None

    def path(self, trainer: L.Trainer) -> Path:
        """The checkpoint."""
        return Path(self.folder or trainer.default_root_dir) / LAST

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take over Ctrl-C."""

        def stop(number: int, frame: FrameType | None) -> None:
            if trainer.should_stop:
                raise KeyboardInterrupt
            trainer.should_stop = True
            if trainer.is_global_zero:
                print(f"\nstopping after this step; saving {self.path(trainer)} (--resume goes on from it)", flush=True)

        self._before = signal.signal(signal.SIGINT, stop)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save, and give Ctrl-C back."""
        trainer.save_checkpoint(self.path(trainer))
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)
            self._before = None


class RefuseStandstill(L.Callback):
    """Ends a run in which every gradient is zero or missing.

    Args:
        steps: such steps in a row, from the first step of the run on, after which it ends.

    Raises:
        DvoError: at that step, or at the end of a shorter run.
    """

    def __init__(self, steps: int = 20) -> None:
        self.steps = steps
        self.start = 0
        self.learns = False

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take the step of the state."""
        self.start = trainer.global_step

    def on_before_optimizer_step(self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: Any) -> None:
        """Look for a gradient, until one is found."""
        if not self.learns:
            gradients = [p.grad.detach() for p in pl_module.parameters() if p.grad is not None]
            self.learns = bool(gradients) and any(bool(torch.count_nonzero(g)) for g in gradients)

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """End the run if it is time."""
        taken = trainer.global_step - self.start  # several batches make a step if gradients are accumulated
        if not self.learns and (taken >= self.steps or trainer.global_step == trainer.max_steps):
            raise DvoError(
                f"the gradient is zero or the step is skipped at each of {taken} steps, so nothing is trained",
                field="model.loss",
                remedy="raise the weights of the loss; for recordings without depth, which train poses only, leave out "
                "the warm-up (model.warmup_until 0)",
            )
