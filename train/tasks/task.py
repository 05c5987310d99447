"""Interface between the training engine and one network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import lightning as L
from torch import Tensor, nn

from dvo.core.errors import DvoError
from dvo.models.weights import LoadedWeights

Batch = dict[str, Tensor]
"""Clips stacked along the first dimension of every tensor."""


@dataclass(frozen=True)
class StepContext:
    """State of the engine that a task may read.

    Attributes:
        net: the network in training.
        step: optimiser steps taken so far; the same step draws the same random numbers whenever it is run.
        buffers: those of :meth:`Task.buffers`, on the device of the network; changed in place.
    """

    net: nn.Module
    step: int
    buffers: Mapping[str, Tensor]


@dataclass(frozen=True)
class StepLoss:
    """Loss of a batch.

    Attributes:
        loss: scalar with a graph.
        measures: detached scalars for the log.
        shown: detached scalars for the log and the progress bar.
        detail: intermediate results that :meth:`Task.accept_loss` needs.
    """

    loss: Tensor
    measures: dict[str, Tensor] = field(default_factory=dict)
    shown: dict[str, Tensor] = field(default_factory=dict)
    detail: Any = None


class Task(Protocol):
    """Network, loss, clips and measures of one kind of training.

    The arguments of the constructor are settings under ``model:`` in a configuration, beside those of
    :class:`train.engine.program.EngineSettings`. A task derives from this class and gets the optional methods.

    Attributes:
        data_type: class of the clips; its arguments are the settings under ``data:``.
        starts_from: names of other tasks whose training states a new run may start from; it takes the averaged weights.
        units: of the measures that are printed before the first step of a run that starts from trained weights.

    Example:
        >>> class Regression(Task):
        ...     data_type = Renderings
        ...
        ...     def __init__(self, channels: int = 8) -> None:
        ...         self.channels = channels
        ...
        ...     def network(self) -> nn.Module:
        ...         return Regressor(RegressorConfig(self.channels))
        ...
        ...     def compute_loss(self, context: StepContext, batch: Batch) -> StepLoss:
        ...         return StepLoss((context.net(batch["images"]) - batch["target"]).square().mean())
    """

    data_type: ClassVar[type[L.LightningDataModule]]
    starts_from: ClassVar[tuple[str, ...]] = ()
    units: ClassVar[Mapping[str, str]] = {}

    def network(self) -> nn.Module:
        """New network with random weights, see :class:`dvo.models.registry.Network`."""
        ...

    def compute_loss(self, context: StepContext, batch: Batch) -> StepLoss:
        """Forward pass and loss.

        The step is skipped if the loss is not finite, in any process, or if ``torch.linalg.LinAlgError`` is raised; so
        nothing but ``context.buffers`` may be changed here.
        """
        ...

    def origin(self) -> LoadedWeights | None:
        """Trained weights that :meth:`network` has taken parts of, for the record of what it was trained on."""
        return None

    def accept_loss(self, context: StepContext, found: StepLoss) -> StepLoss:
        """Final loss, after every process has found the one of :meth:`compute_loss` finite.

        Adaptive weights are updated here. All processes of a distributed run call it, so it may communicate.
        """
        return found

    def buffers(self) -> dict[str, Tensor]:
        """State of the task that is a tensor: saved by name beside the weights, and moved to their device."""
        return {}

    def trained_weights_loaded(self, buffers: Mapping[str, Tensor]) -> None:
        """Training starts from trained weights and not from random ones; state in the buffers may say so."""

    def state_dict(self) -> dict[str, Any]:
        """Further state of the task, for checkpoints."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`; keys of other owners are there too."""

    def parts(self, net: nn.Module) -> dict[str, nn.Module]:
        """Parts of the network whose gradient norms are logged, by name."""
        return {}

    def measure(self, net: nn.Module, batch: Batch, seed: int) -> dict[str, float]:
        """Errors on a held-out clip, without gradients; :mod:`train.studies.study` compares by them.

        Args:
            net: the network.
            batch: one clip, as a batch of one.
            seed: of everything that the network draws.

        Raises:
            DvoError: a task without measures.
        """
        raise DvoError(
            "the task has no measures on held-out clips", field=type(self).__name__, remedy="give it a method 'measure'"
        )

    def loss_variants(self, net: nn.Module, batch: Batch, seed: int) -> dict[str, Tensor]:
        """Losses of a clip whose gradients :mod:`train.studies.snr` compares; the first one is the reference.

        Args:
            net: the network.
            batch: one clip, as a batch of one.
            seed: of everything that the network draws.
        """
        return {"loss": self.compute_loss(StepContext(net, seed, self.buffers()), batch).loss}

    def probed_parameters(self, net: nn.Module) -> list[str]:
        """Names of the parameters on which :meth:`loss_variants` are compared."""
        return [name for name, _ in net.named_parameters()]
