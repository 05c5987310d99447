"""Moving bodies: small rigid scenes with a motion of their own, seen together with a static scene."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from dvo.core.errors import DvoError
from dvo.synth.protocols import Motion
from dvo.synth.scenes.scene import Scene

Array = np.ndarray
PER_SURFACE = (
    "origin", "u_axis", "v_axis", "corners", "edges", "two_sided", "texture", "texture_map", "gain", "offset", "light",
    "light_map",
)  # fmt: skip


@dataclass(frozen=True)
class Body:
    """Rigid moving object.

    Attributes:
        scene: surfaces in its own frame (z up, origin inside).
        motion: body to world.
    """

    scene: Scene
    motion: Motion

    @cached_property
    def radius(self) -> float:
        """Radius of the sphere about the body's origin that contains it, metres."""
        return float(np.linalg.norm(self.scene.corners, axis=-1).max())


@dataclass(frozen=True)
class Stage:
    """Static scene with moving bodies; renders like a scene, at given times.

    Surfaces are numbered consecutively: those of the scene first, then body after body. Light is baked for each body
    separately: bodies cast no shadows.

    Attributes:
        scene: the static surfaces.
        bodies: the moving ones.
    """

    scene: Scene
    bodies: tuple[Body, ...] = ()

    @cached_property
    def starts(self) -> Array:
        """``(B + 2,)`` first surface of the scene and of every body, and the number of all surfaces."""
        return np.cumsum([0, len(self.scene), *(len(body.scene) for body in self.bodies)])

    @property
    def static(self) -> int:
        """Number of static surfaces; surfaces from this index on move."""
        return len(self.scene)

    @cached_property
    def surfaces(self) -> Scene:
        """All surfaces as one scene, for textures and light. Positions are valid for the static surfaces alone.

        Raises:
            DvoError: a body whose textures come from another pool.
        """
        parts = [self.scene, *(body.scene for body in self.bodies)]
        if any(part.pool is not self.scene.pool for part in parts):
            raise DvoError("bodies must take their textures from the pool of their scene", field="bodies")
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in PER_SURFACE}
        others = {f.name: getattr(self.scene, f.name) for f in fields(Scene) if f.name not in PER_SURFACE}
        return Scene(**{**others, **joined, "_cache": {}})

    def owner(self, surface: Array) -> Array:
        """Owner of surfaces.

        Args:
            surface: indices of any shape.

        Returns:
            0 for surfaces of the scene, k for those of body k (from 1), -1 for none; same shape.
        """
        return np.searchsorted(self.starts[1:], np.asarray(surface), side="right") - (np.asarray(surface) < 0)
