"""Indoor families: room, corridor, table-top, large planes."""

from __future__ import annotations

import numpy as np

from dvo.synth.scenes.builder import SceneBuilder
from dvo.synth.scenes.furnishing import UP, WALLS, decorate, furnish, paint_object, scatter, yaw
from dvo.synth.scenes.lighting import bake
from dvo.synth.scenes.scene import Scene
from dvo.synth.textures.texture import TexturePool


def room(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Furnished room.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
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
        b.rectangle(
            [sign * (half[0] - 0.01), 0, half[2]],
            [-sign, 0, 0],
            UP,
            2 * half[1],
            2 * half[2],
            b.material(*WALLS, metres=(1, 4)),
        )
    for _ in range(int(rng.integers(0, 3))):  # slanted partitions
        spot = rng.uniform(-0.7, 0.7, 3) * half + centre
        normal = rng.normal(size=3) * [1, 1, 0.4]
        b.rectangle(
            spot,
            normal,
            UP,
            rng.uniform(0.5, 1.5),
            rng.uniform(0.5, 2),
            paint_object(b, (0.5, 2), bland),
            two_sided=True,
        )
    decorate(b, centre, half, int(rng.integers(3, 13)), bland * 0.5)
    furnish(b, centre, half, int(rng.integers(3, 12)), bland)
    scatter(b, centre - half * 0.9, centre + half * 0.9, int(rng.integers(0, 5)), 0.15)
    bounds = np.stack([centre - half, centre + half])
    scene = b.build(
        "room", bounds, float(half[:2].mean()), heading=None, focus=(centre - half * 0.8, centre + half * 0.6)
    )
    bake(scene, rng, lamps=int(rng.integers(1, 4)))
    return scene


def corridor(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Long corridor with doors, pillars and boards; often poor in texture.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
    b = SceneBuilder(rng, pool)
    half = np.array([rng.uniform(0.9, 2.5), rng.uniform(7, 20), rng.uniform(1.15, 2)])
    centre = np.array([0, 0, half[2]])
    bland = rng.uniform(0.2, 0.8)
    wall = b.material("plain", metres=(1.5, 5)) if rng.random() < bland else b.material(*WALLS, metres=(1.5, 5))
    floor = b.material("floor", "stone", "plain", metres=(0.8, 3))
    b.box(
        centre,
        half,
        np.eye(3),
        [wall, b.material("plain", "floor", "wall", metres=(1, 3), bright=1.1), floor],
        inside=True,
    )
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
                b.box(
                    [sign * (half[0] - size[0]), y, half[2]],
                    size,
                    np.eye(3),
                    [paint_object(b, (0.5, 2), bland)],
                    faces="xXyY",
                )
            elif kind < 0.8:  # cupboard or crate
                size = np.array([rng.uniform(0.1, 0.3), rng.uniform(0.2, 0.7), rng.uniform(0.2, 0.9)])
                b.box(
                    [sign * (half[0] - size[0]), y, size[2]],
                    size,
                    np.eye(3),
                    [paint_object(b, (0.3, 1.5), bland)],
                    faces="xXyYZ",
                )
        if rng.random() < 0.5:  # lamp or beam at the ceiling
            size = np.array([half[0] * rng.uniform(0.1, 1), rng.uniform(0.05, 0.3), 0.04])
            b.box([0, y, 2 * half[2] - 0.04], size, np.eye(3), [b.material("plain", bright=1.8)], faces="xXyYz")
        y += rng.uniform(0.6, 2.8)
    for sign in (-1.0, 1.0):
        spot = [rng.uniform(-0.3, 0.3), sign * (half[1] - 0.03), rng.uniform(0.8, 1.3)]
        b.rectangle(spot, [0, -sign, 0], UP, rng.uniform(0.8, 1.6), rng.uniform(1, 2), paint_object(b, (0.5, 2), 0.2))
    bounds = np.stack([centre - half, centre + half])
    scene = b.build(
        "corridor", bounds, float(half[0] * 2), heading=np.array([0.0, 1.0, 0.0]), height=(0.5, 2 * half[2] - 0.4)
    )
    bake(scene, rng, lamps=int(rng.integers(2, 6)))
    return scene


def tabletop(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Objects on a table in a room, seen from a short distance.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
    b = SceneBuilder(rng, pool)
    half = np.array([rng.uniform(1.5, 3), rng.uniform(1.5, 3), 1.3])
    centre = np.array([0, 0, half[2]])
    b.box(
        centre,
        half,
        np.eye(3),
        [b.material(*WALLS, "photo", metres=(0.8, 3)), b.material("plain"), b.material("floor", metres=(0.8, 2))],
        inside=True,
    )
    decorate(b, centre, half, int(rng.integers(2, 9)), 0.2)
    table = np.array([rng.uniform(0.5, 1), rng.uniform(0.35, 0.7), 0.02])
    top = rng.uniform(0.65, 0.8)
    b.box([0, 0, top - 0.02], table, np.eye(3), [b.material("floor", "cloth", "plain", "poster", metres=(0.4, 1.2))])
    for _ in range(int(rng.integers(4, 14))):
        size = np.exp(rng.normal(np.log(0.07), 0.45, 3))
        spot = np.append(rng.uniform(-0.9, 0.9, 2) * table[:2], top + size[2])
        if rng.random() < 0.25:
            b.prism(spot - [0, 0, size[2]], size[0] * 0.6, 2 * size[2], 9, paint_object(b, (0.08, 0.4), 0.3))
        else:
            b.box(spot, size, yaw(rng.uniform(0, np.pi)), [paint_object(b, (0.08, 0.4), 0.25)], faces="xXyYZ")
    for _ in range(int(rng.integers(0, 4))):  # a screen, a book stood up
        spot = np.append(rng.uniform(-0.8, 0.8, 2) * table[:2], top + rng.uniform(0.15, 0.3))
        b.rectangle(
            spot,
            rng.normal(size=3) * [1, 1, 0.2],
            UP,
            rng.uniform(0.2, 0.6),
            rng.uniform(0.15, 0.4),
            paint_object(b, (0.2, 0.6), 0.2),
            two_sided=True,
        )
    bounds = np.array([[-1.3, -1.3, top + 0.1], [1.3, 1.3, top + 0.9]])
    focus = (np.append(-table[:2] * 0.6, top), np.append(table[:2] * 0.6, top + 0.15))
    scene = b.build("tabletop", bounds, 0.8, heading=None, focus=focus, near=True)
    bake(scene, rng, lamps=int(rng.integers(1, 4)), texel=0.3)
    return scene


def planes(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """One or a few large planes at a distance, with little in front: nearly degenerate geometry.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
    b = SceneBuilder(rng, pool)
    size = float(np.exp(rng.uniform(np.log(1), np.log(10))))
    half = np.array([3, 3, 2]) * size
    walls = [b.material(metres=(0.5 * size, 3 * size)) for _ in range(3)]
    b.box([0, 0, 0], half, np.eye(3), walls, inside=True)
    for _ in range(int(rng.integers(1, 6))):
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        width, height = rng.uniform(1, 4, 2) * size
        b.rectangle(
            -normal * rng.uniform(1.2, 2) * size,
            normal,
            rng.normal(size=3),
            width,
            height,
            paint_object(b, (0.5 * size, 2 * size), 0.1),
            two_sided=True,
        )
    scatter(b, -half * 0.5, half * 0.5, int(rng.integers(0, 4)), 0.1 * size)
    scene = b.build("planes", np.stack([-half, half]) * 0.95, 1.5 * size, heading=None, focus=(-half * 0.9, half * 0.9))
    bake(scene, rng, lamps=1, shadows=False)
    return scene
