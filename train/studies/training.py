"""Training runs of a study: resumed from their last checkpoint, timed by the processor."""

from __future__ import annotations

import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import ModelCheckpoint

from train.data.stream import ClipStream
from train.engine.build import make_program, task_settings
from train.engine.program import TrainingProgram


class StepClock(L.Callback):
    """Adds up the processor time of the steps: forward pass, loss, backward pass, optimiser; kept with the checkpoint.

    Rendering, reading of clips, measurements and checkpoints lie between the steps and do not count.

    Attributes:
        train_seconds: of the processor, all threads together, over all runs from checkpoint to checkpoint.
    """

    def __init__(self) -> None:
        self.train_seconds = 0.0
        self._clock = 0.0

    def on_train_batch_start(self, *_: Any) -> None:
        """Start of a step."""
        self._clock = time.process_time()  # of the processor: the machine may do other work

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """End of a step."""
        self.train_seconds += time.process_time() - self._clock

    def state_dict(self) -> dict[str, Any]:
        """Time so far."""
        return {"train_seconds": self.train_seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.train_seconds = state_dict["train_seconds"]


def task_program(task: str, common: dict[str, Any], **settings: Any) -> TrainingProgram:
    """Training program of a task.

    Args:
        task: registered name, or ``"module:Class"``.
        common: settings for tasks that have them; others are left out.
        settings: of the task and the engine; they win.

    Raises:
        DvoError: no such task, or one of ``settings`` that neither has.
    """
    known = task_settings(task)
    return make_program(task, **({name: value for name, value in common.items() if name in known} | settings))


def fit(
    folder: Path,
    program: TrainingProgram,
    clips: ClipStream,
    steps: int,
    callbacks: list[L.Callback],
    save_every: int | timedelta,
) -> None:
    """Train, from the last checkpoint of a folder if there is one.

    Args:
        folder: of the checkpoint, ``last.ckpt``.
        program: to train.
        clips: to train on.
        steps: step at which training ends; -1: when a callback ends it.
        callbacks: they come before the saver, so that a checkpoint holds what they found at its own step.
        save_every: steps, or wall time, between checkpoints.
    """
    interval = {"every_n_train_steps" if isinstance(save_every, int) else "train_time_interval": save_every}
    saver = ModelCheckpoint(folder, filename="last", save_top_k=1, enable_version_counter=False, **interval)  # type: ignore[arg-type]
    trainer = L.Trainer(
        accelerator="cpu", max_steps=steps, max_epochs=-1, logger=False, enable_progress_bar=False,
        enable_model_summary=False, use_distributed_sampler=False, callbacks=[*callbacks, saver],
    )  # fmt: skip
    last = folder / "last.ckpt"
    trainer.fit(program, clips, ckpt_path=last if last.is_file() else None, weights_only=False)
    trainer.save_checkpoint(last)
