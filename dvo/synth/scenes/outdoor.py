"""Outdoor families: street and clutter under a sky."""

from __future__ import annotations

import numpy as np

from dvo.synth.scenes.builder import SceneBuilder
from dvo.synth.scenes.furnishing import UP, WALLS, paint_object, scatter, yaw
from dvo.synth.scenes.lighting import bake
from dvo.synth.scenes.scene import Scene
from dvo.synth.scenes.vegetation import sky as sky_box
from dvo.synth.scenes.vegetation import tree
from dvo.synth.textures.texture import TexturePool

Array = np.ndarray


def _building(b: SceneBuilder, x: float, y: float, half: Array, sign: float) -> None:
    """Add a house that faces the street, with a shop front, awnings and balconies."""
    rng = b.rng
    front = (
        b.material("facade", "facade", "wall", "busy", metres=(4, 9))
        if rng.random() < 0.9
        else b.material(metres=(3, 8))
    )
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
        b.box(spot, size, np.eye(3), [paint_object(b, (1, 4), 0.4)], faces="xXyYzZ")


def _car(b: SceneBuilder, spot: Array, turned: Array) -> None:
    """Add a parked car."""
    rng = b.rng
    paint = b.material("plain", "panel", metres=(1.5, 4))
    half = np.array([rng.uniform(0.8, 0.95), rng.uniform(1.8, 2.4), 0.35])
    b.box(spot + [0, 0, 0.6], half, turned, [paint], faces="xXyYZ")
    glass = b.material("panel", "photo", "plain", metres=(1, 3), bright=0.5)
    b.box(spot + [0, 0, 1.2], half * [0.85, rng.uniform(0.45, 0.8), 0.8], turned, [glass, paint, paint], faces="xXyYZ")
    for sx in (-1, 1):
        for sy in (-1, 1):
            hub = turned @ np.array([sx * (half[0] + 0.01), sy * half[1] * 0.65, 0.3])
            b.rectangle(
                spot + hub, turned[:, 0] * sx, UP, 0.6, 0.6, b.material("busy", "plain", metres=(0.4, 0.8), bright=0.35)
            )


def street(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Road between houses, with pavements, markings, cars, poles, trees and sky; y is along the street.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
    b = SceneBuilder(rng, pool)
    length, road = rng.uniform(35, 60), rng.uniform(3, 7)
    kerb = rng.uniform(1.5, 5)
    sky = sky_box(b, 600.0)
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
                    tree(b, np.array([sign * (road + kerb + rng.uniform(0, 4)), y + rng.uniform(0, 2) * half[1], 0]))
            y += 2 * half[1] + (rng.uniform(0, 6) if rng.random() < 0.4 else 0.0)
        for y in np.arange(-length, length, rng.uniform(7, 16)):
            spot = np.array([sign * (road + rng.uniform(0.3, 1)), y + rng.uniform(-2, 2), 0.0])
            kind = rng.random()
            if kind < 0.35:
                tree(b, spot)
            elif kind < 0.6:
                b.prism(spot, rng.uniform(0.05, 0.15), rng.uniform(3, 7), 5, b.material("plain", "stone", bright=0.7))
                sign_paint = b.material("poster", "cloth", "photo", metres=(0.5, 1.5))
                b.rectangle(spot + [0, 0, 2.4], [0, -1, 0.01], UP, 0.8, 0.8, sign_paint, two_sided=True)
            elif kind < 0.85:
                _car(b, spot + [-sign * rng.uniform(1.2, 1.5), 0, 0], yaw(rng.normal(0, 0.03)))
            else:
                size = rng.uniform(0.2, 0.7, 3)
                b.box(
                    spot + [0, 0, size[2]],
                    size,
                    yaw(rng.uniform(0, 3)),
                    [paint_object(b, (0.5, 2), 0.3)],
                    faces="xXyYZ",
                )
    bounds = np.array([[-road * 0.6, -length * 0.95, 0.5], [road * 0.6, length * 0.95, 3.0]])
    scene = b.build("street", bounds, rng.uniform(7, 10), heading=np.array([0.0, 1.0, 0.0]), height=(1.0, 2.2))
    bake(scene, rng, sun=True, glowing=np.array(sky), texel=0.8)
    return scene


def clutter(rng: np.random.Generator, pool: TexturePool) -> Scene:
    """Ground, a few distant walls, and boxes, poles and boards at all depths under a sky.

    Args:
        rng: draws the layout.
        pool: textures.

    Returns:
        The scene, with baked light.
    """
    b = SceneBuilder(rng, pool)
    size = float(np.exp(rng.uniform(np.log(3), np.log(14))))
    sky = sky_box(b, 40 * size)
    b.rectangle(
        [0, 0, 0],
        UP,
        [0, 1, 0],
        30 * size,
        30 * size,
        b.material("ground", "stone", "road", "floor", metres=(0.3 * size, size)),
    )
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
            b.box(
                spot,
                half,
                yaw(rng.uniform(0, np.pi)),
                [paint_object(b, (float(half.min()), float(3 * half.max())), 0.2)],
                faces="xXyYZ",
            )
        elif kind < 0.8:
            b.prism(
                spot * [1, 1, 0],
                0.05 * size * rng.uniform(0.3, 1.5),
                size * rng.uniform(0.2, 1),
                7,
                paint_object(b, (0.2, 1), 0.3),
            )
        elif size > 6:
            tree(b, spot * [1, 1, 0])
    low, high = np.array([-1, -1, 0.1]) * size, np.array([1, 1, 0.9]) * size
    scatter(b, low, high, int(rng.integers(2, 14)), 0.08 * size)
    bounds = np.array([[-1.1, -1.1, 0.06], [1.1, 1.1, 0.8]]) * size
    scene = b.build("clutter", bounds, size * 0.7, heading=None, focus=(low * 0.6, high * 0.6))
    bake(scene, rng, sun=True, glowing=np.array(sky), texel=0.6)
    return scene
