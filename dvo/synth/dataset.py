"""Clips as a map-style torch dataset."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torch.utils.data import Dataset

from dvo.synth.clip import make_clip


class ClipDataset(Dataset[dict[str, Tensor]]):
    """Data set of ``length`` clips of stream ``seed``; the same bytes for any number of workers.

    Items are ``images (N, 3, H, W)`` uint8, ``depth (N, H, W)``, ``poses_cw (N, 7)``, ``intrinsics (N, 4)``, see
    :class:`dvo.synth.clip.Clip`; the depth is nan at pixels that show a moving body or surroundings. Neighbouring
    indices share a scene (``clips_per_scene``), so reading in order is faster than reading shuffled.

    Args:
        seed: of the stream.
        length: number of clips.
        start: index of the first clip (to resume).
        options: of :func:`dvo.synth.clip.make_clip`.

    Example:
        >>> from torch.utils.data import DataLoader
        >>> clips = dvo.ClipDataset(seed=0, length=4, frames=5, height=48, width=64)
        >>> batch = next(iter(DataLoader(clips, batch_size=2)))
        >>> batch["images"].shape, batch["poses_cw"].shape
        (torch.Size([2, 5, 3, 48, 64]), torch.Size([2, 5, 7]))
    """

    def __init__(self, seed: int, length: int, *, start: int = 0, **options: Any) -> None:
        self.seed, self.length, self.start, self.options = seed, length, start, options

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not 0 <= index < self.length:
            raise IndexError(index)
        clip = make_clip(self.seed, self.start + index, **self.options)
        return {
            "images": clip.images, "depth": clip.static_depth, "poses_cw": clip.poses_cw, "intrinsics": clip.intrinsics,
        }  # fmt: skip
