"""Outdoor objects: trees of leaf cards, conifers, bushes, rocks, and the sky box."""

from __future__ import annotations

import numpy as np

from dvo.synth.scenes.builder import Material, SceneBuilder
from dvo.synth.scenes.furnishing import UP, any_rotation

Array = np.ndarray


def sky(b: SceneBuilder, radius: float) -> list[int]:
    """Add a distant box of sky.

    Args:
        b: collects the surfaces.
        radius: half its size, metres.

    Returns:
        Rows of its surfaces, which are lit from within (``glowing`` of :func:`dvo.synth.scenes.lighting.bake`).
    """
    first = len(b.rows)
    drawn = b.material("sky", metres=(radius * 1.5, radius * 3), contrast=(0.3, 1.1), bright=1.3)
    # A tint of its own would make the sky pink or green.
    level = drawn.gain / drawn.gain.mean()
    paint = Material(drawn.texture, drawn.metres, drawn.gain / level, drawn.offset / level)
    b.box([0, 0, 0], [radius, radius, radius], np.eye(3), [paint], inside=True, faces="xXyYZ")
    return list(range(first, len(b.rows)))


def frustum(
    b: SceneBuilder, foot: Array, radii: tuple[float, float], height: float, sides: int, material: Material,
    *, lid: bool = True, solid: bool = True, stretch: tuple[float, float] = (1.0, 1.0),
) -> None:  # fmt: skip
    """Add an upright column that narrows towards the top.

    Args:
        b: collects the surfaces.
        foot: ``(3,)`` centre of its base.
        radii: at the base and at the top, 0 at the top for a cone.
        height: from base to top.
        sides: number of faces.
        material: of all faces.
        lid: close the top.
        solid: keep cameras out.
        stretch: factors on x and y, for an oval.
    """
    radius, top = radii
    turn = b.rng.uniform(0, 2)
    angle = np.arange(sides) * 2 * np.pi / sides + turn
    ring = np.stack([np.cos(angle) * stretch[0], np.sin(angle) * stretch[1], np.zeros(sides)], -1)
    low, high = foot + radius * ring, foot + top * ring + [0, 0, height]
    for i in range(sides):
        j = (i + 1) % sides
        corners = [low[i], low[j], high[j], high[i]] if top > 0 else [low[i], low[j], high[i]]
        b.polygon(np.stack(corners), material)
    if lid and top > 0:
        for i in range(1, sides - 1, 2):  # a fan of quadrilaterals
            b.polygon(high[[0, i, i + 1, min(i + 2, sides - 1)]][: 4 if i + 2 < sides else 3], material)
    if solid:
        half = np.array([max(radius, top) * stretch[0], max(radius, top) * stretch[1], height / 2])
        b.solids.append(np.concatenate([foot + UP * height / 2, half, np.eye(3).ravel()]))


def leaf_card(b: SceneBuilder, centre: Array, normal: Array, size: float, paint: Material) -> None:
    """Add an irregular two-sided quadrilateral.

    Args:
        b: collects the surfaces.
        centre: ``(3,)``.
        normal: ``(3,)`` direction that it roughly faces.
        size: half its diagonal, metres.
        paint: material.
    """
    rng = b.rng
    rotation = any_rotation(rng)
    front = normal + 0.5 * rng.normal(size=3)
    front /= np.linalg.norm(front)
    across = np.cross(front, rotation[:, 0])
    across /= np.linalg.norm(across)
    angle = np.arange(4) * np.pi / 2 + rng.uniform(-0.35, 0.35, 4)
    reach = size * rng.uniform(0.7, 1.1)
    ring = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(front, across)
    b.polygon(centre + reach * ring, paint, two_sided=True)


def tree(b: SceneBuilder, spot: Array, *, size: float = 1.0, cards: int = 8) -> None:
    """Add a tree: a trunk and a crown of leaf cards on an ellipsoid, facing outwards, darker below.

    Args:
        b: collects the surfaces.
        spot: ``(3,)`` foot of the trunk.
        size: factor on a tree of a few metres.
        cards: number of leaf cards.
    """
    rng = b.rng
    trunk, crown = size * rng.uniform(1.4, 3), size * rng.uniform(0.9, 2.0)
    radius = size * rng.uniform(0.09, 0.22)
    bark = b.material("bark", metres=(0.6, 1.5), bright=0.75)
    frustum(b, spot, (radius, 0.55 * radius), trunk + 0.7 * crown, 5, bark, lid=False)
    light = b.material("plant", metres=(0.8, 2.5))
    dark = Material(light.texture, light.metres, 0.7 * light.gain, 0.7 * light.offset)
    middle = spot + UP * (trunk + 0.75 * crown)
    golden = np.pi * (3 - np.sqrt(5))
    for i in range(cards):  # evenly over the egg, so that no side is bare
        height = 1 - 2 * (i + 0.5) / cards
        turn = golden * i + rng.normal(0, 0.3)
        out = np.array([np.cos(turn) * np.sqrt(1 - height**2), np.sin(turn) * np.sqrt(1 - height**2), height])
        centre = middle + crown * out * [0.6, 0.6, 0.75] * rng.uniform(0.75, 1.1)
        leaf_card(b, centre, out, crown * rng.uniform(0.6, 0.85), dark if height < -0.2 else light)


def conifer(b: SceneBuilder, spot: Array, *, size: float = 1.0) -> None:
    """Add a conifer: stacked cones on a short trunk.

    Args:
        b: collects the surfaces.
        spot: ``(3,)`` foot of the trunk.
        size: factor on a tree of a few metres.
    """
    rng = b.rng
    height, radius = size * rng.uniform(3, 6), size * rng.uniform(0.8, 1.3)
    bark = b.material("bark", metres=(0.5, 1.2), bright=0.6)
    frustum(b, spot, (0.12 * radius, 0.12 * radius), 0.25 * height, 4, bark, lid=False)
    paint = b.material("plant", metres=(0.8, 2), bright=0.75)
    tiers = 3
    for i in range(tiers):
        foot = spot + UP * height * (0.18 + 0.25 * i)
        tier = radius * (1 - 0.26 * i)
        frustum(b, foot, (tier, 0.0), 0.38 * height, 6, paint, solid=i == 0)


def rock(b: SceneBuilder, spot: Array, size: float, paint: Material) -> None:
    """Add a boulder: two stacked frustums, sunk slightly into the ground.

    Args:
        b: collects the surfaces.
        spot: ``(3,)`` point of the ground.
        size: radius, metres.
        paint: material.
    """
    rng = b.rng
    sides = int(rng.integers(5, 8))
    oval = (float(rng.uniform(0.7, 1.3)), float(rng.uniform(0.7, 1.3)))
    height = size * rng.uniform(0.5, 1.0)
    foot = spot - UP * 0.15 * size
    turn = b.rng.bit_generator.state  # both parts must be turned alike to meet
    frustum(b, foot, (size, 0.85 * size), 0.6 * height, sides, paint, lid=False, stretch=oval)
    b.rng.bit_generator.state = turn
    frustum(b, foot + UP * 0.6 * height, (0.85 * size, 0.4 * size), 0.4 * height, sides, paint, stretch=oval)


def bush(b: SceneBuilder, spot: Array, size: float) -> None:
    """Add a bush: a few leaf cards near the ground.

    Args:
        b: collects the surfaces.
        spot: ``(3,)`` point of the ground.
        size: metres.
    """
    paint = b.material("plant", metres=(0.6, 2), bright=0.9)
    for i in range(4):
        turn = i * np.pi / 2 + b.rng.uniform(-0.5, 0.5)
        out = np.array([np.cos(turn), np.sin(turn), 0.5])
        leaf_card(b, spot + size * (0.45 * out + [0, 0, 0.25]), out, 0.7 * size, paint)
