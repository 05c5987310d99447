"""Endless streams of clips with a position that training states keep."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from itertools import islice
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from dvo.core.allocator import reuse_freed_memory
from train.engine.provenance import Material


class StreamSampler(Sampler[int]):
    """Indices from a start on, without end: clip ``i`` is the same whenever training is resumed.

    Args:
        start: first index of all processes together.
        batch: clips a batch, in each process.
        processes: number of processes; of every batch each takes its part.
        rank: number of this process.
    """

    def __init__(self, start: int, batch: int = 1, processes: int = 1, rank: int = 0) -> None:
        self.start, self.batch, self.processes, self.rank = start, batch, processes, rank

    def __iter__(self) -> Iterator[int]:
        first = self.start + self.rank * self.batch
        while True:
            yield from range(first, first + self.batch)
            first += self.batch * self.processes


class ClipStream(L.LightningDataModule):
    """Base of data modules that go on where a training state stopped.

    Lightning saves the position under the name of the class: a class that is renamed loses it, and
    :class:`train.engine.program.TrainingProgram` warns.

    Attributes:
        clips_seen: clips trained on so far, in all processes; the engine counts.
    """

    def __init__(self) -> None:
        super().__init__()
        self.clips_seen = 0

    def state_dict(self) -> dict[str, Any]:
        """Position in the stream."""
        return {"clips_seen": self.clips_seen}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go to a position."""
        self.clips_seen = int(state_dict["clips_seen"])

    def summary(self) -> str:
        """Description of the clips in a few words."""
        return type(self).__name__

    def material(self, clip: int, processes: int = 1) -> Material:
        """Source of the batch that holds a clip, for the model card; unknown unless a derived class says it.

        Args:
            clip: index.
            processes: number of training processes.
        """
        return Material(other=type(self).__name__)


class BatchStream(ClipStream):
    """Base of data modules whose clips are made by index, by worker processes if there are any.

    Attributes:
        batch_size: clips a step, in each process.
        workers: processes that make clips; 0: the training process does.
    """

    batch_size: int
    workers: int

    def clips(self, processes: int = 1) -> Dataset[dict[str, torch.Tensor]]:
        """The clips, in batches that span so many processes."""
        raise NotImplementedError

    def train_dataloader(self) -> DataLoader[dict[str, torch.Tensor]]:
        """Batches of this process, from the position on."""
        return self._loader(self.workers)

    def next_batches(self, count: int) -> Iterator[dict[str, torch.Tensor]]:
        """The batches that training takes next, made in this process; the position stays.

        Args:
            count: of batches.
        """
        return islice(self._loader(0), count)

    def _loader(self, workers: int) -> DataLoader[dict[str, torch.Tensor]]:
        processes, rank = (self.trainer.world_size, self.trainer.global_rank) if self.trainer else (1, 0)
        return DataLoader(
            self.clips(processes),
            batch_size=self.batch_size,
            sampler=StreamSampler(self.clips_seen, self.batch_size, processes, rank),
            num_workers=workers,
            worker_init_fn=start_worker,
            persistent_workers=workers > 0,
        )


def start_worker(_: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the training process's to handle
    torch.set_num_threads(1)
    reuse_freed_memory()
