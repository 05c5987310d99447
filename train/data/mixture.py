"""Stream of clips for self-supervised training: recordings without ground truth, renderings without their labels, and
rendered clips with labels beside them so that nothing is forgotten."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch.utils.data import Dataset

from dvo.core.errors import DvoError
from dvo.synth.dataset import ClipDataset
from dvo.synth.specs import check_share
from train.data.stream import BatchStream
from train.data.unlabelled import UnlabelledClips, UnlabelledData
from train.engine.provenance import Material, names_of

Kind = Literal["recorded", "rendered", "labelled"]
"""``recorded`` and ``rendered`` clips have no labels (nan), ``labelled`` ones are rendered."""


@dataclass
class LabelledRenderings:
    """Share of rendered clips whose labels are used.

    Attributes:
        share: of the batches.
        movers, low_light: probabilities, see :class:`dvo.synth.clip.ClipSpec`.
    """

    share: float = 0.0
    movers: float = 0.0
    low_light: float = 0.0

    def check(self) -> None:
        """Check the settings, which the command line does not do.

        Raises:
            DvoError: a share or a probability outside of 0 to 1.
        """
        for name in ("share", "movers", "low_light"):
            check_share(f"data.labelled.{name}", getattr(self, name))


class Mixture(BatchStream):
    """Endless stream of clips, most of them without labels: their depths and poses are nan.

    Args:
        seed: of everything that is drawn.
        batch_size: clips a step, in each process.
        frames: frames of a clip.
        sizes: height and width of a clip in pixels, taken in turn by the batches.
        real: recordings to train on; None: renderings alone.
        flow_low, flow_high: range of the mean induced flow between consecutive frames of renderings, pixels.
        movers, low_light: probabilities of the renderings without labels, see :class:`dvo.synth.clip.ClipSpec`.
        labelled: renderings with labels that are mixed in.
        textures: folder of photographs to paint the scenes with; None: those that scikit-image ships.
        workers: processes that read and render; 0: the training process does.

    Raises:
        DvoError: sizes of no batch and no clip, a probability that is none, or no recordings where there should be.
    """

    def __init__(
        self,
        seed: int = 0,
        batch_size: int = 1,
        frames: int = 8,
        sizes: list[tuple[int, int]] | None = None,
        real: UnlabelledData | None = None,
        flow_low: float = 1.0,
        flow_high: float = 14.0,
        movers: float = 0.0,
        low_light: float = 0.0,
        labelled: LabelledRenderings | None = None,
        textures: str | None = None,
        workers: int = 1,
    ) -> None:
        super().__init__()
        for name, value, least in (("batch_size", batch_size, 1), ("frames", frames, 2), ("workers", workers, 0)):
            if value < least:
                raise DvoError(f"{value} is too small", field=f"data.{name}", remedy=f"give {least} or more")
        check_share("data.movers", movers)
        check_share("data.low_light", low_light)
        self.labelled = labelled or LabelledRenderings()
        self.labelled.check()
        if real is not None:
            real.check()
        self.save_hyperparameters(ignore=["real", "labelled"], logger=False)
        self.seed, self.batch_size, self.frames, self.workers = seed, batch_size, frames, workers
        self.sizes, self.real, self.textures = sizes or [(120, 160)], real, textures
        self.flow, self.movers, self.low_light = (flow_low, flow_high), movers, low_light

    def kind(self, batch: int) -> Kind:
        """Kind of the clips of a batch.

        Args:
            batch: index, over all processes.
        """
        labelled, recorded = np.random.default_rng([self.seed, 9133, batch]).random(2)
        if labelled < self.labelled.share:
            return "labelled"
        return "recorded" if self.real is not None and recorded < self.real.share else "rendered"

    def clips(self, processes: int = 1) -> MixtureClips:
        """The clips, in batches that span so many processes."""
        return MixtureClips(self, self.batch_size * processes)

    def datasets(self, kind: Kind) -> list[Dataset[dict[str, torch.Tensor]]]:
        """Clips of one kind, a data set for each size.

        Raises:
            DvoError: recordings that cannot be trained on.
        """
        if kind == "recorded":
            assert self.real is not None
            return [UnlabelledClips(self.seed, self.real, self.frames, h, w) for h, w in self.sizes]
        of = self.labelled if kind == "labelled" else self
        options: dict[str, Any] = {"frames": self.frames, "textures": self.textures, "flow_range": self.flow}
        options |= {"movers": of.movers, "low_light": of.low_light}
        return [ClipDataset(self.seed, 2**62, height=h, width=w, **options) for h, w in self.sizes]

    def summary(self) -> str:
        """Description of the clips in a few words."""
        share = self.labelled.share
        recorded = 0.0 if self.real is None else self.real.share
        names = ", ".join(names_of(self.real.folders)) if self.real is not None else ""
        parts = [
            ((1 - share) * recorded, f"from the recordings {names} without ground truth"),
            ((1 - share) * (1 - recorded), "rendered, labels ignored"),
            (share, "rendered with labels"),
        ]
        return "; ".join(f"{part:.0%} {text}" for part, text in parts if part > 0)

    def material(self, clip: int, processes: int = 1) -> Material:
        """Source of the batch that holds a clip: recordings, or renderings."""
        if self.kind(clip // (self.batch_size * processes)) == "recorded" and self.real is not None:
            return Material(recordings=names_of(self.real.folders))
        return Material(photographs=names_of([self.textures])[0] if self.textures else "")


class MixtureClips(Dataset[dict[str, torch.Tensor]]):
    """Clips of a mixture: clip ``i`` belongs to batch ``i // batch_size``, all of one kind and size.

    Args:
        mixture: settings.
        batch_size: clips that must share kind and size, those of all processes together.

    Items are as those of :class:`dvo.synth.dataset.ClipDataset`; depths and poses that are not told are nan.
    """

    def __init__(self, mixture: Mixture, batch_size: int) -> None:
        kinds: list[Kind] = ["rendered", "labelled"] + (["recorded"] if mixture.real is not None else [])
        self.kind, self.batch_size = mixture.kind, batch_size
        self.sets = {kind: mixture.datasets(kind) for kind in kinds}

    def __len__(self) -> int:
        return 2**62

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        batch = index // self.batch_size
        kind = self.kind(batch)
        sets = self.sets[kind]
        clip = dict(sets[batch % len(sets)][index])
        if kind == "rendered":
            clip |= {name: torch.full_like(clip[name], torch.nan) for name in ("depth", "poses_cw")}
        return clip
