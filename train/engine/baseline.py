"""Loss of the weights that a run starts from, before its first step."""

from __future__ import annotations

import copy
import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import lightning as L
import numpy as np
import torch

CLIPS = 4
"""Clips over which the loss is averaged, or one batch: the training process renders them itself."""


@contextmanager
def undisturbed() -> Iterator[None]:
    """Restore the random states of Python, numpy and torch (CPU) after whatever runs inside."""
    python, numpy, torch_cpu = random.getstate(), np.random.get_state(), torch.random.get_rng_state()  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
        torch.random.set_rng_state(torch_cpu)


class LossBeforeTraining(L.Callback):
    """Prints the loss of trained weights on the first batches of the run, and its measures with their units.

    The loss is the weighted sum that the configuration names, and compares with those of the steps of the same
    configuration alone. Nothing is trained, drawn from the random states, or counted. A run that begins with random
    weights, or goes on, prints nothing.

    Args:
        clips: to average over, in whole batches.
    """

    def __init__(self, clips: int = CLIPS) -> None:
        self.clips = clips

    @torch.no_grad()
    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Measure and print."""
        program: Any = pl_module
        data = getattr(trainer, "datamodule", None)
        if not (program.from_trained and trainer.is_global_zero and hasattr(data, "next_batches")):
            return
        context = program.context
        buffers = {name: value.clone() for name, value in context.buffers.items()}
        context = replace(context, net=copy.deepcopy(program.net), buffers=buffers)
        found = []
        with undisturbed():
            for batch in data.next_batches(max(1, self.clips // data.batch_size)):
                moved = program.transfer_batch_to_device(batch, program.device, 0)
                found.append(program.task.compute_loss(context, moved))
        losses = [float(one.loss) for one in found]
        parts = [f"loss {np.mean(losses):.3g} ({min(losses):.3g} to {max(losses):.3g} on {len(losses)} batches)"]
        for name, unit in program.task.units.items():
            values = [float(one.measures[name]) for one in found if name in one.measures]
            if values:
                parts.append(f"{name} {np.nanmean(values):.3g} {unit}")
        print(f"before the first step: {', '.join(parts)}", flush=True)
