"""Images of any size as mip pyramids in one flat table, and their antialiased sampling with repeat."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from torch import Tensor

LEVELS = 13  # 4096 texels down to 1


def _pyramid(picture: np.ndarray) -> list[np.ndarray]:
    """``LEVELS`` images, each half the size of the one before; the last ones repeat."""
    levels = [picture]
    while len(levels) < LEVELS:
        height, width = levels[-1].shape[:2]
        smaller = (max(1, (width + 1) // 2), max(1, (height + 1) // 2))
        levels.append(cv2.resize(levels[-1], smaller, interpolation=cv2.INTER_AREA).reshape(smaller[1], smaller[0], 3))
    return levels


@dataclass
class TextureSet:
    """Images of a mesh.

    Attributes:
        pictures: ``(H, W, 3)`` float32 RGB in [0, 1] each, at most 4096 pixels along an edge.
    """

    pictures: list[np.ndarray] = field(default_factory=list)
    _cache: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict, repr=False)

    def _on(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Texels ``(N, 3)`` of all levels and, per image and level, offset, width, height ``(P, LEVELS, 3)``."""
        key = str(device)
        if key not in self._cache:
            flat, table, offset = [], [], 0
            for picture in self.pictures:
                rows = []
                for level in _pyramid(picture):
                    rows.append([offset, level.shape[1], level.shape[0]])
                    offset += level.shape[0] * level.shape[1]
                    flat.append(level.reshape(-1, 3))
                table.append(rows)
            texels = torch.from_numpy(np.concatenate(flat).astype(np.float32))
            self._cache[key] = texels.to(device), torch.tensor(table, device=device)
        return self._cache[key]

    def sample(self, picture: Tensor, place: Tensor, jacobian: Tensor, taps: int) -> Tensor:
        """Trilinear samples averaged along the longer axis of the pixel's footprint.

        Args:
            picture: ``(M,)`` index of the image.
            place: ``(M, 2)`` column and row in units of the image's edges.
            jacobian: ``(M, 2, 2)`` of the place by the pixel's x and y.
            taps: samples along the longer axis.

        Returns:
            ``(M, 3)`` float32 colour in [0, 1].
        """
        texels, table = self._on(place.device)
        about = table[picture]
        scaled = (jacobian * about[:, 0, 1:, None]).float()
        along = torch.hypot(scaled[:, 0], scaled[:, 1])  # (M, 2) texels a pixel step in x and in y
        major = along.amax(1)
        minor = (scaled[:, 0, 0] * scaled[:, 1, 1] - scaled[:, 0, 1] * scaled[:, 1, 0]).abs_() / major.clamp_min(1e-12)
        footprint = torch.maximum(minor, major / taps).clamp_min_(1e-6)
        lod = footprint.log2_().clamp_(0, LEVELS - 1.001)
        level = lod.floor()
        fraction = (lod - level)[:, None]
        rows = torch.arange(len(place), device=place.device)
        levels = [about[rows, level.long() + step] for step in (0, 1)]
        place = (place - place.floor()).float()  # exact repeats first, then single precision will do
        axis = torch.where((along[:, 0] >= along[:, 1])[:, None], jacobian[..., 0], jacobian[..., 1]).float()
        colour = torch.zeros(len(place), 3, device=place.device)
        for tap in range(taps):
            spot = place + ((tap + 0.5) / taps - 0.5) * axis
            low, high = (_bilinear(texels, each, spot) for each in levels)
            colour += torch.lerp(low, high, fraction)
        return colour / taps


def _bilinear(texels: Tensor, about: Tensor, place: Tensor) -> Tensor:
    """``(M, 3)`` from images that repeat; ``about (M, 3)`` offset, width, height."""
    offset, width, height = about.unbind(1)
    x, y = ((place[:, i] - place[:, i].floor()) * about[:, i + 1] - 0.5 for i in (0, 1))
    left, top = x.floor(), y.floor()
    x0, y0 = left.long(), top.long()
    columns = [torch.where(x0 < 0, width - 1, x0), torch.where(x0 + 1 >= width, 0, x0 + 1)]
    rows = [
        offset + width * torch.where(y0 < 0, height - 1, y0),
        offset + width * torch.where(y0 + 1 >= height, 0, y0 + 1),
    ]
    corner = [texels.index_select(0, row + column) for row in rows for column in columns]
    upper, lower = (torch.lerp(a, b, (x - left)[:, None]) for a, b in (corner[:2], corner[2:]))
    return torch.lerp(upper, lower, (y - top)[:, None])
