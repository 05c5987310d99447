"""Training clips, rendered on the fly."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

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


def _start_worker(_: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the training process's to handle
    torch.set_num_threads(1)
    reuse_freed_memory()


class MixedClips(Dataset[dict[str, torch.Tensor]]):
    """Clips whose size changes from batch to batch: clip ``i`` belongs to batch ``i // batch_size``.

    Args:
        seed: of scenes, paths and sensors.
        sizes: ``(height, width)`` taken in turn.
        batch_size: clips that must share a size.
        options: further options of :class:`dvo.synth.dataset.ClipDataset`.
    """

    def __init__(self, seed: int, sizes: Sequence[tuple[int, int]], batch_size: int, **options: Any) -> None:
        self.batch_size = batch_size
        self.by_size = [ClipDataset(seed, 2**62, height=h, width=w, **options) for h, w in sizes]

    def __len__(self) -> int:
        return 2**62

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        return self.by_size[index // self.batch_size % len(self.by_size)][index]


class Renderings(L.LightningDataModule):
    """An endless stream of rendered clips, the same for the same seed whatever the number of workers.

    Args:
        seed: of scenes, paths and sensors.
        batch_size: clips a step.
        frames: frames of a clip.
        sizes: height and width of a clip in pixels, taken in turn by the batches.
        flow_low, flow_high: range of the mean induced flow between consecutive frames, pixels.
        workers: rendering processes; 0 renders in the training process.
        textures: folder of photographs to paint the scenes with; None: those that scikit-image ships.
    """

    def __init__(
        self,
        seed: int = 0,
        batch_size: int = 1,
        frames: int = 8,
        sizes: list[tuple[int, int]] | None = None,
        flow_low: float = 2.0,
        flow_high: float = 19.0,
        workers: int = 1,
        textures: str | None = None,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        self.batch_size, self.workers = batch_size, workers
        self.clips_seen = 0
        options = {"frames": frames, "flow_range": (flow_low, flow_high), "textures": textures}
        self.clips = MixedClips(seed, sizes or [(120, 160)], batch_size, **options)

    def train_dataloader(self) -> DataLoader[dict[str, torch.Tensor]]:
        return DataLoader(
            self.clips,
            batch_size=self.batch_size,
            sampler=_From(self.clips_seen),
            num_workers=self.workers,
            worker_init_fn=_start_worker,
            persistent_workers=self.workers > 0,
        )

    def state_dict(self) -> dict[str, Any]:
        return {"clips_seen": self.clips_seen}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.clips_seen = int(state_dict["clips_seen"])
