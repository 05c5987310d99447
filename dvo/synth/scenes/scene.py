"""Scenes: flat convex surfaces with textures and baked light, and the free space among them.

World frame: z up, metres. A surface is a convex polygon in the plane ``origin + u * u_axis + v * v_axis`` (unit axes,
u and v in metres). Seen from the front, u points right and v down, as in an image, so that textures stand upright;
``v_axis x u_axis`` is the front normal.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dvo.synth.textures.texture import TexturePool

Array = np.ndarray
CELL = 24  # texels along a light map at most


def cross(a: Array, b: Array) -> Array:
    """``a x b`` along the last axis; several times faster than np.cross on small arrays."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


@dataclass
class Scene:
    """P surfaces. Arrays are float64 unless stated otherwise.

    Attributes:
        origin, u_axis, v_axis: ``(P, 3)``.
        corners: ``(P, 4, 3)`` in the world (a triangle repeats its last corner).
        edges: ``(P, 4, 3)`` half-planes: a point (u, v) is inside where ``edges @ (u, v, 1) >= 0``; metres.
        two_sided: ``(P,)`` bool; the others are visible from their front only.
        texture: ``(P,)`` int64 index into the pool.
        texture_map: ``(P, 2, 3)`` texel coordinates from (u, v, 1).
        gain, offset: ``(P, 3)`` colour = gain * texel + offset, in [0, 1].
        light: ``(P, CELL, CELL, 3)`` float32 light map of each surface, multiplied onto the colour.
        light_map: ``(P, 2, 3)`` light-map coordinates from (u, v, 1).
        pool: the textures.
        family: name of the family that laid it out.
        bounds: ``(2, 3)`` corners of the box of camera positions.
        solids: ``(K, 15)`` centre, half sizes, rotation (row-major, box to world) of boxes that cameras must not enter.
        scale: typical viewing distance, metres.
        hints: information for path planning: ``heading`` (3,) along a street or None, ``focus`` (low, high) box of
            points to look at, ``height`` (low, high) of cameras.
    """

    origin: Array
    u_axis: Array
    v_axis: Array
    corners: Array
    edges: Array
    two_sided: Array
    texture: Array
    texture_map: Array
    gain: Array
    offset: Array
    pool: TexturePool
    family: str
    bounds: Array
    solids: Array
    scale: float
    light: Array
    light_map: Array
    hints: dict[str, Any] = field(default_factory=dict)
    _cache: dict[str, dict[str, Tensor]] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.origin)

    @cached_property
    def normal(self) -> Array:
        """``(P, 3)`` front normals."""
        return cross(self.v_axis, self.u_axis)

    def tensors(self, device: torch.device | str) -> dict[str, Tensor]:
        """Per-surface parameters of shading on a device, kept after the first call.

        Args:
            device: where.

        Returns:
            ``surface (13, P)``: linear part of the texture map (4), gain (3), offset (3), left and top of the texture's
            cell, left edge of the light map's cell; ``light (1, 3, CELL, P CELL)``.
        """
        key = str(device)
        if key not in self._cache:
            cells = np.array([self.pool.cell(int(texture)) for texture in self.texture])
            columns = [
                self.texture_map[:, :, :2].reshape(-1, 4), self.gain, self.offset,
                cells[:, 1:], cells[:, :1], (np.arange(len(self)) * CELL)[:, None],
            ]  # fmt: skip
            table = np.ascontiguousarray(np.concatenate(columns, 1).T, np.float32)
            picture = self.light.transpose(3, 1, 0, 2).reshape(1, 3, CELL, -1)
            self._cache[key] = {
                "surface": torch.from_numpy(table).to(device),
                "light": torch.from_numpy(np.ascontiguousarray(picture)).to(device),
            }
        return self._cache[key]

    @cached_property
    def spheres(self) -> tuple[Array, Array]:
        """Bounding spheres: centres ``(P, 3)``, radii ``(P,)``."""
        centre = self.corners.mean(1)
        return centre, np.linalg.norm(self.corners - centre[:, None], axis=-1).max(1)

    @cached_property
    def _frames(self) -> tuple[Array, Array, Array]:
        """Axes u, v, normal ``(P, 3, 3)`` and the bounds of (u, v) ``(P, 2)`` each."""
        flat = self.corners - self.origin[:, None]
        size = np.stack([(flat * axis[:, None]).sum(-1) for axis in (self.u_axis, self.v_axis)], -1)
        return np.stack([self.u_axis, self.v_axis, self.normal], 1), size.min(1), size.max(1)

    def clearance(self, points: Array) -> Array:
        """Distance from points to the nearest surface.

        Args:
            points: ``(T, 3)`` in the world.

        Returns:
            ``(T,)`` metres; -1 inside a solid or out of bounds.
        """
        distance = np.full(len(points), -1.0)
        axes, low, high = self._frames
        for i in np.flatnonzero(self.is_free(points)):
            local = (axes @ (points[i] - self.origin)[..., None])[..., 0]
            over = np.maximum(np.maximum(low - local[:, :2], local[:, :2] - high), 0)
            distance[i] = np.sqrt(((over**2).sum(1) + local[:, 2] ** 2).min())
        return distance

    def is_free(self, points: Array) -> Array:
        """Membership in the free space: inside the bounds and outside every solid.

        Args:
            points: ``(T, 3)`` in the world.

        Returns:
            ``(T,)`` bool.
        """
        free = ((points >= self.bounds[0]) & (points <= self.bounds[1])).all(1)
        if len(self.solids):
            local = (points[:, None] - self.solids[:, :3])[:, :, None] @ self.solids[:, 6:].reshape(-1, 3, 3)
            free &= ~(np.abs(local[:, :, 0]) <= self.solids[:, 3:6]).all(2).any(1)
        return free
