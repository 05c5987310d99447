"""Training clips, rendered on the fly or read from recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from dvo.core.errors import DvoError
from dvo.synth.dataset import ClipDataset
from dvo.synth.specs import check_share
from train.data.real import RealClips, RealData
from train.data.stream import BatchStream
from train.engine.provenance import Material, names_of


@dataclass
class CurriculumStage:
    """Kind of clips from an index on; a curriculum is a list of these.

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
        stages: kinds of clips, by increasing ``from_clip``, the first 0.
        batch_size: clips that must share a size, those of all processes together.
        real: recordings to mix in.
        options: further options of :class:`dvo.synth.dataset.ClipDataset`.

    Items are as those of :class:`dvo.synth.dataset.ClipDataset`.
    """

    def __init__(
        self,
        seed: int,
        stages: Sequence[CurriculumStage],
        batch_size: int,
        real: RealData | None = None,
        **options: Any,
    ) -> None:
        self.seed, self.batch_size, self.real = seed, batch_size, real
        self.stages = list(stages)
        self.rendered: list[Sequence[Dataset[dict[str, torch.Tensor]]]] = []
        self.recorded: list[Sequence[Dataset[dict[str, torch.Tensor]]]] = []
        for stage in self.stages:
            flow = (stage.flow_low, stage.flow_high)
            self.rendered.append(
                [ClipDataset(seed, 2**62, height=h, width=w, flow_range=flow, **options) for h, w in stage.sizes]
            )
            if real is not None:
                self.recorded.append([RealClips(seed, real, options["frames"], h, w) for h, w in stage.sizes])

    def __len__(self) -> int:
        return 2**62

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        batch = index // self.batch_size
        first = batch * self.batch_size
        stage = max(i for i, s in enumerate(self.stages) if s.from_clip <= first)
        clips = self.recorded[stage] if is_recorded(self.seed, batch, self.real) else self.rendered[stage]
        return clips[batch % len(clips)][index]


def is_recorded(seed: int, batch: int, real: RealData | None) -> bool:
    """Answer whether a batch is cut from recordings and not rendered.

    Args:
        seed: of the stream of clips.
        batch: index, over all processes.
        real: recordings that are mixed in; None: none.
    """
    return real is not None and bool(np.random.default_rng([seed, 9109, batch]).random() < real.share)


class Renderings(BatchStream):
    """An endless stream of rendered clips, the same for the same seed whatever the number of workers and processes.

    Args:
        seed: of scenes, paths and sensors.
        batch_size: clips a step, in each process.
        frames: frames of a clip.
        sizes: height and width of a clip in pixels, taken in turn by the batches.
        flow_low, flow_high: range of the mean induced flow between consecutive frames, pixels.
        workers: rendering processes; 0 renders in the training process.
        stages: later changes of sizes and flow, by the index of the first clip; None for none.
        real: recordings to train on as well or instead.
        textures: folder of photographs to paint the scenes with; None: those that scikit-image ships.
        courses: former name of ``stages``.
        movers: probability that moving bodies are in a rendered clip; the depth is nan where they are seen.
        low_light: probability that a rendered clip has 3 to 30 % of the usual light.
        surroundings: probability of water, leaves, people, rain, a bonnet..., see :class:`dvo.synth.clip.ClipSpec`.
        bare: probability that the surfaces of a rendered clip keep little texture.
        blurred: probability of a long exposure.

    Raises:
        DvoError: ``stages`` under both names, sizes of no batch and no clip, a probability that is none, or no
            recordings where there should be.
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
        stages: list[CurriculumStage] | None = None,
        real: RealData | None = None,
        textures: str | None = None,
        courses: list[CurriculumStage] | None = None,
        movers: float = 0.0,
        low_light: float = 0.0,
        surroundings: float = 0.0,
        bare: float = 0.0,
        blurred: float = 0.0,
    ) -> None:
        super().__init__()
        if stages and courses:
            raise DvoError("is the former name of 'stages'", field="data.courses", remedy="give one of the two")
        for name, value, least in (("batch_size", batch_size, 1), ("frames", frames, 2), ("workers", workers, 0)):
            if value < least:
                raise DvoError(f"{value} is too small", field=f"data.{name}", remedy=f"give {least} or more")
        shares = {
            "movers": movers, "low_light": low_light, "surroundings": surroundings, "bare": bare, "blurred": blurred,
        }  # fmt: skip
        for name, share in shares.items():
            check_share(f"data.{name}", share)
        if real is not None:
            real.check()
        self.save_hyperparameters(
            ignore=["stages", "courses", "real"], logger=False
        )  # its seed need not be that of the module
        self.seed, self.batch_size, self.frames, self.workers = seed, batch_size, frames, workers
        first = CurriculumStage(0, flow_low, flow_high, sizes or [(120, 160)])
        self.stages = [first, *(stages or courses or [])]
        self.real, self.textures = real, textures
        self.shares = shares

    def clips(self, processes: int = 1) -> MixedClips:
        """The clips, in batches that span so many processes."""
        options = {"frames": self.frames, "textures": self.textures, **self.shares}
        return MixedClips(self.seed, self.stages, self.batch_size * processes, self.real, **options)

    def summary(self) -> str:
        """Description of the clips in a few words: rendered, or from which recordings."""
        if self.real is None or self.real.share == 0:
            return "rendered"
        names = ", ".join(names_of(self.real.folders))
        return f"from the recordings {names}" + (
            f" in {self.real.share:.0%} of the batches" if self.real.share < 1 else ""
        )

    def material(self, clip: int, processes: int = 1) -> Material:
        """Source of the batch that holds a clip: recordings, or renderings."""
        if self.real is not None and is_recorded(self.seed, clip // (self.batch_size * processes), self.real):
            return Material(recordings=names_of(self.real.folders))
        return Material(photographs=names_of([self.textures])[0] if self.textures else "")
