"""Builder of scenes: families add polygons, boxes and columns with materials drawn from the texture pool."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dvo.synth.scenes.scene import CELL, Scene, cross
from dvo.synth.textures.texture import TexturePool

Array = np.ndarray


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

        Returns:
            The material.
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
        a, b = cross(rise, front) * width / 2, rise * height / 2
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

        Returns:
            The scene, without light.
        """
        rows: dict[str, Any] = {key: np.array([row[key] for row in self.rows]) for key in self.rows[0]}
        corners, down, drape = rows["corners"], rows.pop("down"), rows.pop("drape")
        first = corners[:, 1] - corners[:, 0]
        normal = cross(first, corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        flat_lying = np.abs((down * normal).sum(1)) > 0.99
        down = np.where(flat_lying[:, None], first, down)
        v = down - (down * normal).sum(1, keepdims=True) * normal
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        u = cross(normal, v)
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
