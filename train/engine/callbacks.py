"""Interruption of a run without loss of a step."""

from __future__ import annotations

import signal
from pathlib import Path
from types import FrameType
from typing import Any

import lightning as L


class StopGently(L.Callback):
    """Finishes the running step and saves ``last.ckpt`` on Ctrl-C; the same command goes on from there.

    A second Ctrl-C stops at once.

    Args:
        dirpath: folder of the checkpoint.
    """

    def __init__(self, dirpath: str) -> None:
        self.path = Path(dirpath) / "last.ckpt"
        self._before: Any = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take over Ctrl-C."""

        def stop(number: int, frame: FrameType | None) -> None:
            if trainer.should_stop:
                raise KeyboardInterrupt
            trainer.should_stop = True
            if trainer.is_global_zero:
                print(f"\nstopping after this step; saving {self.path}", flush=True)

        self._before = signal.signal(signal.SIGINT, stop)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save, and give Ctrl-C back."""
        trainer.save_checkpoint(self.path)
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)
            self._before = None
