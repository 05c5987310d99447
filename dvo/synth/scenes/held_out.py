"""Held-out families, never drawn for training: hall, courtyard, gallery. Evaluation suites request them by name."""

from __future__ import annotations

import numpy as np

from dvo.synth.scenes.builder import Material, SceneBuilder
from dvo.synth.scenes.furnishing import UP, furnish, yaw
from dvo.synth.scenes.lighting import bake
from dvo.synth.scenes.scene import Scene
from dvo.synth.scenes.vegetation import bush, frustum, sky, tree
from dvo.synth.textures.texture import TexturePool

Array = np.ndarray


def _column(b: SceneBuilder, foot: Array, radius: float, height: float, paint: Material) -> None:
    """Add a round shaft between a square base and a square capital."""
    block = np.array([1.4 * radius, 1.4 * radius, 0.25])
    b.box(foot + UP * 0.25, block, np.eye(3), [paint], faces="xXyYZ")
    frustum(b, foot + UP * 0.5, (radius, 0.85 * radius), height - 0.9, 8, paint, lid=False)
    b.box(foot + UP * (height - 0.2), block * [1, 1, 0.8], np.eye(3), [paint], faces="xXyYz")


def _stairs(b: SceneBuilder, low: Array, high: Array, width: float, steps: int, paint: Material) -> None:
    """Add solid steps that climb along y from the point ``low`` to ``high`` (middle of their width)."""
    rise, run = (high[2] - low[2]) / steps, (high[1] - low[1]) / steps
    for i in range(steps):
        top = low[2] + (i + 1) * rise
        centre = np.array([low[0], low[1] + (i + 0.5) * run, (low[2] + top) / 2])
        half = np.array([width / 2, abs(run) / 2, (top - low[2]) / 2])
        b.box(centre, half, np.eye(3), [paint], faces="xXyYZ")


def hall(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Large interior with rows of columns, a mezzanine with its stairs, high windows and banners.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
    b = SceneBuilder(rng, pool)
    half = np.array([rng.uniform(7, 12), rng.uniform(10, 18), rng.uniform(2.6, 4.2)])
    centre = np.array([0, 0, half[2]])
    wall = b.material("marble", "stone", "wall", metres=(3, 7))
    ceiling = b.material("panel", "plain", metres=(2, 4), bright=1.2)
    floor = b.material("floor", "marble", metres=(2, 4), bright=0.75)
    b.box(centre, half, np.eye(3), [wall, ceiling, floor], inside=True)
    stone = b.material("marble", "stone", metres=(1.5, 3))
    row, gap = half[0] * rng.uniform(0.4, 0.55), rng.uniform(3.5, 5.5)
    radius = rng.uniform(0.25, 0.45)
    for y in np.arange(-half[1] + gap / 2, half[1] - 1, gap):
        for x in (-row, row):
            _column(b, np.array([x, y, 0.0]), radius, 2 * half[2], stone)
        if rng.random() < 0.7:  # a beam across
            b.box([0, y, 2 * half[2] - 0.2], [half[0], 0.2, 0.2], np.eye(3), [stone], faces="yYz")
    # Mezzanine along one wall, with a balustrade and stairs down to the floor.
    side, level = float(rng.choice([-1, 1])), half[2] * rng.uniform(0.85, 1.05)
    deep, reach = half[0] - row - radius - 0.3, half[1] * rng.uniform(0.5, 0.7)
    slab = np.array([side * (half[0] - deep / 2), half[1] - reach, level])
    b.box(slab, [deep / 2, reach, 0.12], np.eye(3), [stone, floor, ceiling])
    rail = b.material("wall", "panel", "plain", metres=(0.5, 1.5))
    edge = side * (half[0] - deep)
    for y in np.arange(half[1] - 2 * reach + 0.2, half[1], 0.9):
        b.box([edge, y, level + 0.55], [0.04, 0.04, 0.45], np.eye(3), [rail], faces="xXyY")
    b.box([edge, half[1] - reach, level + 1.0], [0.06, reach, 0.04], np.eye(3), [rail])
    end = half[1] - 2 * reach
    foot = np.array([side * (half[0] - deep / 2), end - 1.3 * level, 0.0])
    _stairs(b, foot, np.array([foot[0], end, level + 0.12]), 0.8 * deep, 9, stone)
    lit = b.material("plain", metres=(1, 2), bright=2.2)
    for sign in (-1.0, 1.0):
        for y in np.arange(-half[1] + gap, half[1] - 1, gap):
            window = [sign * (half[0] - 0.03), y, 1.55 * half[2]]
            b.rectangle(window, [-sign, 0, 0], UP, 0.45 * gap, 0.5 * half[2], lit)
            if rng.random() < 0.6:
                paint = b.material("painting", "poster", "cloth", metres=(1.5, 2.5))
                place = [sign * (half[0] - 0.04), y + 0.5 * gap, rng.uniform(1.3, 2.2)]
                b.rectangle(place, [-sign, 0, 0], UP, rng.uniform(0.8, 1.8), rng.uniform(0.8, 1.8), paint)
    for _ in range(int(rng.integers(2, 6))):  # banners from the ceiling
        spot = np.array([rng.uniform(-0.8, 0.8) * row, rng.uniform(-0.8, 0.8) * half[1], 1.55 * half[2]])
        paint = b.material("cloth", "wallpaper", "poster", metres=(1, 2))
        b.rectangle(spot, [rng.normal(0, 0.3), 1, 0], UP, rng.uniform(0.6, 1.2), 0.6 * half[2], paint, two_sided=True)
    for end_sign in (-1.0, 1.0):
        paint = b.material("panel", "facade", metres=(2, 4))
        b.rectangle([0, end_sign * (half[1] - 0.03), 1.4], [0, -end_sign, 0], UP, 3.0, 2.8, paint)
    furnish(b, np.array([0, 0, 1.2]), np.array([0.7 * row, 0.8 * half[1], 1.2]), int(rng.integers(5, 12)), 0.2)
    bounds = np.stack([centre - half, centre + half])
    focus = (centre - half * [0.9, 0.9, 0.8], centre + half * [0.9, 0.9, 0.3])
    scene = b.build("hall", bounds, 0.55 * float(half[0]), heading=None, focus=focus, height=(0.8, 2.2))
    bake(scene, rng, lamps=int(rng.integers(3, 6)), texel=0.8, exposure=0.85)
    return scene


def _facade(b: SceneBuilder, centre: Array, inward: Array, width: float, height: float) -> None:
    """Add one side of a yard: storeys of windows, a door, awnings or an arcade of pillars, an overhanging roof."""
    rng = b.rng
    along = np.cross(UP, inward)
    front = b.material("facade", metres=(3.5, 6))
    b.rectangle(centre + UP * height / 2, inward, UP, width, height, front)
    plinth = b.material("stone", "wall", metres=(1, 3))
    b.rectangle(centre + inward * 0.05 + UP * 0.45, inward, UP, width, 0.9, plinth)
    door = b.material("panel", metres=(1.2, 2.4))
    b.rectangle(centre + along * rng.uniform(-0.3, 0.3) * width + inward * 0.08 + UP * 1.15, inward, UP, 1.4, 2.3, door)
    roof = b.material("roof", metres=(1.5, 3))
    eaves, back = centre + UP * height + inward * 0.6, centre + UP * (height + 2.0) - inward * 2.5
    reach = along * width / 2
    b.polygon(np.stack([eaves - reach, eaves + reach, back + reach, back - reach]), roof, two_sided=True)
    if rng.random() < 0.5:  # arcade: pillars that carry a shelf
        stone = b.material("stone", "marble", metres=(1, 2))
        out, turned = 1.8, np.stack([along, -inward, UP], 1)
        for t in np.arange(-width / 2 + 1.2, width / 2 - 0.6, rng.uniform(2.2, 3.4)):
            frustum(b, centre + inward * out + along * t, (0.22, 0.18), 2.7, 6, stone, lid=False)
        b.box(centre + inward * out / 2 + UP * 2.85, [width / 2, out / 2 + 0.25, 0.15], turned, [stone])
    else:
        for _ in range(int(rng.integers(1, 4))):
            spot = centre + along * rng.uniform(-0.4, 0.4) * width + UP * rng.uniform(2.4, 0.8 * height)
            size = np.array([rng.uniform(0.6, 1.4), 0.4, 0.08])
            turned = np.stack([along, -inward, UP], 1)
            b.box(spot + inward * 0.4, size, turned, [b.material("cloth", "panel", metres=(0.5, 1.5))])


def courtyard(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Paved yard between four facades, with a fountain, trees, benches and lamp posts under a sky.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
    b = SceneBuilder(rng, pool)
    half = rng.uniform(8, 14, 2)
    above = sky(b, 400.0)
    paving = b.material("stone", "floor", metres=(2, 4))
    b.rectangle([0, 0, 0], UP, [0, 1, 0], 2 * half[0], 2 * half[1], paving)
    for axis in (0, 1):
        for sign in (-1.0, 1.0):
            inward = np.zeros(3)
            inward[axis] = -sign
            _facade(b, -inward * half[axis], inward, 2 * half[1 - axis], rng.uniform(5, 9))
    lawn = b.material("ground", "plant", metres=(2, 4))
    for sx in (-1.0, 1.0):  # beds with a kerb, one in each quarter
        for sy in (-1.0, 1.0):
            spot = np.array([sx * half[0] * 0.52, sy * half[1] * 0.52, 0.08])
            b.box(spot, [*(half * rng.uniform(0.16, 0.24, 2)), 0.08], np.eye(3), [paving, lawn, lawn], faces="xXyYZ")
            if rng.random() < 0.75:
                tree(b, spot + [*rng.normal(0, 0.4, 2), 0], size=rng.uniform(0.9, 1.5), cards=9)
            for _ in range(int(rng.integers(0, 4))):
                bush(b, spot + [*(rng.uniform(-1, 1, 2) * half * 0.13), 0.05], rng.uniform(0.3, 0.6))
    stone, water = b.material("marble", "stone", metres=(0.8, 2)), b.material("sky", metres=(1, 3), bright=0.8)
    middle, radius = np.append(rng.uniform(-0.15, 0.15, 2) * half, 0.0), rng.uniform(1.3, 2.2)
    frustum(b, middle, (radius, radius), 0.5, 10, stone, lid=False)  # basin, water, pillar, bowl, jet
    b.rectangle(middle + UP * 0.42, UP, [0, 1, 0], 1.9 * radius, 1.9 * radius, water)
    frustum(b, middle + UP * 0.4, (0.28, 0.18), 0.9, 6, stone, lid=False)
    frustum(b, middle + UP * 1.3, (0.2, 0.6 * radius), 0.3, 8, stone)
    frustum(b, middle + UP * 1.6, (0.15, 0.08), rng.uniform(0.5, 1.0), 6, stone)
    iron = b.material("plain", "panel", metres=(0.4, 1), bright=0.6)
    wood = b.material("floor", metres=(0.4, 1))
    for _ in range(int(rng.integers(3, 7))):  # benches
        turned = yaw(float(rng.integers(4)) * np.pi / 2)
        spot = np.append(rng.uniform(-0.8, 0.8, 2) * half, 0.0)
        if np.linalg.norm((spot - middle)[:2]) > 1.3 * radius:
            b.box(spot + UP * 0.42, [0.7, 0.2, 0.04], turned, [wood])
            b.box(spot + UP * 0.2, [0.6, 0.15, 0.2], turned, [iron], faces="xXyY")
            b.box(spot + turned[:, 1] * 0.2 + UP * 0.7, [0.7, 0.03, 0.2], turned, [wood])
    for sx in (-0.25, 0.25):
        for sy in (-0.8, 0.8):
            foot = np.array([sx * half[0], sy * half[1], 0.0])
            frustum(b, foot, (0.07, 0.05), 3.4, 5, iron)
            b.box(foot + UP * 3.55, [0.16, 0.16, 0.2], np.eye(3), [b.material("plain", bright=1.8)])
    inner = np.array([[-0.86, -0.86], [0.86, 0.86]]) * half
    bounds = np.concatenate([inner, [[0.4], [3.2]]], 1)
    focus = (np.append(-0.9 * half, 0.5), np.append(0.9 * half, 3.0))
    scene = b.build("courtyard", bounds, 0.5 * float(half.mean()), heading=None, focus=focus, height=(0.9, 2.2))
    bake(scene, rng, sun=True, glowing=np.array(above), texel=0.8, exposure=0.68)
    return scene


def gallery(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Row of rooms joined by doorways, with pictures on the walls, pedestals and benches.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
    b = SceneBuilder(rng, pool)
    rooms = int(rng.integers(2, 5))
    wide, height = rng.uniform(2.4, 4), rng.uniform(3, 4.2)
    lengths = rng.uniform(4.5, 7.5, rooms)
    ends = np.concatenate([[0], np.cumsum(lengths)]) - lengths.sum() / 2
    half = np.array([wide, lengths.sum() / 2, height / 2])
    centre = np.array([0, 0, half[2]])
    paint = b.material("wallpaper", "plain", "wall", metres=(1.5, 3))
    floor = b.material("floor", metres=(1, 2.5), bright=0.75)
    b.box(centre, half, np.eye(3), [paint, b.material("plain", metres=(2, 4), bright=1.3), floor], inside=True)
    trim = b.material("panel", "floor", "plain", metres=(0.5, 1.5))
    openings = []
    for y in ends[1:-1]:  # partitions with a doorway
        door, gap = rng.uniform(-0.35, 0.35) * wide, rng.uniform(0.6, 0.9)
        top = rng.uniform(2.1, 2.5)
        openings.append((y, door, gap))
        for x0, x1 in ((-wide, door - gap), (door + gap, wide)):
            size = [(x1 - x0) / 2, 0.1, height / 2]
            b.box([(x0 + x1) / 2, y, height / 2], size, np.eye(3), [paint], faces="xXyY")
        b.box([door, y, (top + height) / 2], [gap, 0.1, (height - top) / 2], np.eye(3), [paint], faces="yYz")
        for edge in (door - gap, door + gap):
            b.box([edge, y, top / 2], [0.06, 0.13, top / 2], np.eye(3), [trim], faces="xXyY")

    def hang(spot: Array, normal: Array, width: float, tall: float) -> None:
        """Add a framed picture."""
        b.rectangle(spot + 0.02 * normal, normal, UP, width + 0.12, tall + 0.12, trim)
        picture = b.material("painting", "painting", "photo", "poster", metres=(2, 3), contrast=(0.9, 1.2))
        b.rectangle(spot + 0.04 * normal, normal, UP, width, tall, picture)

    for k in range(rooms):
        low, high = ends[k], ends[k + 1]
        if rng.random() < 0.7:  # each room has a wall covering of its own
            cover = b.material("wallpaper", "plain", "cloth", "wall", metres=(1, 3))
            for sign in (-1.0, 1.0):
                middle = [sign * (wide - 0.01), (low + high) / 2, height / 2]
                b.rectangle(middle, [-sign, 0, 0], UP, high - low - 0.2, height, cover)
        for sign in (-1.0, 1.0):
            y = low + rng.uniform(0.7, 1.2)
            while y < high - 0.7:
                width, tall = rng.uniform(0.5, 1.5), rng.uniform(0.5, 1.3)
                y += width / 2
                if y + width / 2 < high - 0.3 and rng.random() < 0.9:
                    spot = np.array([sign * (wide - 0.02), y, rng.uniform(1.4, 1.7)])
                    hang(spot, np.array([-sign, 0.0, 0.0]), width, tall)
                y += width / 2 + rng.uniform(0.4, 1.0)
        for _ in range(int(rng.integers(1, 4))):  # pedestals with something on them
            foot = np.array([rng.uniform(-0.6, 0.6) * wide, rng.uniform(low + 1, high - 1), 0.0])
            tall = rng.uniform(0.7, 1.1)
            b.box(foot + UP * tall / 2, [0.2, 0.2, tall / 2], yaw(rng.uniform(0, 1)), [trim], faces="xXyYZ")
            stone = b.material("marble", "stone", "busy", metres=(0.3, 0.8))
            narrow = rng.uniform(0.08, 0.16)
            frustum(b, foot + UP * tall, (narrow, 1.4 * narrow), 0.25, 7, stone)
            frustum(b, foot + UP * (tall + 0.25), (0.9 * narrow, 0.4 * narrow), rng.uniform(0.15, 0.4), 7, stone)
        if rng.random() < 0.6:
            spot = np.array([rng.uniform(-0.3, 0.3) * wide, (low + high) / 2, 0.4])
            seat = [b.material("cloth", "floor", metres=(0.5, 1))]
            b.box(spot, [0.3, 0.8, 0.06], yaw(rng.normal(0, 0.1)), seat)
            b.box(spot - UP * 0.2, [0.2, 0.7, 0.2], np.eye(3), [trim], faces="xXyY")
    for sign, y in ((1.0, ends[0]), (-1.0, ends[-1])):
        hang(np.array([0, y + sign * 0.02, 1.6]), np.array([0, sign, 0.0]), 0.9 * wide, 1.6)
    for y, door, gap in openings:
        for sign in (-1.0, 1.0):
            room = (door - gap + wide, wide - door - gap)
            centre_x = (door - gap - wide) / 2 if room[0] > room[1] else (door + gap + wide) / 2
            hang(np.array([centre_x, y + sign * 0.1, 1.55]), np.array([0, sign, 0.0]), 0.45 * max(room), 1.0)
    bounds = np.stack([centre - half, centre + half])
    focus = (centre - half * [0.95, 0.9, 0.5], centre + half * [0.95, 0.9, 0.4])
    scene = b.build("gallery", bounds, 0.9 * wide, heading=None, focus=focus, height=(0.8, 2.1))
    bake(scene, rng, lamps=rooms + 1, texel=0.7, exposure=0.85)
    return scene
