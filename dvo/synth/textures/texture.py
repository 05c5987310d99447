"""Texture pool: procedural patterns and photographs as one mip-mapped atlas, and its antialiased sampling.

A pool is determined by (seed, count, size) and shared by all scenes of a process; a surface takes a texture, a random
window of it, a tint and a contrast. Textures are drawn when they are first used.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from dvo.core.context import use_threads
from dvo.synth import salts
from dvo.synth.textures.patterns import PATTERNS, SPECIAL, Rng
from dvo.synth.textures.photographs import folder_photographs, photographs

# How often each pattern is drawn in a pool, relative to the others.
WEIGHTS = {"plain": 2.0, "leaves": 2.0, "fractal": 2.0, "facade": 2.0, "asphalt": 1.5, "stains": 2.0, "clouds": 0.7}


def _window(rng: Rng, photo: np.ndarray, size: int) -> np.ndarray:
    """Random square window of a photograph, resized; mirrored or with permuted channels at times."""
    edge = int(min(photo.shape[:2]) * rng.uniform(0.45, 1.0))
    top, left = (int(rng.integers(0, n - edge + 1)) for n in photo.shape[:2])
    crop = photo[top : top + edge, left : left + edge]
    if rng.random() < 0.5:
        crop = crop[:, ::-1]
    if rng.random() < 0.4:
        crop = crop[..., rng.permutation(3)]
    crop = np.ascontiguousarray(crop)
    interpolation = cv2.INTER_AREA if edge >= size else cv2.INTER_LINEAR
    return cv2.resize(crop, (size, size), interpolation=interpolation)


def _fill_cell(cell: np.ndarray, image: np.ndarray, levels: int) -> None:
    """Write ``(S, S, 3)`` and its 2x2 means into a cell ``(3, 1.5 S, S)``."""
    size = image.shape[0]
    cell[:, :size] = image.transpose(2, 0, 1)
    left = 0
    for _ in range(1, levels):
        half = image.shape[0] // 2
        image = image.reshape(half, 2, half, 2, 3).mean((1, 3))
        cell[:, size : size + half, left : left + half] = image.transpose(2, 0, 1)
        left += half


class TexturePool:
    """Mip-mapped textures in one atlas; about a third are photographs if scikit-image is installed.

    Every texture has a cell of ``size`` x ``1.5 size`` texels: level 0 on top, the smaller levels in a row below it.

    Args:
        seed: same seed, same textures (on one machine, with the same packages).
        count: number of textures, not counting the special ones.
        size: edge length of level 0 in texels, a power of two.
        folder: photographs to use in place of scikit-image's.

    Raises:
        DvoError: no images in the folder, or one that cannot be read.

    Attributes:
        atlas: ``(3, H, W)`` float32 in [0, 1]; cells of textures that were never used are black.
        levels: mip levels, down to 2 texels.
        tags: use that each texture suits ("wall", "floor", "photo", ...).
    """

    def __init__(self, seed: int, count: int, size: int, folder: Path | str | None = None) -> None:
        self.seed, self.count, self.size, self.levels = seed, count, size, size.bit_length() - 1
        self.columns = int(np.ceil(np.sqrt(1.5 * count)))
        # Special patterns follow the others, so that they do not change scenes that use none of them.
        special = [name for name in SPECIAL for _ in range(max(1, count // 56))]
        total = count + len(special)
        rows = -(-total // self.columns)
        self.atlas = torch.zeros(3, rows * size * 3 // 2, self.columns * size)
        self._photos = photographs() if folder is None else folder_photographs(folder, seed)
        self._ready = np.zeros(total, bool)
        self._mean = np.zeros((total, 3))
        self._copies: dict[str, tuple[Tensor, np.ndarray]] = {}
        self._patterns = PATTERNS | SPECIAL
        # Every pattern at least once, then by weight.
        names = list(PATTERNS)
        weights = np.array([WEIGHTS.get(name, 1.0) for name in names])
        chooser = np.random.default_rng([seed, salts.POOL])
        plan = iter([*names, *chooser.choice(names, count, p=weights / weights.sum())])
        self._sources: list[str | int] = [
            i // 3 % len(self._photos) if self._photos and i % 3 == 2 else str(next(plan)) for i in range(count)
        ]
        self._sources += special
        self.tags = [self._photos[s][1] if isinstance(s, int) else self._patterns[s][1] for s in self._sources]

    def cell(self, index: int) -> tuple[int, int]:
        """Top and left of a texture's cell in the atlas, texels.

        Args:
            index: of the texture.

        Returns:
            Row and column.
        """
        return index // self.columns * self.size * 3 // 2, index % self.columns * self.size

    def use(self, index: int) -> np.ndarray:
        """Draw a texture unless it is there already.

        Args:
            index: of the texture.

        Returns:
            Mean colour ``(3,)``.
        """
        if not self._ready[index]:
            rng = np.random.default_rng([self.seed, salts.TEXTURE, index])
            source = self._sources[index]
            if isinstance(source, int):
                image = _window(rng, self._photos[source][0], self.size)
            else:
                image = self._patterns[source][0](rng, self.size)
            top, left = self.cell(index)
            cell = self.atlas[:, top : top + self.size * 3 // 2, left : left + self.size].numpy()
            _fill_cell(cell, np.clip(image, 0, 1), self.levels)
            self._mean[index] = image.mean((0, 1))
            self._ready[index] = True
        return self._mean[index]

    def on(self, device: torch.device | str) -> Tensor:
        """Atlas on a device; only cells that are new there are copied.

        Args:
            device: where.

        Returns:
            ``(1, 3, H, W)`` float32.
        """
        if torch.device(device).type == "cpu":
            return self.atlas[None]
        key = str(device)
        if key not in self._copies:
            self._copies[key] = (torch.zeros_like(self.atlas, device=device), np.zeros(len(self._ready), bool))
        copy, there = self._copies[key]
        for index in np.flatnonzero(self._ready & ~there).tolist():
            top, left = self.cell(index)
            window = (slice(None), slice(top, top + self.size * 3 // 2), slice(left, left + self.size))
            copy[window] = self.atlas[window].to(device)
        there |= self._ready
        return copy[None]

    def tagged(self, *tags: str) -> np.ndarray:
        """Indices of the textures with any of the tags.

        Args:
            tags: "wall", "floor"...

        Returns:
            ``(K,)`` indices; all textures if none has such a tag.
        """
        found = np.flatnonzero([tag in tags for tag in self.tags])
        return found if len(found) else np.arange(self.count)


@lru_cache(maxsize=4)
def texture_pool(seed: int, count: int = 224, size: int = 256, *, folder: Path | str | None = None) -> TexturePool:
    """Pool of a seed (and of a folder of photographs), one object per process.

    Args:
        seed, count, size, folder: see :class:`TexturePool`.

    Returns:
        The pool.
    """
    use_threads()
    return TexturePool(seed, count, size, folder)


def sample(
    pool: TexturePool, left: Tensor, top: Tensor, s: Tensor, t: Tensor, footprint: Tensor, *, bias: float = 0.0
) -> Tensor:
    """Trilinear sampling with mirrored repeat.

    Args:
        pool: the textures.
        left, top: ``(M,)`` float32 corner of the texture's cell in the atlas, texels.
        s, t: ``(K, M)`` coordinates in texels of level 0 (column, row); the K samples are averaged.
        footprint: ``(M,)`` edge of a pixel in texels of level 0.
        bias: added to the mip level; negative is sharper.

    Returns:
        ``(3, M)`` float32 colour in [0, 1].
    """
    atlas = pool.on(s.device)
    size, (height, width) = float(pool.size), atlas.shape[2:]
    s = size - (torch.remainder(s, 2 * size) - size).abs_()
    t = size - (torch.remainder(t, 2 * size) - size).abs_()
    lod = footprint.clamp_min(1e-6).log2_().add_(bias).clamp_(0, pool.levels - 1.001)
    level = lod.floor()
    fraction = lod - level
    k, m = s.shape
    grid = torch.empty(2, k, m, 2, device=s.device)
    scale = torch.exp2(-level)
    for step in range(2):
        if step:
            scale = scale * 0.5
        # Level l > 0 starts at column size (1 - 2^(1-l)) of the row below level 0.
        first = scale == 1
        x = left + torch.where(first, 0.0, size * (1 - 2 * scale))
        y = top + torch.where(first, 0.0, size)
        last = size * scale - 1
        grid[step, ..., 0] = (s * scale - 0.5).clamp_min_(0).minimum(last).add_(x).mul_(2 / (width - 1)).sub_(1)
        grid[step, ..., 1] = (t * scale - 0.5).clamp_min_(0).minimum(last).add_(y).mul_(2 / (height - 1)).sub_(1)
    # grid_sample also blends the neighbour beyond ``last`` with weight zero or rounding error: harmless.
    colour = grid_sample(atlas, grid.view(1, 1, -1, 2), align_corners=True).view(3, 2, k, m)
    colour = colour.mean(2) if k > 1 else colour[:, :, 0]
    return torch.lerp(colour[:, 0], colour[:, 1], fraction)
