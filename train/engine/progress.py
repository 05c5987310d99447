"""Progress of a run in steps."""

from __future__ import annotations

import sys
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import ProgressBar
from tqdm import tqdm


class StepBar(ProgressBar):
    """Shows the step that a run starts at, and how many it has taken of how many.

    A bar on a terminal; elsewhere a line every ``log_every_n_steps`` steps and at the end.
    """

    def __init__(self) -> None:
        super().__init__()
        self.enabled = True
        self.start = 0
        self._bar: Any = None

    def enable(self) -> None:
        """Show progress."""
        self.enabled = True

    def disable(self) -> None:
        """Show nothing."""
        self.enabled = False

    def print(self, *args: Any, **kwargs: Any) -> None:
        """Print above the bar."""
        if self._bar is not None:
            self._bar.clear()
        print(*args, **kwargs)
        if self._bar is not None:
            self._bar.refresh()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take the step of the state."""
        self.start = trainer.global_step
        if self.enabled and sys.stderr.isatty():
            total = trainer.max_steps - self.start if trainer.max_steps >= 0 else None
            layout = "{desc} + {n_fmt}" + (" of {total_fmt} {bar:20}" if total else "")
            layout += " {rate_fmt} {elapsed}" + ("<{remaining}" if total else "") + "{postfix}"
            name = f"step {self.start:,}"
            self._bar = tqdm(total=total, desc=name, bar_format=layout, dynamic_ncols=True, unit="step")

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """Advance."""
        taken = trainer.global_step - self.start
        if self._bar is not None:
            if taken > self._bar.n:
                self._bar.set_postfix(self._measures(trainer), refresh=False)
                self._bar.update(taken - self._bar.n)
        elif self.enabled and (taken % trainer.log_every_n_steps == 0 or trainer.global_step == trainer.max_steps):
            print(self.line(trainer), flush=True)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Leave the bar as it is."""
        self._close()

    def on_exception(self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException) -> None:
        """Leave the bar as it is."""
        self._close()

    def line(self, trainer: L.Trainer) -> str:
        """Progress in one line, such as ``step 17,826 + 20 of 20  loss 6.8``."""
        of = f" of {trainer.max_steps - self.start:,}" if trainer.max_steps >= 0 else ""
        measures = "".join(f"  {name} {value}" for name, value in self._measures(trainer).items())
        return f"step {self.start:,} + {trainer.global_step - self.start:,}{of}{measures}"

    @staticmethod
    def _measures(trainer: L.Trainer) -> dict[str, str]:
        return {name: f"{float(value):.3g}" for name, value in trainer.progress_bar_metrics.items()}

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
