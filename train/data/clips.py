"""Training clips, rendered on the fly or read from recordings."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from dvo.allocator import reuse_freed_memory
from dvo.synth.dataset import ClipDataset
from train.data.real import RealClips, RealData


class _From(Sampler[int]):
    """Indices from a start on, without end: clip ``i`` is the same whenever training is resumed. Of several processes
    each takes its part of every batch."""

    def __init__(self, start: int, batch: int = 1, processes: int = 1, rank: int = 0) -> None:
        self.start, self.batch, self.processes, self.rank = start, batch, processes, rank

    def __iter__(self) -> Iterator[int]:
        first = self.start + self.rank * self.batch
        while True:
            yield from range(first, first + self.batch)
            first += self.batch * self.processes


def _start_worker(_: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the training process's to handle
    torch.set_num_threads(1)
    reuse_freed_memory()


@dataclass
class Course:
    """What clips look like from a clip on (a curriculum is a list of these).

    Attributes:
        from_clip: index of the first such clip.
        flow_low, flow_high: range of the mean induced flow between consecutive frames, pixels.
        sizes: height and width in pixels, taken in turn by the batches.
    """

    from_clip: int
    flow_low: float
    flow_high: float
    sizes: list[tuple[int, int]]


class MixedClips(Dataset[dict[str, torch.Tensor]]):
    """Clips whose size changes from batch to batch: clip ``i`` belongs to batch ``i // batch_size``.

    Args:
        seed: of scenes, paths and sensors.
        courses: what to render, by increasing ``from_clip``, the first 0.
        batch_size: clips that must share a size, those of all processes together.
        real: recordings to mix in.
        options: further options of :class:`dvo.synth.dataset.ClipDataset`.
    """

    def __init__(
        self, seed: int, courses: Sequence[Course], batch_size: int, real: RealData | None = None, **options: Any
    ) -> None:
        self.seed, self.batch_size, self.real = seed, batch_size, real
        self.courses = list(courses)
        self.rendered: list[Sequence[Dataset[dict[str, torch.Tensor]]]] = []
        self.recorded: list[Sequence[Dataset[dict[str, torch.Tensor]]]] = []
        for course in self.courses:
            flow = (course.flow_low, course.flow_high)
            self.rendered.append(
                [ClipDataset(seed, 2**62, height=h, width=w, flow_range=flow, **options) for h, w in course.sizes]
            )
            if real is not None:
                self.recorded.append([RealClips(seed, real, options["frames"], h, w) for h, w in course.sizes])

    def __len__(self) -> int:
        return 2**62

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        batch = index // self.batch_size
        first = batch * self.batch_size
        course = max(i for i, c in enumerate(self.courses) if c.from_clip <= first)
        clips = self.rendered[course]
        if self.real is not None and np.random.default_rng([self.seed, 9109, batch]).random() < self.real.share:
            clips = self.recorded[course]
        return clips[batch % len(clips)][index]


class Renderings(L.LightningDataModule):
    """An endless stream of rendered clips, the same for the same seed whatever the number of workers and processes.

    Args:
        seed: of scenes, paths and sensors.
        batch_size: clips a step, in each process.
        frames: frames of a clip.
        sizes: height and width of a clip in pixels, taken in turn by the batches.
        flow_low, flow_high: range of the mean induced flow between consecutive frames, pixels.
        workers: rendering processes; 0 renders in the training process.
        courses: later changes of sizes and flow, by the index of the first clip; None for none.
        real: recordings to train on as well or instead.
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
        courses: list[Course] | None = None,
        real: RealData | None = None,
        textures: str | None = None,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["courses", "real"], logger=False)  # its seed need not be that of the module
        self.seed, self.batch_size, self.frames, self.workers = seed, batch_size, frames, workers
        self.courses = [Course(0, flow_low, flow_high, sizes or [(120, 160)]), *(courses or [])]
        self.real, self.textures = real, textures
        self.clips_seen = 0

    def clips(self, processes: int = 1) -> MixedClips:
        """The clips, in batches that span the processes."""
        options = {"frames": self.frames, "textures": self.textures}
        return MixedClips(self.seed, self.courses, self.batch_size * processes, self.real, **options)

    def train_dataloader(self) -> DataLoader[dict[str, torch.Tensor]]:
        processes, rank = (self.trainer.world_size, self.trainer.global_rank) if self.trainer else (1, 0)
        return DataLoader(
            self.clips(processes),
            batch_size=self.batch_size,
            sampler=_From(self.clips_seen, self.batch_size, processes, rank),
            num_workers=self.workers,
            worker_init_fn=_start_worker,
            persistent_workers=self.workers > 0,
        )

    def state_dict(self) -> dict[str, Any]:
        return {"clips_seen": self.clips_seen}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.clips_seen = int(state_dict["clips_seen"])
