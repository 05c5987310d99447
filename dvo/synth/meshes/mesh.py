"""Meshes as scenes: triangles with their own textures, rendered and explored like :class:`dvo.synth.Scene`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.synth.meshes.space import FreeSpace
from dvo.synth.meshes.textures import TextureSet

Array = np.ndarray


@dataclass
class MeshScene:
    """T triangles. World frame: z up, units of the file.

    Attributes:
        corners: ``(T, 3, 3)`` float64 (triangle, corner, coordinate).
        tint: ``(T, 3, 3)`` float32 colour of each corner, light included; multiplied onto the texture.
        texture: ``(T,)`` int64 index into ``textures``, -1 for none.
        texture_uv: ``(T, 3, 2)`` float64 column and row of each corner in units of the texture's edges; repeats.
        textures: the images.
        space: free space for cameras.
        scale: typical viewing distance.
        hints: information for path planning, as in :class:`dvo.synth.Scene`.
        family: name for sequences.
        warnings: changes made to the file's content, one sentence each.
        files: the mesh file, and those that it names.
    """

    corners: Array
    tint: Array
    texture: Array
    texture_uv: Array
    textures: TextureSet
    space: FreeSpace
    scale: float
    hints: dict[str, Any] = field(default_factory=dict)
    family: str = "mesh"
    warnings: list[str] = field(default_factory=list)
    files: tuple[Path, ...] = ()
    _cache: dict[str, dict[str, Tensor]] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.corners)

    @property
    def bounds(self) -> Array:
        """``(2, 3)`` box of camera positions."""
        return self.space.bounds

    @cached_property
    def solids(self) -> Array:
        """Empty ``(0, 15)``: the free space of a mesh is a grid."""
        return np.zeros((0, 15))

    def is_free(self, points: Array) -> Array:
        """Membership in the free space around or within the mesh.

        Args:
            points: ``(T, 3)``.

        Returns:
            ``(T,)`` bool.
        """
        return self.space.is_free(points)

    def clearance(self, points: Array) -> Array:
        """Distance from points to the nearest triangle.

        Args:
            points: ``(T, 3)``.

        Returns:
            ``(T,)`` in units of the file; -1 outside the free space.
        """
        return self.space.clearance(points)

    def tensors(self, device: torch.device | str) -> dict[str, Tensor]:
        """Triangles on a device, kept after the first call.

        Args:
            device: where.

        Returns:
            ``corners``, ``tint``, ``texture`` and ``uv`` as tensors.
        """
        key = str(device)
        if key not in self._cache:
            arrays = {"corners": self.corners, "tint": self.tint, "texture": self.texture, "uv": self.texture_uv}
            self._cache[key] = {name: torch.from_numpy(array).to(device) for name, array in arrays.items()}
        return self._cache[key]
