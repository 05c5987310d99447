"""Clips of a study: rendered once, kept on disk, used in turn by all runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dvo.data.files.output import replaced
from dvo.synth.dataset import ClipDataset
from train.data.stream import ClipStream, StreamSampler


class ClipSettings(Protocol):
    """Settings of the clips of a study.

    Attributes:
        frames: length of a clip.
        size: height and width, pixels.
        flow: range of the mean induced flow between frames, pixels.
    """

    @property
    def frames(self) -> int: ...

    @property
    def size(self) -> tuple[int, int]: ...

    @property
    def flow(self) -> tuple[float, float]: ...


class DiskClips(Dataset[dict[str, Tensor]]):
    """Rendered clips that are kept on disk, so that the runs pay for rendering once; index modulo ``count``.

    Args:
        folder: of the clips; those of each seed and kind have a folder of their own in it.
        seed: of the stream of clips.
        count: number of clips.
        config: kind of clips.
        options: further ones of :func:`dvo.synth.clip.make_clip`.
    """

    def __init__(
        self, folder: Path, seed: int, count: int, config: ClipSettings, options: Mapping[str, Any] | None = None
    ) -> None:
        height, width = config.size
        options = options or {}
        name = f"{seed}_{config.frames}x{height}x{width}_{config.flow[0]:g}-{config.flow[1]:g}"
        name += "".join(f"_{key}-{options[key]}" for key in sorted(options))
        self.folder, self.count = folder / name, count
        self.rendered = ClipDataset(
            seed, count, frames=config.frames, height=height, width=width, flow_range=tuple(config.flow), **options
        )

    def __len__(self) -> int:
        return 2**62

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        index %= self.count
        file = self._file(index)
        if not file.is_file():
            clip = self.rendered[index]
            self.folder.mkdir(parents=True, exist_ok=True)
            with replaced(file) as part, part.open("wb") as stream:  # another run may render the same clip
                torch.save(clip, stream)
        return torch.load(file, weights_only=True)

    def _file(self, index: int) -> Path:
        return self.folder / f"{index:06d}.pt"

    def missing(self) -> list[int]:
        """Indices of the clips that do not lie on disk."""
        return [index for index in range(self.count) if not self._file(index).is_file()]


class StudyClips(ClipStream):
    """Clips of one seed in their order, from a position on that the checkpoint keeps.

    Args:
        clips: to draw from.
        batch: clips a step.
        start: position of a run that is not resumed.
    """

    def __init__(self, clips: DiskClips, batch: int = 1, start: int = 0) -> None:
        super().__init__()
        self.clips, self.batch, self.clips_seen = clips, batch, start

    def train_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        """Batches from the position on."""
        return DataLoader(self.clips, batch_size=self.batch, sampler=StreamSampler(self.clips_seen, self.batch))
