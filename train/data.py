"""Training clips, rendered on the fly."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Sampler

from dvo.allocator import reuse_freed_memory
from dvo.synth.dataset import ClipDataset


class _From(Sampler[int]):
    """Indices from a start on, without end: clip ``i`` is the same whenever training is resumed."""

    def __init__(self, start: int) -> None:
        self.start = start

    def __iter__(self) -> Iterator[int]:
        index = self.start
        while True:
            yield index
            index += 1


def _one_thread(_: int) -> None:
    torch.set_num_threads(1)
    reuse_freed_memory()


class Renderings(L.LightningDataModule):
    """An endless stream of rendered clips, the same for the same seed whatever the number of workers.

    Args:
        seed: of scenes, paths and sensors.
        batch_size: clips a step.
        frames, height, width: size of a clip, pixels.
        flow_low, flow_high: range of the mean induced flow between consecutive frames, pixels.
        workers: rendering processes; 0 renders in the training process.
    """

    def __init__(
        self,
        seed: int = 0,
        batch_size: int = 1,
        frames: int = 8,
        height: int = 120,
        width: int = 160,
        flow_low: float = 2.0,
        flow_high: float = 19.0,
        workers: int = 1,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        self.batch_size, self.workers = batch_size, workers
        self.clips_seen = 0
        size = {"frames": frames, "height": height, "width": width, "flow_range": (flow_low, flow_high)}
        self.clips = ClipDataset(seed, 2**62, **size)

    def train_dataloader(self) -> DataLoader[dict[str, torch.Tensor]]:
        return DataLoader(
            self.clips,
            batch_size=self.batch_size,
            sampler=_From(self.clips_seen),
            num_workers=self.workers,
            worker_init_fn=_one_thread,
            persistent_workers=self.workers > 0,
        )

    def state_dict(self) -> dict[str, Any]:
        return {"clips_seen": self.clips_seen}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.clips_seen = int(state_dict["clips_seen"])
