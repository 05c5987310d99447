"""Families of scenes: rooms, corridors, streets, outdoor clutter, table-tops, large planes.

Each function lays out surfaces with a :class:`SceneBuilder` and says where a camera may fly and what it may look at.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dvo.errors import DvoError
from dvo.synth.lighting import bake
from dvo.synth.poses import so3_exp
from dvo.synth.scene import Material, Scene, SceneBuilder
from dvo.synth.textures import TexturePool, texture_pool

Array = np.ndarray
UP = np.array([0.0, 0.0, 1.0])
WALLS = ("wall", "plain", "stone", "cloth")
OBJECTS = ("busy", "photo", "poster", "panel", "cloth", "floor", "stone", "wall")


def yaw(angle: float) -> Array:
    """Rotation ``(3, 3)`` about the vertical."""
    return so3_exp(np.array([0.0, 0.0, angle]))


def _any_rotation(rng: np.random.Generator) -> Array:
    return so3_exp(rng.normal(size=3) * 1.5)


def _paint(b: SceneBuilder, metres: tuple[float, float], bland: float) -> Material:
    """Material of an object; with chance ``bland`` a nearly textureless one."""
    if b.rng.random() < bland:
        return b.material("plain", metres=metres, contrast=(0.5, 1.5))
    return b.material(*OBJECTS, metres=metres) if b.rng.random() < 0.8 else b.material(metres=metres)


def _decorate(b: SceneBuilder, centre: Array, half: Array, count: int, bland: float) -> None:
    """Pictures, posters, doors and shelves on the four walls of a box room, a little in front of the wall."""
    rng = b.rng
    for _ in range(count):
        axis, sign = int(rng.integers(0, 2)), float(rng.choice([-1, 1]))
        normal = np.zeros(3)
        normal[axis] = -sign
        other = 1 - axis
        width, height = np.minimum(rng.uniform(0.3, 1.6, 2), [half[other], half[2] * 1.2])
        spot = centre.copy()
        spot[axis] += sign * (half[axis] - rng.uniform(0.02, 0.06))
        spot[other] += rng.uniform(-1, 1) * max(half[other] - width / 2 - 0.05, 0)
        spot[2] += rng.uniform(-1, 1) * max(half[2] - height / 2 - 0.05, 0)
        paint = _paint(b, (0.5 * width + 0.1, 1.5 * width + 0.2), bland)
        b.rectangle(spot, normal, UP, width, height, paint)


def _furniture(b: SceneBuilder, centre: Array, half: Array, count: int, bland: float) -> None:
    """Boxes standing on the floor, some stacked, columns, tables with legs left out."""
    rng = b.rng
    floor = centre[2] - half[2]
    for _ in range(count):
        size = np.exp(rng.normal(np.log(0.35), 0.45, 3)) * [1, 1, 1.1]
        size = np.minimum(size, half * [0.3, 0.3, 0.85])
        spot = centre + rng.uniform(-1, 1, 3) * (half - size)
        if rng.random() < 0.5:  # push it to a wall
            axis = int(rng.integers(0, 2))
            spot[axis] = centre[axis] + rng.choice([-1, 1]) * (half[axis] - size[axis] * 1.05)
        spot[2] = floor + size[2]
        turned = yaw(rng.normal(0, 0.15) if rng.random() < 0.6 else rng.uniform(0, np.pi))
        paints = [_paint(b, (0.3, 1.5), bland) for _ in range(int(rng.choice([1, 3])))]
        if rng.random() < 0.12:
            b.prism(spot - [0, 0, size[2]], size[0] * 0.5, size[2] * 2, int(rng.integers(6, 11)), paints[0])
            continue
        b.box(spot, size, turned, paints, faces="xXyYZ")
        for _ in range(int(rng.integers(0, 3))):  # things on top
            little = size * rng.uniform(0.1, 0.45, 3)
            place = turned @ (rng.uniform(-0.5, 0.5, 3) * size)
            place[2] = size[2] + little[2]
            b.box(spot + place, little, turned @ yaw(rng.uniform(0, 3)), [_paint(b, (0.1, 0.8), 0.2)], faces="xXyYZ")


def _floaters(b: SceneBuilder, low: Array, high: Array, count: int, size: float, *, quads: float = 0.4) -> None:
    """Free-floating boxes and tilted boards in the box ``low .. high``."""
    rng = b.rng
    for _ in range(count):
        spot, rotation = rng.uniform(low, high), _any_rotation(rng)
        edge = size * np.exp(rng.normal(0, 0.5, 3))
        paint = _paint(b, (float(edge.min()), float(edge.max() * 3)), 0.15)
        if rng.random() < quads:
            b.rectangle(spot, rotation[:, 2], rotation[:, 1], 2 * edge[0], 2 * edge[1], paint, two_sided=True)
        else:
            b.box(spot, edge, rotation, [paint])


def room(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """A furnished room."""
    b = SceneBuilder(rng, pool)
    half = np.array([rng.uniform(1.5, 5), rng.uniform(1.5, 5), rng.uniform(1.15, 1.9)])
    centre = np.array([0, 0, half[2]])
    bland = rng.uniform(0, 0.6)
    wall_tags = ("plain",) if rng.random() < bland else WALLS if rng.random() < 0.6 else (*WALLS, "busy", "photo")
    wall = b.material(*wall_tags, metres=(1, 4))
    floor = b.material("floor", "stone", "cloth", "wall", metres=(0.8, 3))
    b.box(centre, half, np.eye(3), [wall, b.material("plain", "floor", metres=(1, 3), bright=1.2), floor], inside=True)
    if rng.random() < 0.4:  # one wall of another paint
        sign = float(rng.choice([-1, 1]))
        b.rectangle([sign * (half[0] - 0.01), 0, half[2]], [-sign, 0, 0], UP, 2 * half[1], 2 * half[2], b.material(*WALLS, metres=(1, 4)))
    for _ in range(int(rng.integers(0, 3))):  # slanted partitions
        spot = rng.uniform(-0.7, 0.7, 3) * half + centre
        normal = rng.normal(size=3) * [1, 1, 0.4]
        b.rectangle(spot, normal, UP, rng.uniform(0.5, 1.5), rng.uniform(0.5, 2), _paint(b, (0.5, 2), bland), two_sided=True)
    _decorate(b, centre, half, int(rng.integers(3, 13)), bland * 0.5)
    _furniture(b, centre, half, int(rng.integers(3, 12)), bland)
    _floaters(b, centre - half * 0.9, centre + half * 0.9, int(rng.integers(0, 5)), 0.15)
    bounds = np.stack([centre - half, centre + half])
    scene = b.build("room", bounds, float(half[:2].mean()), heading=None, focus=(centre - half * 0.8, centre + half * 0.6))
    bake(scene, rng, lamps=int(rng.integers(1, 4)))
    return scene


def corridor(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """A long hall with doors, pillars and boards; often poor in texture."""
    b = SceneBuilder(rng, pool)
    half = np.array([rng.uniform(0.9, 2.5), rng.uniform(7, 20), rng.uniform(1.15, 2)])
    centre = np.array([0, 0, half[2]])
    bland = rng.uniform(0.2, 0.8)
    wall = b.material("plain", metres=(1.5, 5)) if rng.random() < bland else b.material(*WALLS, metres=(1.5, 5))
    floor = b.material("floor", "stone", "plain", metres=(0.8, 3))
    b.box(centre, half, np.eye(3), [wall, b.material("plain", "floor", "wall", metres=(1, 3), bright=1.1), floor], inside=True)
    y = -half[1] + rng.uniform(0.5, 2)
    while y < half[1] - 1:
        for sign in (-1.0, 1.0):
            kind = rng.random()
            if kind < 0.45:  # door or board
                width, height = rng.uniform(0.5, 1.2), rng.uniform(0.5, 2.0)
                z = height / 2 if rng.random() < 0.5 else rng.uniform(height / 2, 2 * half[2] - height / 2)
                paint = b.material("panel", "poster", "busy", "photo", "floor", metres=(width, width * 2))
                b.rectangle([sign * (half[0] - rng.uniform(0.01, 0.08)), y, z], [-sign, 0, 0], UP, width, height, paint)
            elif kind < 0.62:  # pillar
                size = np.array([rng.uniform(0.06, 0.2), rng.uniform(0.08, 0.4), half[2]])
                b.box([sign * (half[0] - size[0]), y, half[2]], size, np.eye(3), [_paint(b, (0.5, 2), bland)], faces="xXyY")
            elif kind < 0.8:  # cupboard or crate
                size = np.array([rng.uniform(0.1, 0.3), rng.uniform(0.2, 0.7), rng.uniform(0.2, 0.9)])
                b.box([sign * (half[0] - size[0]), y, size[2]], size, np.eye(3), [_paint(b, (0.3, 1.5), bland)], faces="xXyYZ")
        if rng.random() < 0.5:  # lamp or beam at the ceiling
            size = np.array([half[0] * rng.uniform(0.1, 1), rng.uniform(0.05, 0.3), 0.04])
            b.box([0, y, 2 * half[2] - 0.04], size, np.eye(3), [b.material("plain", bright=1.8)], faces="xXyYz")
        y += rng.uniform(0.6, 2.8)
    for sign in (-1.0, 1.0):
        spot = [rng.uniform(-0.3, 0.3), sign * (half[1] - 0.03), rng.uniform(0.8, 1.3)]
        b.rectangle(spot, [0, -sign, 0], UP, rng.uniform(0.8, 1.6), rng.uniform(1, 2), _paint(b, (0.5, 2), 0.2))
    bounds = np.stack([centre - half, centre + half])
    scene = b.build("corridor", bounds, float(half[0] * 2), heading=np.array([0.0, 1.0, 0.0]), height=(0.5, 2 * half[2] - 0.4))
    bake(scene, rng, lamps=int(rng.integers(2, 6)))
    return scene


def _sky(b: SceneBuilder, radius: float) -> list[int]:
    """A far box of sky; returns its surfaces (they glow)."""
    first = len(b.rows)
    paint = b.material("sky", metres=(radius * 1.5, radius * 3), contrast=(0.3, 1.1), bright=1.3)
    b.box([0, 0, 0], [radius, radius, radius], np.eye(3), [paint], inside=True, faces="xXyYZ")
    return list(range(first, len(b.rows)))


def _building(b: SceneBuilder, x: float, y: float, half: Array, sign: float) -> None:
    """A house whose front faces the street, with a shop front, awnings and balconies."""
    rng = b.rng
    front = b.material("facade", "facade", "wall", "busy", metres=(4, 9)) if rng.random() < 0.9 else b.material(metres=(3, 8))
    side = b.material(*WALLS, metres=(3, 7))
    b.box([x + sign * half[0], y, half[2]], half, np.eye(3), [front if rng.random() < 0.5 else side], faces="yY")
    b.box([x + sign * half[0], y, half[2]], half, np.eye(3), [front], faces="x" if sign > 0 else "X")
    if rng.random() < 0.6:
        height = rng.uniform(1.5, 3.5)
        paint = b.material("panel", "poster", "busy", "photo", metres=(2, 5))
        b.rectangle([x - sign * 0.05, y, height / 2], [-sign, 0, 0], UP, 1.9 * half[1], height, paint)
    for _ in range(int(rng.integers(0, 4))):
        size = np.array([rng.uniform(0.2, 0.7), rng.uniform(0.5, half[1] * 0.6 + 0.5), rng.uniform(0.08, 0.6)])
        spot = [x - sign * size[0], y + rng.uniform(-0.5, 0.5) * half[1], rng.uniform(2.5, max(2.6, 1.7 * half[2]))]
        b.box(spot, size, np.eye(3), [_paint(b, (1, 4), 0.4)], faces="xXyYzZ")


def _car(b: SceneBuilder, spot: Array, turned: Array) -> None:
    rng = b.rng
    paint = b.material("plain", "panel", metres=(1.5, 4))
    half = np.array([rng.uniform(0.8, 0.95), rng.uniform(1.8, 2.4), 0.35])
    b.box(spot + [0, 0, 0.6], half, turned, [paint], faces="xXyYZ")
    glass = b.material("panel", "photo", "plain", metres=(1, 3), bright=0.5)
    b.box(spot + [0, 0, 1.2], half * [0.85, rng.uniform(0.45, 0.8), 0.8], turned, [glass, paint, paint], faces="xXyYZ")
    for sx in (-1, 1):
        for sy in (-1, 1):
            hub = turned @ np.array([sx * (half[0] + 0.01), sy * half[1] * 0.65, 0.3])
            b.rectangle(spot + hub, turned[:, 0] * sx, UP, 0.6, 0.6, b.material("busy", "plain", metres=(0.4, 0.8), bright=0.35))


def _tree(b: SceneBuilder, spot: Array) -> None:
    rng = b.rng
    trunk, crown = rng.uniform(1.2, 3), rng.uniform(0.8, 2.2)
    b.prism(spot, rng.uniform(0.08, 0.25), trunk + crown, 6, b.material("floor", "stone", metres=(0.4, 1), bright=0.6))
    paint = b.material("plant", metres=(1, 3))
    for _ in range(int(rng.integers(3, 7))):  # crown of tilted boards
        rotation = _any_rotation(rng)
        centre = spot + [0, 0, trunk + crown * 0.7] + rng.normal(0, 0.35, 3) * crown
        angle = np.sort(rng.uniform(0, 2 * np.pi, 4))
        if np.diff(angle, append=angle[0] + 2 * np.pi).max() > 2.8:
            angle = np.arange(4) * np.pi / 2
        ring = crown * rng.uniform(0.5, 1) * (np.cos(angle)[:, None] * rotation[:, 0] + np.sin(angle)[:, None] * rotation[:, 1])
        b.polygon(centre + ring, paint, two_sided=True)


def street(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Road between houses, with pavements, markings, cars, poles, trees and sky; y is along the street."""
    b = SceneBuilder(rng, pool)
    length, road = rng.uniform(35, 60), rng.uniform(3, 7)
    kerb = rng.uniform(1.5, 5)
    sky = _sky(b, 600.0)
    b.rectangle([0, 0, 0], UP, [0, 1, 0], 400, 400, b.material("ground", "stone", metres=(2, 6)))
    b.rectangle([0, 0, 0.01], UP, [0, 1, 0], 2 * road, 2 * length, b.material("road", metres=(3, 8)))
    pave = b.material("floor", "stone", "road", "ground", metres=(1.5, 5))
    for sign in (-1.0, 1.0):
        size = np.array([kerb / 2, length, 0.06])
        b.box([sign * (road + kerb / 2), 0, 0.06], size, np.eye(3), [pave], faces="xXZ")
    if rng.random() < 0.7:
        paint = b.material("plain", metres=(1, 3), bright=1.7)
        for y in np.arange(-length, length, rng.uniform(5, 9)):
            b.rectangle([rng.normal(0, 0.02), y, 0.025], UP, [0, 1, 0], 0.15, 2.5, paint)
    for sign in (-1.0, 1.0):
        y = -length
        while y < length:
            half = np.array([rng.uniform(3, 6), rng.uniform(3, 10), rng.uniform(2, 8)])
            if rng.random() < 0.82:
                _building(b, sign * (road + kerb + rng.uniform(0, 2.5)), y + half[1], half, sign)
            else:
                for _ in range(2):
                    _tree(b, np.array([sign * (road + kerb + rng.uniform(0, 4)), y + rng.uniform(0, 2) * half[1], 0]))
            y += 2 * half[1] + (rng.uniform(0, 6) if rng.random() < 0.4 else 0.0)
        for y in np.arange(-length, length, rng.uniform(7, 16)):
            spot = np.array([sign * (road + rng.uniform(0.3, 1)), y + rng.uniform(-2, 2), 0.0])
            kind = rng.random()
            if kind < 0.35:
                _tree(b, spot)
            elif kind < 0.6:
                b.prism(spot, rng.uniform(0.05, 0.15), rng.uniform(3, 7), 5, b.material("plain", "stone", bright=0.7))
                sign_paint = b.material("poster", "cloth", "photo", metres=(0.5, 1.5))
                b.rectangle(spot + [0, 0, 2.4], [0, -1, 0.01], UP, 0.8, 0.8, sign_paint, two_sided=True)
            elif kind < 0.85:
                _car(b, spot + [-sign * rng.uniform(1.2, 1.5), 0, 0], yaw(rng.normal(0, 0.03)))
            else:
                size = rng.uniform(0.2, 0.7, 3)
                b.box(spot + [0, 0, size[2]], size, yaw(rng.uniform(0, 3)), [_paint(b, (0.5, 2), 0.3)], faces="xXyYZ")
    bounds = np.array([[-road * 0.6, -length * 0.95, 0.5], [road * 0.6, length * 0.95, 3.0]])
    scene = b.build("street", bounds, rng.uniform(7, 10), heading=np.array([0.0, 1.0, 0.0]), height=(1.0, 2.2))
    bake(scene, rng, sun=True, glowing=np.array(sky), texel=0.8)
    return scene


def clutter(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Ground, a far wall or two, and boxes, poles and boards at all depths under a sky."""
    b = SceneBuilder(rng, pool)
    size = float(np.exp(rng.uniform(np.log(3), np.log(14))))
    sky = _sky(b, 40 * size)
    b.rectangle([0, 0, 0], UP, [0, 1, 0], 30 * size, 30 * size, b.material("ground", "stone", "road", "floor", metres=(0.3 * size, size)))
    for _ in range(int(rng.integers(1, 5))):
        angle, away = rng.uniform(0, 2 * np.pi), rng.uniform(1.3, 3) * size
        inward = np.array([np.cos(angle), np.sin(angle), 0])
        paint = b.material("facade", "wall", "stone", "photo", "plant", "busy", metres=(0.4 * size, 1.5 * size))
        tilt = rng.normal(0, 0.15)
        height = rng.uniform(0.6, 2) * size
        b.rectangle(-inward * away + UP * height / 2, inward + UP * tilt, UP, rng.uniform(1.5, 4) * size, height, paint)
    for _ in range(int(rng.integers(6, 18))):
        half = 0.12 * size * np.exp(rng.normal(0, 0.6, 3))
        spot = np.append(rng.uniform(-1.2, 1.2, 2) * size, half[2])
        kind = rng.random()
        if kind < 0.6:
            b.box(spot, half, yaw(rng.uniform(0, np.pi)), [_paint(b, (float(half.min()), float(3 * half.max())), 0.2)], faces="xXyYZ")
        elif kind < 0.8:
            b.prism(spot * [1, 1, 0], 0.05 * size * rng.uniform(0.3, 1.5), size * rng.uniform(0.2, 1), 7, _paint(b, (0.2, 1), 0.3))
        elif size > 6:
            _tree(b, spot * [1, 1, 0])
    low, high = np.array([-1, -1, 0.1]) * size, np.array([1, 1, 0.9]) * size
    _floaters(b, low, high, int(rng.integers(2, 14)), 0.08 * size)
    bounds = np.array([[-1.1, -1.1, 0.06], [1.1, 1.1, 0.8]]) * size
    scene = b.build("clutter", bounds, size * 0.7, heading=None, focus=(low * 0.6, high * 0.6))
    bake(scene, rng, sun=True, glowing=np.array(sky), texel=0.6)
    return scene


def tabletop(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Objects on a table, seen from near, in a room."""
    b = SceneBuilder(rng, pool)
    half = np.array([rng.uniform(1.5, 3), rng.uniform(1.5, 3), 1.3])
    centre = np.array([0, 0, half[2]])
    b.box(centre, half, np.eye(3), [b.material(*WALLS, "photo", metres=(0.8, 3)), b.material("plain"), b.material("floor", metres=(0.8, 2))], inside=True)
    _decorate(b, centre, half, int(rng.integers(2, 9)), 0.2)
    table = np.array([rng.uniform(0.5, 1), rng.uniform(0.35, 0.7), 0.02])
    top = rng.uniform(0.65, 0.8)
    b.box([0, 0, top - 0.02], table, np.eye(3), [b.material("floor", "cloth", "plain", "poster", metres=(0.4, 1.2))])
    for _ in range(int(rng.integers(4, 14))):
        size = np.exp(rng.normal(np.log(0.07), 0.45, 3))
        spot = np.append(rng.uniform(-0.9, 0.9, 2) * table[:2], top + size[2])
        if rng.random() < 0.25:
            b.prism(spot - [0, 0, size[2]], size[0] * 0.6, 2 * size[2], 9, _paint(b, (0.08, 0.4), 0.3))
        else:
            b.box(spot, size, yaw(rng.uniform(0, np.pi)), [_paint(b, (0.08, 0.4), 0.25)], faces="xXyYZ")
    for _ in range(int(rng.integers(0, 4))):  # a screen, a book stood up
        spot = np.append(rng.uniform(-0.8, 0.8, 2) * table[:2], top + rng.uniform(0.15, 0.3))
        b.rectangle(spot, rng.normal(size=3) * [1, 1, 0.2], UP, rng.uniform(0.2, 0.6), rng.uniform(0.15, 0.4), _paint(b, (0.2, 0.6), 0.2), two_sided=True)
    bounds = np.array([[-1.3, -1.3, top + 0.1], [1.3, 1.3, top + 0.9]])
    focus = (np.append(-table[:2] * 0.6, top), np.append(table[:2] * 0.6, top + 0.15))
    scene = b.build("tabletop", bounds, 0.8, heading=None, focus=focus, near=True)
    bake(scene, rng, lamps=int(rng.integers(1, 4)), texel=0.3)
    return scene


def planes(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """One or a few large planes at a distance, with little in front: nearly degenerate geometry."""
    b = SceneBuilder(rng, pool)
    size = float(np.exp(rng.uniform(np.log(1), np.log(10))))
    half = np.array([3, 3, 2]) * size
    walls = [b.material(metres=(0.5 * size, 3 * size)) for _ in range(3)]
    b.box([0, 0, 0], half, np.eye(3), walls, inside=True)
    for _ in range(int(rng.integers(1, 6))):
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        width, height = rng.uniform(1, 4, 2) * size
        b.rectangle(-normal * rng.uniform(1.2, 2) * size, normal, rng.normal(size=3), width, height, _paint(b, (0.5 * size, 2 * size), 0.1), two_sided=True)
    _floaters(b, -half * 0.5, half * 0.5, int(rng.integers(0, 4)), 0.1 * size)
    scene = b.build("planes", np.stack([-half, half]) * 0.95, 1.5 * size, heading=None, focus=(-half * 0.9, half * 0.9))
    bake(scene, rng, lamps=1, shadows=False)
    return scene


FAMILIES: dict[str, Callable[[np.random.Generator, TexturePool], Scene]] = {
    "room": room, "corridor": corridor, "street": street, "clutter": clutter, "tabletop": tabletop, "planes": planes,
}  # fmt: skip
# Chance of each family in training clips.
SHARES = {"room": 0.28, "corridor": 0.12, "street": 0.26, "clutter": 0.18, "tabletop": 0.1, "planes": 0.06}


def random_scene(seed: int, family: str | None = None, *, pool: TexturePool | None = None) -> Scene:
    """Draw a scene.

    Args:
        seed: same seed, same scene.
        family: one of ``FAMILIES``; drawn by ``SHARES`` if None.
        pool: textures; the pool of seed 0 if None.

    Raises:
        DvoError: no such family.
    """
    rng = np.random.default_rng([seed, 7101])
    drawn = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    name = family or drawn
    if name not in FAMILIES:
        raise DvoError(f"no scene family {name!r}", field="family", remedy=f"choose one of {', '.join(FAMILIES)}")
    return FAMILIES[name](rng, pool or texture_pool(0))
