"""Furnishing shared by families: materials of objects, pictures on walls, furniture, free-floating objects."""

from __future__ import annotations

import numpy as np

from dvo.geometry.poses import so3_exp
from dvo.synth.scenes.builder import Material, SceneBuilder

Array = np.ndarray
UP = np.array([0.0, 0.0, 1.0])
WALLS = ("wall", "plain", "stone", "cloth")
OBJECTS = ("busy", "photo", "poster", "panel", "cloth", "floor", "stone", "wall")


def yaw(angle: float) -> Array:
    """Rotation about the vertical.

    Args:
        angle: rad.

    Returns:
        ``(3, 3)``.
    """
    return so3_exp(np.array([0.0, 0.0, angle]))


def any_rotation(rng: np.random.Generator) -> Array:
    """Random rotation.

    Args:
        rng: draws it.

    Returns:
        ``(3, 3)``.
    """
    return so3_exp(rng.normal(size=3) * 1.5)


def paint_object(b: SceneBuilder, metres: tuple[float, float], bland: float) -> Material:
    """Draw the material of an object.

    Args:
        b: supplies textures and random numbers.
        metres: range of the width of one texture repeat.
        bland: probability of a nearly textureless material.

    Returns:
        The material.
    """
    if b.rng.random() < bland:
        return b.material("plain", metres=metres, contrast=(0.5, 1.5))
    return b.material(*OBJECTS, metres=metres) if b.rng.random() < 0.8 else b.material(metres=metres)


def decorate(b: SceneBuilder, centre: Array, half: Array, count: int, bland: float) -> None:
    """Add pictures, posters, doors and shelves to the four walls of a box room, slightly in front of the walls.

    Args:
        b: collects the surfaces.
        centre, half: ``(3,)`` centre and half sizes of the room, metres.
        count: number of objects.
        bland: probability of a nearly textureless material.
    """
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
        paint = paint_object(b, (0.5 * width + 0.1, 1.5 * width + 0.2), bland)
        b.rectangle(spot, normal, UP, width, height, paint)


def furnish(b: SceneBuilder, centre: Array, half: Array, count: int, bland: float) -> None:
    """Add furniture: boxes on the floor, some with smaller ones on top, and columns.

    Args:
        b: collects the surfaces.
        centre, half: ``(3,)`` centre and half sizes of the room, metres.
        count: number of objects.
        bland: probability of a nearly textureless material.
    """
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
        paints = [paint_object(b, (0.3, 1.5), bland) for _ in range(int(rng.choice([1, 3])))]
        if rng.random() < 0.12:
            b.prism(spot - [0, 0, size[2]], size[0] * 0.5, size[2] * 2, int(rng.integers(6, 11)), paints[0])
            continue
        b.box(spot, size, turned, paints, faces="xXyYZ")
        for _ in range(int(rng.integers(0, 3))):  # things on top
            little = size * rng.uniform(0.1, 0.45, 3)
            place = turned @ (rng.uniform(-0.5, 0.5, 3) * size)
            place[2] = size[2] + little[2]
            b.box(
                spot + place, little, turned @ yaw(rng.uniform(0, 3)), [paint_object(b, (0.1, 0.8), 0.2)], faces="xXyYZ"
            )


def scatter(b: SceneBuilder, low: Array, high: Array, count: int, size: float, *, quads: float = 0.4) -> None:
    """Add free-floating boxes and tilted boards.

    Args:
        b: collects the surfaces.
        low, high: ``(3,)`` corners of the box that contains their centres.
        count: number of objects.
        size: median half size, metres.
        quads: probability of a board instead of a box.
    """
    rng = b.rng
    for _ in range(count):
        spot, rotation = rng.uniform(low, high), any_rotation(rng)
        edge = size * np.exp(rng.normal(0, 0.5, 3))
        paint = paint_object(b, (float(edge.min()), float(edge.max() * 3)), 0.15)
        if rng.random() < quads:
            b.rectangle(spot, rotation[:, 2], rotation[:, 1], 2 * edge[0], 2 * edge[1], paint, two_sided=True)
        else:
            b.box(spot, edge, rotation, [paint])
