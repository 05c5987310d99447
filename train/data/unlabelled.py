"""Clips from recordings without ground truth: folders of images and videos, chosen so that the camera moves."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from dvo.core.errors import DvoError
from dvo.data.images.fit import fit
from dvo.data.open import open_source
from dvo.data.source import Source

TRIES = 8
"""Clips drawn until one moves as asked; then the one that comes nearest is taken."""
_CHECKED = 32  # clips looked at before a recording without motion is refused
_LONGEST_VIDEO = 20_000  # frames kept in memory, small


@dataclass
class UnlabelledData:
    """Selection of recordings to train on without ground truth.

    Attributes:
        folders: folders of images, sequences of a data set, or videos; a single one may stand without a list.
        share: of the batches that are not labelled; the others of them are rendered.
        hops: frame gaps, one drawn a clip.
        flow_low, flow_high: mean optical flow between neighbouring frames, pixels, that a clip should have.
        calib: calibration of all of them; None: each has its own beside it.
    """

    folders: list[str] | str = field(default_factory=list)
    share: float = 1.0
    hops: list[int] = field(default_factory=lambda: [1, 2, 3])
    flow_low: float = 1.0
    flow_high: float = 20.0
    calib: str | None = None

    def __post_init__(self) -> None:
        if isinstance(self.folders, str):
            self.folders = [self.folders]

    def check(self) -> None:
        """Check the settings, which the command line does not do.

        Raises:
            DvoError: no folder, a share outside of 0 to 1, a gap below 1, or no range of flow.
        """
        if not self.folders:
            raise DvoError(
                "no recordings are named",
                field="data.real.folders",
                remedy="name a folder of images or a video, or give --data.real null to train on renderings alone",
            )
        if not 0 <= self.share <= 1:
            raise DvoError(f"{self.share:g} is no share", field="data.real.share", remedy="give a number from 0 to 1")
        if not self.hops or min(self.hops) < 1:
            raise DvoError(f"{self.hops} are no gaps", field="data.real.hops", remedy="give numbers of 1 or more")
        if not 0 <= self.flow_low < self.flow_high:
            raise DvoError(
                f"{self.flow_low:g} to {self.flow_high:g} is no range",
                field="data.real.flow_low",
                remedy="give low < high, in pixels",
            )


class UnlabelledClips(Dataset[dict[str, Tensor]]):
    """Clips drawn from recordings without a look at their ground truth; the same index, the same clip.

    Args:
        seed: of the draws.
        data: which recordings.
        frames, height, width: of a clip.

    Items are as those of :class:`dvo.synth.dataset.ClipDataset`; depths and poses are nan.

    Raises:
        DvoError: no such recording, no calibration, too few frames for a clip, or a camera that does not move.
    """

    def __init__(self, seed: int, data: UnlabelledData, frames: int, height: int, width: int) -> None:
        self.seed, self.data, self.frames, self.size = seed, data, frames, (height, width)
        self.sources = [_open(folder, data.calib) for folder in data.folders]
        self._videos = {n: self._read_video(s) for n, s in enumerate(self.sources) if s.timestamps is None}
        self.starts: list[tuple[int, int, int]] = []
        for number, source in enumerate(self.sources):
            count = len(self._videos[number]) if number in self._videos else len(source)
            spans = [(hop, (frames - 1) * hop + 1) for hop in data.hops]
            found = [(number, start, hop) for hop, span in spans for start in range(count - span + 1)]
            if not found:
                raise DvoError(
                    f"{count} frames are too few for a clip of {frames}",
                    file=source.path,
                    field="data.real.folders",
                    remedy="name longer recordings, or ask for fewer frames with --data.frames",
                )
            self.starts += found
        self._check_motion()

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        rng = np.random.default_rng([self.seed, 9113, index])
        best, least = None, math.inf
        for _ in range(TRIES):
            clip = self.read(*self.starts[int(rng.integers(len(self.starts)))])
            off = self._off(clip)
            if off < least:
                best, least = clip, off
            if off == 0:
                break
        assert best is not None
        return {name: torch.from_numpy(value) for name, value in best.items()}

    def read(self, number: int, start: int, hop: int) -> dict[str, np.ndarray]:
        """Read a clip of one recording.

        Args:
            number: index of the recording.
            start: first frame.
            hop: gap between frames.

        Returns:
            arrays as those of an item.
        """
        height, width = self.size
        indices = range(start, start + (self.frames - 1) * hop + 1, hop)
        if number in self._videos:
            found = [self._videos[number][i] for i in indices]
        else:
            frames = self.sources[number].frames_at(indices)
            found = [self._fitted(frame.image, frame.camera) for frame, _ in frames]
        return {
            "images": np.stack([image for image, _ in found]).transpose(0, 3, 1, 2).copy(),
            "depth": np.full((self.frames, height, width), np.nan, np.float32),
            "poses_cw": np.full((self.frames, 7), np.nan, np.float32),
            "intrinsics": np.stack([intrinsics for _, intrinsics in found]).astype(np.float32),
        }

    def _fitted(self, image: np.ndarray, camera) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
        height, width = self.size
        small, fitted = fit(image, camera, width, height)
        return small, np.asarray(fitted.intrinsics)

    def _read_video(self, source: Source) -> list[tuple[np.ndarray, np.ndarray]]:
        """All frames of a video, small: it can be read in order only."""
        found = []
        for frame in source:
            if len(found) == _LONGEST_VIDEO:
                raise DvoError(
                    f"more than {_LONGEST_VIDEO:,} frames", file=source.path, remedy="extract frames into a folder"
                )
            found.append(self._fitted(frame.image, frame.camera))
        return found

    def _off(self, clip: dict[str, np.ndarray]) -> float:
        """Distance of the motion of a clip from the range asked for, in log units; 0 within it."""
        flow = max(apparent_motion(clip["images"]), 1e-6)
        low, high = max(self.data.flow_low, 1e-6), self.data.flow_high
        return max(math.log(low / flow), math.log(flow / high), 0.0)

    def _check_motion(self) -> None:
        rng = np.random.default_rng([self.seed, 9127])
        for start in rng.integers(len(self.starts), size=_CHECKED):
            if self._off(self.read(*self.starts[int(start)])) == 0:
                return
        raise DvoError(
            f"none of {_CHECKED} clips moves by {self.data.flow_low:g} to {self.data.flow_high:g} pixels a frame",
            file=self.data.folders[0],
            field="data.real.folders",
            remedy="name recordings of a moving camera, or change data.real.hops, data.real.flow_low and flow_high",
        )


def apparent_motion(images: np.ndarray) -> float:
    """Mean optical flow (Farneback, SCIA 2003, at half of the resolution) between neighbouring frames.

    Args:
        images: ``(N, 3, H, W)`` uint8 RGB.

    Returns:
        Pixels.
    """
    grey = [cv2.cvtColor(np.ascontiguousarray(image.transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY) for image in images]
    small = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in grey]
    total = 0.0
    for before, after in zip(small[:-1], small[1:], strict=True):
        flow = cv2.calcOpticalFlowFarneback(before, after, None, 0.5, 3, 13, 2, 5, 1.1, 0)  # type: ignore[call-overload]
        total += 2 * float(np.linalg.norm(flow, axis=-1).mean())
    return total / (len(images) - 1)


def _open(folder: str, calib: str | None) -> Source:
    try:
        return open_source(folder, calib=calib)
    except DvoError as error:
        if error.field != "calib":
            raise
        remedy = "give --data.real.calib FILE: a text file with 'fx fy cx cy [k1 k2 p1 p2 [k3]]' in pixels, or a YAML"
        raise DvoError(error.message, file=error.file, field="data.real.calib", remedy=remedy) from error
