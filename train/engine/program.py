"""Training of any network: the steps of an optimiser around the loss of a task."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import lightning as L
import torch
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.models.registry import as_network
from dvo.models.weights import LoadedWeights
from train.engine.provenance import KEY, Provenance, material_of
from train.engine.ranks import all_agree, world_size
from train.engine.rates import constant_rate, one_cycle_rate
from train.engine.recovery import LastGood, weights_finite
from train.tasks.registry import DEFAULT_TASK
from train.tasks.task import Batch, StepContext, Task


@dataclass(frozen=True)
class EngineSettings:
    """Optimiser, averaging and recovery.

    Attributes:
        learning_rate: of AdamW, at its highest.
        weight_decay: of AdamW.
        clip: limit of the gradient norm.
        warmup: steps of linear warm-up; the rate is constant after it.
        decay_from: first step of a linear decay to zero that ends a run; None: no decay.
        decay_steps: length of that decay.
        cycle: length of a OneCycle schedule (DPVO) that replaces warm-up, constant rate and decay; None: those.
        ema: decay of the moving average of the weights, which is what is shipped.
        bad_steps: steps that fail in a row before the last good state is restored.
        keep_every: steps between copies of the good state.
    """

    learning_rate: float = 5e-4
    weight_decay: float = 1e-6
    clip: float = 10.0
    warmup: int = 100
    decay_from: int | None = None
    decay_steps: int = 1000
    cycle: int | None = None
    ema: float = 0.998
    bad_steps: int = 5
    keep_every: int = 50

    def schedule(self) -> Callable[[int], float]:
        """Factor of the learning rate by step, counted from the first step of the state."""
        if self.cycle:
            return one_cycle_rate(self.cycle)
        return constant_rate(self.warmup, self.decay_from, self.decay_steps)


class TrainingProgram(L.LightningModule):
    """Trains the network of a task on clips.

    A step whose loss, gradient or weights are not finite changes nothing and is counted (``skipped``); after
    ``bad_steps`` of them in a row, or when the weights themselves are bad, the run returns to the last good state.

    Args:
        task: network and loss.
        settings: of the optimiser.
        task_name: name of the task, for checkpoints.
        hyper_parameters: plain values for checkpoints and logs, enough to build the task again.

    Attributes:
        net: the network in training.
        average: moving average of its weights.
        provenance: what the network has been trained on.
        new_run: take rates from the settings, and callbacks as they are, not from the state that is loaded.
        from_trained: a new run that starts from trained weights.

    Raises:
        DvoError: a network that does not name its architecture and sizes.
    """

    def __init__(
        self,
        task: Task,
        settings: EngineSettings,
        task_name: str = DEFAULT_TASK,
        hyper_parameters: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.task, self.settings, self.task_name = task, settings, task_name
        self.save_hyperparameters(hyper_parameters or {})
        self.net = task.network()
        self.average = copy.deepcopy(self.net).requires_grad_(False)
        self._task_buffers = tuple(task.buffers())
        for name, value in task.buffers().items():
            self.register_buffer(name, value)
        self.register_buffer("skipped", torch.zeros((), dtype=torch.long))
        self.recovered = 0
        self._bad_in_a_row = 0
        self._bad = False
        self._last_good = LastGood()
        origin = task.origin()
        self.provenance = Provenance() if origin is None else Provenance.of_weights(origin)
        self.new_run = self.from_trained = False
        self._clock = time.perf_counter()
        as_network(self.net)

    @property
    def context(self) -> StepContext:
        """State for the task."""
        return StepContext(self.net, self.global_step, {name: getattr(self, name) for name in self._task_buffers})

    # -- one step ------------------------------------------------------------------------------------------------

    def training_step(self, batch: Batch, index: int) -> Tensor | None:
        """Loss of a batch with a graph; None (or, in a distributed run, zero) for a step to be skipped."""
        waited = time.perf_counter() - self._clock
        clips = clips_in(batch)
        self._count_clips(clips)
        context, found = self.context, None
        try:
            found = self.task.compute_loss(context, batch)
            fine = torch.isfinite(found.loss)
        except torch.linalg.LinAlgError:  # of numbers that overflowed; the other processes take part in the decision
            fine = torch.tensor(False, device=self.device)
        self._bad = not all_agree(fine)
        if self._bad or found is None:
            return self._no_loss() if world_size() > 1 else None
        found = self.task.accept_loss(context, found)
        measures = found.measures | {
            "skipped": self.skipped.float(),
            "recovered": torch.tensor(float(self.recovered)),
            "wait_s": torch.tensor(waited),
        }
        self.log_dict(measures, batch_size=clips)
        self.log_dict({"loss": found.loss.detach()} | found.shown, prog_bar=True, batch_size=clips)
        return found.loss + self._no_loss() if world_size() > 1 else found.loss

    def _no_loss(self) -> Tensor:
        """Zero with a zero gradient for every parameter: a distributed step waits for all of them."""
        return torch.stack([torch.nan_to_num(p).sum() for p in self.net.parameters()]).sum() * 0.0

    def _count_clips(self, clips: int) -> None:
        """The position in the data is saved with the weights, so it moves before a checkpoint can be written."""
        data = getattr(self._trainer, "datamodule", None)
        first, clips = getattr(data, "clips_seen", 0), clips * world_size()
        self.provenance = self.provenance.after(clips, material_of(data, first, world_size()))
        if hasattr(data, "clips_seen"):
            data.clips_seen += clips

    # -- the optimiser -------------------------------------------------------------------------------------------

    def configure_optimizers(self) -> dict[str, Any]:
        """AdamW with the configured schedule of rates, a step at a time."""
        s = self.settings
        optimizer = torch.optim.AdamW(self.net.parameters(), s.learning_rate, weight_decay=s.weight_decay)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, s.schedule())
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Log and clip the gradients; a gradient that is not finite makes the step a bad one."""
        for name, part in self.task.parts(self.net).items():
            norms = [p.grad.norm() for p in part.parameters() if p.grad is not None]
            if norms:
                self.log(f"gradient_norm_{name}", torch.stack(norms).norm())
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), self.settings.clip)
        self.log("gradient_norm", norm)
        self._bad = self._bad or not all_agree(torch.isfinite(norm))
        if self._bad:
            optimizer.zero_grad()  # parameters without a gradient stay as they are

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None) -> None:
        """Step, then averaging or recovery."""
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        self._after_step(optimizer.optimizer if hasattr(optimizer, "optimizer") else optimizer)

    def _after_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Moving average; or, after a bad step, recovery. All of it before a checkpoint can be written."""
        modules = [self.net, self.average]
        sound = all_agree(weights_finite([self.net]))
        if self._bad or not sound:
            self.skipped += 1
            self._bad_in_a_row += 1
            if not sound or self._bad_in_a_row >= self.settings.bad_steps:
                self.recovered += self._last_good.restore(modules, optimizer)
                self._bad_in_a_row = 0
            return
        self._bad_in_a_row = 0
        steps = self.global_step + 1
        with torch.no_grad():
            keep = min(self.settings.ema, (1 + steps) / (10 + steps))
            for mean, now in zip(self.average.parameters(), self.net.parameters(), strict=True):
                mean.lerp_(now, 1 - keep)
            for kept, now in zip(self.average.buffers(), self.net.buffers(), strict=True):
                kept.copy_(now)  # running statistics are averages already
        if steps % self.settings.keep_every == 0:
            self._last_good.keep(modules, optimizer)

    # -- timing --------------------------------------------------------------------------------------------------

    def on_train_start(self) -> None:
        """Keep the state that a run begins with, as the first good one."""
        optimizer = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, torch.optim.Optimizer)
        if bool(weights_finite([self.net])):
            self._last_good.keep([self.net, self.average], optimizer)
        self._clock = time.perf_counter()

    def on_train_batch_end(self, outputs: Any, batch: Batch, batch_idx: int) -> None:
        """Log the time of the step."""
        seconds = time.perf_counter() - self._clock
        self.log("step_s", seconds)
        self.log("clips_per_s", clips_in(batch) * world_size() / seconds)
        self._clock = time.perf_counter()

    def leave_out_of_timing(self, seconds: float) -> None:
        """Exclude time between two steps that was spent on something else than training."""
        self._clock += seconds

    # -- checkpoints ---------------------------------------------------------------------------------------------

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add task, architecture, sizes and the state that is not a tensor."""
        network = as_network(self.net)
        checkpoint["task"] = self.task_name
        checkpoint["network"] = {"architecture": network.architecture, "config": network.config.to_dict()}
        own = {"recovered": self.recovered, "bad_in_a_row": self._bad_in_a_row}
        checkpoint["training"] = self.task.state_dict() | own
        checkpoint[KEY] = self.provenance.to_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the state that is not a tensor.

        Raises:
            DvoError: the state of another task.
        """
        self.check_task(checkpoint)
        data = getattr(self._trainer, "datamodule", None)
        if hasattr(data, "clips_seen") and type(data).__qualname__ not in checkpoint:
            rank_zero_warn(f"the state holds no position in {type(data).__qualname__}: its clips start from the first")
        self.provenance = Provenance.of_state(checkpoint)
        if self.new_run:
            checkpoint["callbacks"] = {}  # they know the files of another run
            self._renew_rates(checkpoint)
        state = checkpoint.get("training")  # absent in checkpoints of the time before the balance
        if state is None:
            return
        self.task.load_state_dict(state)
        self.recovered, self._bad_in_a_row = state["recovered"], state["bad_in_a_row"]

    def check_task(self, checkpoint: Mapping[str, Any], file: object | None = None) -> None:
        """Check that a training state is of the task of this program.

        Raises:
            DvoError: it is of another.
        """
        name = checkpoint.get("task", DEFAULT_TASK)
        if name != self.task_name:
            raise DvoError(
                f"the state is of the task '{name}', the configuration names '{self.task_name}'",
                file=file,
                field="task",
                remedy="begin another run with --name, or correct the configuration",
            )

    def _renew_rates(self, checkpoint: dict[str, Any]) -> None:
        """Put the rates of the settings, at the step of the state, in place of those of its optimiser."""
        base, decay = self.settings.learning_rate, self.settings.weight_decay
        now = base * self.settings.schedule()(checkpoint["global_step"])
        for scheduler in checkpoint.get("lr_schedulers", []):
            groups = len(scheduler["base_lrs"])
            scheduler |= {"base_lrs": [base] * groups, "_last_lr": [now] * groups}
        for optimizer in checkpoint.get("optimizer_states", []):
            for group in optimizer["param_groups"]:
                group |= {"lr": now, "initial_lr": base, "weight_decay": decay}

    def start_from(self, weights: LoadedWeights) -> None:
        """Take over trained weights, before the first step; they may lack what the task says is new.

        Raises:
            DvoError: weights of another network.
        """
        file = weights.info.path if weights.info else weights.name
        network = as_network(self.net)
        if weights.architecture != network.architecture:
            raise DvoError(
                f"holds a network '{weights.architecture}', the task trains '{network.architecture}'",
                file=file,
                remedy="give weights of that network, or name another task",
            )
        tensors = weights.model.state_dict()
        check_tensors(self.net, tensors, file)
        for module in (self.net, self.average):
            module.load_state_dict(tensors)
        self.task.trained_weights_loaded({name: getattr(self, name) for name in self._task_buffers})
        self.provenance = Provenance.of_weights(weights)


def check_tensors(network: torch.nn.Module, tensors: Mapping[str, Tensor], file: object) -> None:
    """Check that tensors are those of a network, by name and shape.

    Raises:
        DvoError: they are not; names the first that differs.
    """
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    theirs = {name: tuple(value.shape) for name, value in tensors.items()}
    for name in sorted({*shapes, *theirs}):
        if shapes.get(name) != theirs.get(name):
            raise DvoError(
                f"has {theirs.get(name, 'nothing')} where the network of the configuration has "
                f"{shapes.get(name, 'nothing')}",
                file=file,
                field=name,
                remedy="name the network that the file holds, for instance with --model.model",
            )


def clips_in(batch: Batch) -> int:
    """Number of clips in a batch."""
    return len(next(iter(batch.values())))
