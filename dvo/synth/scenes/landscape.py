"""Landscape families: hilly terrain and forest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.synth.scenes.builder import Material, SceneBuilder
from dvo.synth.scenes.furnishing import UP, WALLS, any_rotation, paint_object, scatter, yaw
from dvo.synth.scenes.lighting import bake
from dvo.synth.scenes.scene import Scene
from dvo.synth.scenes.vegetation import bush, conifer, frustum, rock, sky, tree
from dvo.synth.textures.texture import TexturePool

Array = np.ndarray
GRID = 13  # lines of the height field each way


@dataclass
class Hills:
    """Smooth height over the plane: waves of several lengths, higher away from the middle.

    Attributes:
        wave: ``(K, 2)`` rad per metre; phase, amplitude: ``(K,)``.
        size: metres over which the middle stays low.
    """

    wave: Array
    phase: Array
    amplitude: Array
    size: float

    def height(self, xy: Array) -> Array:
        """Height of the ground.

        Args:
            xy: ``(..., 2)`` metres.

        Returns:
            ``(...)`` metres.
        """
        waves = (self.amplitude * np.sin(xy @ self.wave.T + self.phase)).sum(-1)
        away = np.linalg.norm(xy, axis=-1) / self.size
        return waves * (0.5 + 0.5 * away) + 0.12 * self.size * np.maximum(away - 0.8, 0) ** 1.3

    def normal(self, xy: Array) -> Array:
        """Unit normals of the ground, by finite differences.

        Args:
            xy: ``(..., 2)`` metres.

        Returns:
            ``(..., 3)``.
        """
        step = 0.02 * self.size
        dx, dy = ((self.height(xy + shift) - self.height(xy - shift)) / (2 * step) for shift in ([step, 0], [0, step]))
        normal = np.stack([-dx, -dy, np.ones_like(dx)], -1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _hills(rng: np.random.Generator, size: float) -> Hills:
    """Draw hills of a given size (metres)."""
    length = size * np.array([2.2, 1.6, 0.9, 0.7, 0.5])
    turn = rng.uniform(0, 2 * np.pi, 5)
    wave = 2 * np.pi / length[:, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    return Hills(wave, rng.uniform(0, 2 * np.pi, 5), 0.05 * length * rng.uniform(0.2, 0.9, 5), size)


def _height_field(b: SceneBuilder, hills: Hills, lines: Array, paints: list[Material]) -> list[int]:
    """Add triangles over the grid ``lines`` x ``lines`` and solids below it; returns the rows of the triangles."""
    first = len(b.rows)
    shift = b.rng.uniform(0, 500, 2)
    x, y = np.meshgrid(lines, lines, indexing="ij")
    points = np.stack([x, y, hills.height(np.stack([x, y], -1))], -1)
    for i in range(len(lines) - 1):
        for j in range(len(lines) - 1):
            a, c = points[i, j], points[i + 1, j + 1]
            d, e = points[i + 1, j], points[i, j + 1]
            away = max(abs(a[:2] + c[:2])) / 2
            paint = paints[0] if away < 1.6 * hills.size or len(paints) == 1 else paints[1]
            # Cut along the higher diagonal, so that valleys are not bridged.
            for corners in ([a, d, c], [a, c, e]) if a[2] + c[2] > d[2] + e[2] else ([a, d, e], [d, c, e]):
                b.polygon(np.stack(corners), paint, drape=shift)
            if away < 1.6 * hills.size:
                low, high = np.array([a[0], a[1], -2 * hills.size]), np.array([*c[:2], max(p[2] for p in (a, c, d, e))])
                b.solids.append(np.concatenate([(low + high) / 2, (high - low) / 2, np.eye(3).ravel()]))
    return list(range(first, len(b.rows)))


def _house(b: SceneBuilder, spot: Array, size: float) -> None:
    """Add four walls and an overhanging gable roof."""
    rng = b.rng
    half = size * np.array([rng.uniform(0.8, 1.3), rng.uniform(1.0, 1.8), rng.uniform(0.6, 1.0)])
    turned = yaw(rng.uniform(0, np.pi))
    wall = b.material("facade", *WALLS, metres=(2.5 * size, 5 * size))
    b.box(spot + UP * half[2], half, turned, [wall], faces="xXyY")
    rise = half[0] * rng.uniform(0.5, 0.9)
    roof = b.material("roof", metres=(size, 2 * size))
    along, across = turned[:, 1] * half[1], turned[:, 0] * half[0]
    ridge, eaves = spot + UP * (2 * half[2] + rise), spot + UP * 2 * half[2]
    for sign in (-1.0, 1.0):
        out = sign * across * 1.15 - UP * 0.15 * rise
        quad = [eaves + out - sign * along * 1.08, eaves + out + sign * along * 1.08,
                ridge + sign * along * 1.08, ridge - sign * along * 1.08]  # fmt: skip
        b.polygon(np.stack(quad), roof, two_sided=True)
        end = eaves + sign * along
        b.polygon(np.stack([end + sign * across, end - sign * across, end + UP * rise]), wall)


def terrain(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Hills to the horizon, with rocks, trees and up to two houses.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
    b = SceneBuilder(rng, pool)
    size = float(np.exp(rng.uniform(np.log(8), np.log(25))))
    above = sky(b, 60 * size)
    hills = _hills(rng, size)
    # Fine in the middle, coarse towards the horizon.
    t = np.linspace(-1, 1, GRID)
    lines = 1.5 * size * t * (1 + 2.6 * t**4)
    near = b.material(*(("ground",) if rng.random() < 0.7 else ("stone", "road")), metres=(0.25 * size, 0.6 * size))
    far = b.material("ground", "plant", metres=(0.8 * size, 1.6 * size))
    ground = _height_field(b, hills, lines, [near, far] if rng.random() < 0.5 else [near])

    def on_ground(reach: float) -> Array:
        xy = rng.uniform(-reach, reach, 2) * size
        return np.append(xy, hills.height(xy))

    stone = b.material("stone", "wall", metres=(0.1 * size, 0.3 * size))
    for _ in range(int(rng.integers(4, 12))):
        rock(b, on_ground(1.3), size * float(np.exp(rng.normal(np.log(0.05), 0.5))), stone)
    for _ in range(int(rng.integers(2, 8))):
        (conifer if rng.random() < 0.6 else tree)(b, on_ground(1.6), size=0.06 * size * rng.uniform(0.7, 1.6))
    for _ in range(int(rng.integers(0, 3))):
        spot = on_ground(1.2)
        _house(b, spot - UP * 0.02 * size, 0.09 * size)
    top = float(hills.height(np.stack(np.meshgrid(lines[3:-3], lines[3:-3]), -1)).max())
    low = float(hills.height(np.stack(np.meshgrid(lines[3:-3], lines[3:-3]), -1)).min())
    bounds = np.array([[-1.1 * size, -1.1 * size, low], [1.1 * size, 1.1 * size, top + 0.25 * size]])
    focus = np.array([[-0.9, -0.9, 0], [0.9, 0.9, 0]]) * size + [[0, 0, low], [0, 0, 0.5 * (low + top)]]
    scene = b.build("terrain", bounds, 0.6 * size, heading=None, focus=(focus[0], focus[1]))

    def bend(points: Array, normal: Array, owner: Array) -> Array:
        smooth = np.isin(owner, ground)
        normal = normal.copy()
        normal[smooth] = hills.normal(points[smooth, :2])
        return normal

    bake(scene, rng, sun=True, glowing=np.array(above), texel=0.8, exposure=0.85, bend=bend)
    return scene


def forest(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Trunks, poles, bushes and fallen logs at all depths under leaves: thin objects and many occlusions.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
    b = SceneBuilder(rng, pool)
    size = float(rng.uniform(5, 12))
    above = sky(b, 40 * size)
    floor = b.material(*(("ground",) if rng.random() < 0.6 else ("plant", "road")), metres=(0.25 * size, 0.6 * size))
    b.rectangle([0, 0, 0], UP, [0, 1, 0], 40 * size, 40 * size, floor)
    thicket = b.material("plant", metres=(0.4 * size, 0.9 * size), bright=0.6)
    for angle in np.arange(9) * 2 * np.pi / 9 + rng.uniform(0, 1):  # where the wood closes
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        away, height = size * rng.uniform(2.0, 3.2), rng.uniform(5, 12)
        b.rectangle(out * away + UP * height / 2, -out, UP, away * 0.85, height, thicket)
    barks = [b.material("bark", metres=(0.5, 1.6), bright=rng.uniform(0.6, 1.1)) for _ in range(3)]
    pole = b.material("plain", "panel", metres=(0.5, 2))
    spots: list[Array] = []
    for _ in range(int(rng.integers(24, 44))):
        for _ in range(8):
            spot = rng.uniform(-1, 1, 2) * size * 1.6
            if all(np.linalg.norm(spot - other) > 0.16 * size for other in spots):
                break
        spots.append(spot)
        foot, kind = np.append(spot, 0.0), rng.random()
        radius = float(np.exp(rng.normal(np.log(0.16), 0.4)))
        if kind < 0.62:
            height = rng.uniform(7, 14)
            frustum(b, foot, (radius, 0.7 * radius), height, 5, barks[int(rng.integers(3))], lid=False)
            if rng.random() < 0.35:  # roots
                frustum(b, foot, (1.8 * radius, radius), 0.5, 5, barks[0], lid=False, solid=False)
        elif kind < 0.74:
            frustum(b, foot, (0.06, 0.05), rng.uniform(1.5, 5), 4, pole)
        elif kind < 0.86:
            tree(b, foot, size=rng.uniform(0.7, 1.3), cards=7)
        else:
            conifer(b, foot, size=rng.uniform(0.6, 1.1))
    for _ in range(int(rng.integers(4, 12))):
        bush(b, np.append(rng.uniform(-1.2, 1.2, 2) * size, 0.0), rng.uniform(0.3, 0.8))
    stone = b.material("stone", metres=(0.4, 1.5))
    for _ in range(int(rng.integers(0, 5))):
        rock(b, np.append(rng.uniform(-1.2, 1.2, 2) * size, 0.0), rng.uniform(0.2, 0.7), stone)
    for _ in range(int(rng.integers(0, 4))):  # fallen logs
        half = np.array([rng.uniform(0.08, 0.2), rng.uniform(0.8, 2.5), rng.uniform(0.08, 0.2)])
        spot = np.append(rng.uniform(-1, 1, 2) * size, half[2])
        b.box(spot, half, yaw(rng.uniform(0, np.pi)), [barks[0]], faces="xXyYZ")
    leaves = b.material("plant", metres=(1, 3))
    for _ in range(int(rng.integers(10, 24))):  # the canopy above
        spot = np.append(rng.uniform(-1.3, 1.3, 2) * size, rng.uniform(3.5, 8))
        wide, turned = rng.uniform(1, 3), any_rotation(rng)
        b.rectangle(spot, UP + 0.4 * rng.normal(size=3), turned[:, 0], wide, wide, leaves, two_sided=True)
    scatter(b, np.array([-size, -size, 0.3]), np.array([size, size, 2.0]), int(rng.integers(0, 4)), 0.15)
    if rng.random() < 0.3:  # a hut
        half = rng.uniform(0.8, 1.6, 3)
        b.box([*(rng.uniform(-1, 1, 2) * size), half[2]], half, yaw(rng.uniform(0, 3)), [paint_object(b, (1, 3), 0.2)])
    bounds = np.array([[-size, -size, 0.3], [size, size, 2.6]])
    focus = (np.array([-0.8 * size, -0.8 * size, 0.4]), np.array([0.8 * size, 0.8 * size, 2.2]))
    scene = b.build("forest", bounds, 0.45 * size, heading=None, focus=focus, height=(0.6, 2.2))
    bake(scene, rng, sun=True, glowing=np.array(above), texel=0.8, exposure=0.65)
    return scene
