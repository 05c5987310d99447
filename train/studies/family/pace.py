"""Pace of a training phase: its learning rate and its end, by the share of the budget that is used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import lightning as L

from train.engine.program import TrainingProgram
from train.engine.rates import one_cycle_rate
from train.studies.training import StepClock

CYCLE = 1_000_000  # steps that stand for the whole budget in the schedule

Observer = Callable[[TrainingProgram, float, int, float], None]
"""Called with the program, the share of the budget, the steps and the processor seconds of the phase."""


@dataclass(frozen=True)
class Budget:
    """Length of a phase.

    Attributes:
        seconds: of the processor.
        steps: number of steps in place of the time; 0: the time counts.
    """

    seconds: float
    steps: int = 0

    def share(self, steps: int, seconds: float) -> float:
        """Share that is used, in [0, 1].

        Args:
            steps: taken.
            seconds: of the processor, used by them.
        """
        used = steps / self.steps if self.steps else seconds / max(self.seconds, 1e-9)
        return min(1.0, used)


class Pace(StepClock):
    """Sets the learning rate before each step, and ends the phase when its budget is used.

    The rate is one cycle (DPVO's OneCycle) over the budget: from a 25th linearly to the top, then linearly to zero. It
    follows the share that is used before the step; so the number of steps under a budget of time, and with it the
    result, depends on the machine. Under a budget of steps it does not.

    Args:
        budget: of the phase.
        rate: learning rate at its highest.
        rise: share of the budget in which the rate rises.
        observe: called before the first step and after each.
    """

    def __init__(self, budget: Budget, rate: float, rise: float = 0.01, observe: Observer | None = None) -> None:
        super().__init__()
        self.budget, self.rate, self.observe = budget, rate, observe
        self._factor = one_cycle_rate(CYCLE, rise)
        self._steps = 0

    @property
    def share(self) -> float:
        """Share of the budget that is used."""
        return self.budget.share(self._steps, self.train_seconds)

    def rate_at(self, share: float) -> float:
        """Learning rate at a share of the budget."""
        return self.rate * self._factor(round(share * (CYCLE - 1)))

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Take the step of the state; end a phase that was at its end already."""
        self._steps = trainer.global_step
        self._look(trainer, pl_module)

    def on_train_batch_start(self, *arguments: Any) -> None:
        """Set the rate."""
        trainer: L.Trainer = arguments[0]
        for optimizer in trainer.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = self.rate_at(self.share)
        super().on_train_batch_start(*arguments)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Count the step."""
        super().on_train_batch_end(trainer, pl_module)
        self._steps = trainer.global_step
        self._look(trainer, pl_module)

    def _look(self, trainer: L.Trainer, program: Any) -> None:
        if self.observe is not None:
            self.observe(program, self.share, self._steps, self.train_seconds)
        if self.share >= 1:
            trainer.should_stop = True
