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
from numpy.typing import ArrayLike
from torch import Tensor

from dvo.synth.textures.texture import TexturePool

Array = np.ndarray
CELL = 24  # texels along a light map at most


def _cross(a: Array, b: Array) -> Array:
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
        return _cross(self.v_axis, self.u_axis)

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


@dataclass
class Material:
    """Texture, size and colour of a surface.

    Attributes:
        texture: index into the pool.
        metres: width of one texture repeat.
        gain, offset: ``(3,)`` colour transform.
        turn: rotation of the texture in the surface, rad.
        whole: stretch the texture to most of the surface (pictures that must not repeat).
    """

    texture: int
    metres: float
    gain: Array
    offset: Array
    turn: float = 0.0
    whole: bool = False


class SceneBuilder:
    """Collects surfaces; :meth:`build` turns them into a :class:`Scene`.

    Args:
        rng: draws materials and texture offsets.
        pool: textures.
    """

    def __init__(self, rng: np.random.Generator, pool: TexturePool) -> None:
        self.rng, self.pool = rng, pool
        self.rows: list[dict[str, Any]] = []
        self.solids: list[Array] = []

    def material(
        self, *tags: str, metres: tuple[float, float] = (0.6, 2.5), contrast: tuple[float, float] = (0.6, 1.2),
        bright: float = 1.0, turn: float = 0.0,
    ) -> Material:  # fmt: skip
        """Draw a material.

        Args:
            tags: the texture has one of these tags; any texture without tags.
            metres: range of the width of one texture repeat.
            contrast: range of the share of the texture's contrast that is kept.
            bright: factor on the brightness.
            turn: rotation of the texture, rad.
        """
        rng = self.rng
        texture = int(rng.choice(self.pool.tagged(*tags))) if tags else int(rng.integers(self.pool.count))
        mean = self.pool.use(texture)
        strength = rng.uniform(*contrast)
        # Pull dark and bright textures towards medium grey, or black walls would have no gradients.
        level = bright * np.exp(rng.normal(0, 0.22)) * (0.45 / max(mean.mean(), 0.08)) ** 0.5
        tint = level * np.exp(rng.normal(0, 0.06, 3))
        repeat = float(np.exp(rng.uniform(*np.log(metres))))
        whole = self.pool.tags[texture] in ("photo", "poster") and rng.random() < 0.8
        return Material(texture, repeat, tint * strength, tint * (1 - strength) * mean, turn, whole)

    def polygon(
        self, corners: ArrayLike, material: Material, *, up: Array | None = None, two_sided: bool = False,
        drape: Array | None = None,
    ) -> None:  # fmt: skip
        """Add a convex planar polygon.

        Args:
            corners: ``(3 or 4, 3)``, counter-clockwise seen from the front.
            material: of the surface.
            up: direction in which the texture stands upright; z if None.
            two_sided: visible from both sides.
            drape: ``(2,)`` texels; projects the texture from above with this shift, so that it continues across
                polygons.
        """
        corners = np.asarray(corners, float)
        if len(corners) == 3:
            corners = np.concatenate([corners, corners[2:]])
        metres = material.metres
        if material.whole:
            metres = max(metres, 0.8 * float(np.ptp(corners, axis=0).max()))
        density = self.pool.size / metres
        c, s = np.cos(material.turn) * density, np.sin(material.turn) * density
        shift = self.rng.uniform(0, 2 * self.pool.size, 2) if drape is None else drape
        self.rows.append(
            {
                "corners": corners, "down": np.array([0.0, 0.0, -1.0]) if up is None else -np.asarray(up, float),
                "two_sided": two_sided, "texture": material.texture,
                "texture_map": [[c, -s, shift[0]], [s, c, shift[1]]], "gain": material.gain, "offset": material.offset,
                "drape": drape is not None,
            }
        )  # fmt: skip

    def rectangle(
        self, centre: ArrayLike, normal: ArrayLike, up: ArrayLike, width: float, height: float, material: Material,
        *, two_sided: bool = False,
    ) -> None:  # fmt: skip
        """Add a rectangle.

        Args:
            centre: ``(3,)``.
            normal: ``(3,)`` direction that it faces, of any length.
            up: ``(3,)`` direction of its height; made orthogonal to the normal.
            width, height: metres.
            material: of the surface.
            two_sided: visible from both sides.
        """
        front, rise = np.asarray(normal, float), np.asarray(up, float)
        front = front / np.sqrt(front @ front)
        rise = rise - (rise @ front) * front
        rise = rise / np.sqrt(rise @ rise)
        a, b = _cross(rise, front) * width / 2, rise * height / 2
        spot = np.asarray(centre, float)
        self.polygon(
            np.stack([spot - a - b, spot + a - b, spot + a + b, spot - a + b]), material, up=rise, two_sided=two_sided
        )

    def box(
        self, centre: ArrayLike, half: ArrayLike, rotation: Array, materials: list[Material], *, inside: bool = False,
        faces: str = "xXyYzZ",
    ) -> None:  # fmt: skip
        """Add a box, and the solid that it occupies.

        Args:
            centre: ``(3,)``.
            half: ``(3,)`` half sizes, metres.
            rotation: ``(3, 3)`` box to world.
            materials: one for all faces, or three for sides, top and bottom.
            inside: faces point inwards (a room); no solid then.
            faces: letters of the faces to add; lower case is the negative side of an axis.
        """
        centre, half = np.asarray(centre, float), np.asarray(half, float)
        side, top, bottom = (materials * 3)[:3] if len(materials) == 1 else materials
        for axis in range(3):
            for sign, name in ((-1.0, "xyz"[axis]), (1.0, "XYZ"[axis])):
                if name not in faces:
                    continue
                outward = rotation[:, axis] * sign
                up = rotation[:, 2] if axis < 2 else rotation[:, 1]
                width = 2 * half[1 if axis == 0 else 0]
                height = 2 * half[2 if axis < 2 else 1]
                paint = side if axis < 2 else top if sign > 0 else bottom
                spot = centre + outward * half[axis]
                self.rectangle(spot, -outward if inside else outward, up, width, height, paint)
        if not inside:
            self.solids.append(np.concatenate([centre, half, rotation.ravel()]))

    def prism(self, foot: ArrayLike, radius: float, height: float, sides: int, material: Material) -> None:
        """Add an upright column.

        Args:
            foot: ``(3,)`` centre of its base.
            radius, height: metres.
            sides: number of faces.
            material: of all faces.
        """
        angle = np.arange(sides) * 2 * np.pi / sides + self.rng.uniform(0, 1)
        ring = np.asarray(foot, float) + radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], -1)
        rise = np.array([0, 0, height])
        for a, b in zip(ring, np.roll(ring, -1, 0), strict=True):
            self.polygon(np.stack([a, b, b + rise, a + rise]), material)
        half = np.array([radius, radius, height / 2])
        self.solids.append(np.concatenate([np.asarray(foot) + rise / 2, half, np.eye(3).ravel()]))

    def build(self, family: str, bounds: Array, scale: float, **hints: Any) -> Scene:
        """Stack all surfaces and derive their axes and edges; :func:`dvo.synth.scenes.lighting.bake` then adds light.

        Args:
            family: name of the family.
            bounds: ``(2, 3)`` box of camera positions.
            scale: typical viewing distance, metres.
            hints: see :class:`Scene`.
        """
        rows: dict[str, Any] = {key: np.array([row[key] for row in self.rows]) for key in self.rows[0]}
        corners, down, drape = rows["corners"], rows.pop("down"), rows.pop("drape")
        first = corners[:, 1] - corners[:, 0]
        normal = _cross(first, corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        flat_lying = np.abs((down * normal).sum(1)) > 0.99
        down = np.where(flat_lying[:, None], first, down)
        v = down - (down * normal).sum(1, keepdims=True) * normal
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        u = _cross(normal, v)
        origin = corners.mean(1)
        offset = corners - origin[:, None]
        flat = np.stack([(offset * u[:, None]).sum(-1), (offset * v[:, None]).sum(-1)], -1)
        step = np.roll(flat, -1, 1) - flat
        length = np.linalg.norm(step, axis=-1)
        inward = np.stack([step[..., 1], -step[..., 0]], -1) / np.maximum(length, 1e-12)[..., None]
        edges = np.concatenate([inward, -(inward * flat).sum(-1, keepdims=True)], -1)
        edges[length < 1e-9] = [0, 0, 1]  # the edge that a triangle lacks
        if drape.any():  # from (u, v, 1) to (x, y, 1) first
            place = np.stack([u, v, origin], 2)[drape]
            place[:, 2] = [0, 0, 1]
            rows["texture_map"][drape] = rows["texture_map"][drape] @ place
        count = len(corners)
        return Scene(
            **rows, origin=origin, u_axis=u, v_axis=v, edges=edges, pool=self.pool, family=family,
            bounds=np.asarray(bounds, float), solids=np.array(self.solids).reshape(-1, 15), scale=scale,
            light=np.ones((count, CELL, CELL, 3), np.float32), light_map=np.zeros((count, 2, 3)), hints=hints,
        )  # fmt: skip
