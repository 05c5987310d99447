"""Things that move by themselves: small rigid scenes on paths of their own, seen together with a static scene."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from dvo.synth.poses import compose, inverse
from dvo.synth.render.view import View, look
from dvo.synth.scenes.scene import Scene

Array = np.ndarray
PER_SURFACE = (
    "origin", "u_axis", "v_axis", "corners", "edges", "two_sided", "texture", "texture_map", "gain", "offset", "light",
    "light_map",
)  # fmt: skip


class Motion(Protocol):
    """Anything with a pose at every time: camera paths too."""

    def poses_wc(self, times: Array) -> Array:
        """Poses ``(T, 7)`` from the moving frame to the world at ``times (T,)`` seconds."""
        ...


@dataclass(frozen=True)
class Body:
    """A rigid thing: surfaces in its own frame (z up, origin inside), and its motion (body to world)."""

    scene: Scene
    motion: Motion

    @cached_property
    def radius(self) -> float:
        """Of the sphere about the body's origin that holds it."""
        return float(np.linalg.norm(self.scene.corners, axis=-1).max())


@dataclass(frozen=True)
class Stage:
    """A static scene and bodies that move in it: renders like a scene, at given times.

    Surfaces are numbered through: those of the scene first, then body after body. Light is baked for each body by
    itself: bodies cast no shadows.
    """

    scene: Scene
    bodies: tuple[Body, ...] = ()

    @cached_property
    def starts(self) -> Array:
        """``(B + 2,)`` first surface of the scene, of every body, and the number of all surfaces."""
        return np.cumsum([0, len(self.scene), *(len(body.scene) for body in self.bodies)])

    @property
    def static(self) -> int:
        """Surfaces from this number on move."""
        return len(self.scene)

    @cached_property
    def surfaces(self) -> Scene:
        """All surfaces as one scene: for paint and light; places are right for the static ones alone."""
        parts = [self.scene, *(body.scene for body in self.bodies)]
        if any(part.pool is not self.scene.pool for part in parts):
            raise ValueError("bodies must take their textures from the pool of their scene")
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in PER_SURFACE}
        others = {f.name: getattr(self.scene, f.name) for f in fields(Scene) if f.name not in PER_SURFACE}
        return Scene(**{**others, **joined, "_cache": {}})

    def owner(self, surface: Array) -> Array:
        """0 for surfaces of the scene, k for those of body k (from 1), -1 for none; any shape."""
        return np.searchsorted(self.starts[1:], np.asarray(surface), side="right") - (np.asarray(surface) < 0)

    def look(self, poses_wc: Array, intrinsics: Array, size: tuple[int, int] | None, times: Array) -> View:
        """As :func:`dvo.synth.render.view.look`; ``times (N,)`` of the cameras say where the bodies are."""
        views = [look(self.scene, poses_wc, intrinsics, size)]
        for body, start in zip(self.bodies, self.starts[1:-1], strict=True):
            seen_from = compose(inverse(body.motion.poses_wc(times)), poses_wc)
            view = look(body.scene, seen_from, intrinsics, size)
            views.append(replace(view, index=view.index + start))
        if len(views) == 1:
            return views[0]
        joined = {
            f.name: np.concatenate([getattr(v, f.name) for v in views], int(f.name != "index")) for f in fields(View)
        }
        return View(**joined)
