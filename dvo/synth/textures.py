"""The texture pool: procedural patterns and photographs as one mip-mapped atlas, and its antialiased sampling.

A pool is drawn once per (seed, count, size) and shared by all scenes of a process; a surface picks a texture, a random
window of it, a tint and a contrast.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from dvo.synth.patterns import PATTERNS, Rng

# Photographs inside the scikit-image wheel (read from its folder, so nothing is ever downloaded) and what they suit.
PHOTOGRAPHS = {
    "astronaut.png": "photo", "brick.png": "wall", "camera.png": "photo", "chelsea.png": "photo",
    "coffee.png": "photo", "coins.png": "photo", "grass.png": "ground", "gravel.png": "stone",
    "hubble_deep_field.jpg": "photo", "ihc.png": "busy", "moon.png": "stone", "motorcycle_left.png": "photo",
    "page.png": "poster", "retina.jpg": "photo", "rocket.jpg": "photo", "text.png": "poster", "color.png": "photo",
    "cell.png": "stone", "clock_motion.png": "photo",
}  # fmt: skip
# How often each pattern is drawn in a pool, relative to the others.
WEIGHTS = {"plain": 2.0, "leaves": 2.0, "fractal": 2.0, "facade": 2.0, "asphalt": 1.5, "stains": 2.0, "clouds": 0.7}


@dataclass
class TexturePool:
    """Mip-mapped textures in one flat buffer.

    Attributes:
        texels: ``(M, 4)`` uint8, every level of every texture, row by row.
        count, size, levels: number of textures, edge length of level 0 in texels, mip levels (down to 2 texels).
        mean: ``(count, 3)`` mean colour in [0, 1].
        tags: what each texture suits ("wall", "floor", "photo", ...).
    """

    texels: Tensor
    count: int
    size: int
    levels: int
    mean: np.ndarray
    tags: list[str]
    _moved: dict[str, Tensor] = field(default_factory=dict, repr=False)

    @property
    def stride(self) -> int:
        """Texels of one texture, all levels together."""
        return sum((self.size >> level) ** 2 for level in range(self.levels))

    def packed(self, device: torch.device | str) -> Tensor:
        """The texels as ``(M,)`` int32 on a device: one gather then fetches all channels."""
        key = str(device)
        if key not in self._moved:
            self._moved[key] = self.texels.view(torch.int32).reshape(-1).to(device)
        return self._moved[key]

    def tagged(self, *tags: str) -> np.ndarray:
        """Indices of the textures with any of the tags; all of them if there is none."""
        found = np.flatnonzero([tag in tags for tag in self.tags])
        return found if len(found) else np.arange(self.count)


def photographs() -> list[tuple[np.ndarray, str]]:
    """The RGB photographs in [0, 1] that an installed scikit-image carries, with tags; empty without the package."""
    spec = importlib.util.find_spec("skimage")
    if spec is None or spec.origin is None:
        return []
    found = []
    for name, tag in PHOTOGRAPHS.items():
        image = cv2.imread(str(Path(spec.origin).parent / "data" / name), cv2.IMREAD_COLOR)
        if image is not None:
            found.append((cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.float32) / 255, tag))
    return found


def _window(rng: Rng, photo: np.ndarray, size: int) -> np.ndarray:
    """A random square window of a photograph, resized, perhaps mirrored, recoloured."""
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


def _pyramid(image: np.ndarray, levels: int) -> np.ndarray:
    """``(S, S, 3)`` in [0, 1] -> all levels ``(stride, 4)`` uint8 by 2x2 means."""
    rows = []
    for _ in range(levels):
        padded = np.zeros((*image.shape[:2], 4), np.uint8)
        padded[..., :3] = np.rint(np.clip(image, 0, 1) * 255)
        rows.append(padded.reshape(-1, 4))
        half = image.shape[0] // 2
        image = image.reshape(half, 2, half, 2, 3).mean((1, 3))
    return np.concatenate(rows)


@lru_cache(maxsize=4)
def texture_pool(seed: int, count: int = 224, size: int = 256) -> TexturePool:
    """Draw a pool. About a third photographs where scikit-image is installed, the rest procedural.

    Args:
        seed: same seed, same pool (on one machine, with the same packages).
        count: number of textures.
        size: edge length in texels, a power of two.
    """
    levels = size.bit_length() - 1
    photos = photographs()
    names = list(PATTERNS)
    weights = np.array([WEIGHTS.get(name, 1.0) for name in names])
    # Every pattern at least once, then by weight.
    chooser = np.random.default_rng([seed, 7001])
    plan = [*names, *chooser.choice(names, count, p=weights / weights.sum())]
    buffers, means, tags = [], [], []
    for index in range(count):
        rng = np.random.default_rng([seed, 7002, index])
        if photos and index % 3 == 2:
            photo, tag = photos[index // 3 % len(photos)]
            image = _window(rng, photo, size)
        else:
            pattern, tag = PATTERNS[plan[index - (index + 1) // 3 if photos else index]]
            image = pattern(rng, size)
        buffers.append(_pyramid(image, levels))
        means.append(image.mean((0, 1)))
        tags.append(tag)
    return TexturePool(torch.from_numpy(np.concatenate(buffers)), count, size, levels, np.stack(means), tags)


def sample(
    pool: TexturePool, index: Tensor, s: Tensor, t: Tensor, footprint: Tensor, *, bias: float = -0.3
) -> Tensor:
    """Trilinear sampling with mirrored repeat.

    Args:
        pool: the textures.
        index: ``(M,)`` int64 texture of each sample.
        s, t: ``(M,)`` coordinates in texels of level 0 (column, row).
        footprint: ``(M,)`` edge of a pixel in texels of level 0.
        bias: added to the mip level; negative is sharper.

    Returns:
        ``(M, 3)`` float32 colour in [0, 255].
    """
    packed = pool.packed(s.device)
    size = float(pool.size)
    s = size - (torch.remainder(s, 2 * size) - size).abs_()
    t = size - (torch.remainder(t, 2 * size) - size).abs_()
    lod = footprint.clamp_min(1e-6).log2_().add_(bias).clamp_(0, pool.levels - 1.001)
    level = lod.floor()
    fraction = lod - level
    base = index * pool.stride
    total: Tensor | None = None
    for step in (0.0, 1.0):
        lower = level + step
        scale = torch.exp2(-lower)
        edge = size * scale
        # Texels of the levels below: size^2 (1 - 4^-level) / (1 - 1/4).
        offset = base + (size * size * (1 - scale * scale) * (4.0 / 3.0)).round_().long()
        x = (s * scale - 0.5).clamp_min_(0).minimum(edge - 1)
        y = (t * scale - 0.5).clamp_min_(0).minimum(edge - 1)
        x0, y0 = x.floor(), y.floor()
        fx, fy = x - x0, y - y0
        right = (x0 + 1 < edge).long()
        below = torch.where(y0 + 1 < edge, edge, 0.0).long()
        corner = offset + (y0 * edge + x0).long()
        at = torch.stack([corner, corner + right, corner + below, corner + below + right])
        share = fraction if step else 1 - fraction
        lower_weight, upper_weight = (1 - fy) * share, fy * share
        weight = torch.stack([lower_weight * (1 - fx), lower_weight * fx, upper_weight * (1 - fx), upper_weight * fx])
        colours = packed[at].view(torch.uint8).view(4, -1, 4)[..., :3].float()
        part = (colours * weight[..., None]).sum(0)
        total = part if total is None else total + part
    assert total is not None
    return total
