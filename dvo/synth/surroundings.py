"""What ordinary footage shows beside a rigid scene: water, clouds, leaves, people, a bonnet, rain on the lens.

Each is drawn over a rendered image, by its depth and pose, and has a motion of its own or none: the pixels that it
covers have no rigid truth, as those of moving bodies. Everything is a function of seed and time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from dvo.errors import DvoError
from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.settings import shown
from dvo.synth import salts

Array = np.ndarray


@dataclass(frozen=True)
class Canvas:
    """Frame to draw over.

    Attributes:
        image: ``(H, W, 3)`` float RGB in [0, 1]; changed in place.
        depth: ``(H, W)`` along the optical axis, metres; inf where nothing is.
        pose_wc: ``(7,)`` camera to world, z up.
        camera: intrinsics.
        time: seconds.
    """

    image: Array
    depth: Array
    pose_wc: Array
    camera: Camera
    time: float

    def rays(self) -> Array:
        """``(H, W, 3)`` rays of the pixel centres in the world, of depth one."""
        height, width = self.depth.shape
        y, x = np.mgrid[0:height, 0:width]
        camera = self.camera
        rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones((height, width))], -1)
        return rays @ self.rotation.T

    @property
    def rotation(self) -> Array:
        """``(3, 3)`` camera to world."""
        return np.asarray(se3.matrix(torch.from_numpy(np.asarray(self.pose_wc, np.float64))))[:3, :3]


Drawing = Callable[[Canvas], Array]
"""Draws over an image, and gives the pixels ``(H, W)`` bool that it covers."""


def noise(rng: np.random.Generator, size: int, rows: tuple[int, ...]) -> Array:
    """``(size, size)`` float smooth noise that repeats, in [0, 1]: means of levels with these numbers of cells.

    Args:
        rng: of the levels.
        size: pixels.
        rows: cells of each level along a side.
    """
    total = np.zeros((size, size), np.float32)
    for cells in rows:
        level = np.pad(rng.random((cells, cells)).astype(np.float32), 2, mode="wrap")
        step = size // cells
        large = cv2.resize(level, (step * (cells + 4),) * 2, interpolation=cv2.INTER_CUBIC)
        total += cv2.resize(large[2 * step : -2 * step, 2 * step : -2 * step], (size, size)) / len(rows)
    return total.clip(0, 1)


def lookup(texture: Array, x: Array, y: Array) -> Array:
    """Values of a texture that repeats with period one, between its pixels."""
    size = len(texture)
    wrapped = np.pad(texture, ((0, 1), (0, 1)), mode="wrap")
    u, v = (((value % 1.0) * size).astype(np.float32) for value in (x, y))
    return cv2.remap(wrapped, u, v, cv2.INTER_LINEAR)


def water(rng: np.random.Generator, _: Array) -> Drawing:
    """A sea that covers the ground: waves that travel, foam, glitter."""
    level = rng.uniform(0.25, 0.45)
    waves = [
        rng.uniform([-9, -9, 1, 0], [9, 9, 4, 6.3]) for _ in range(12)
    ]
    foam, colour = noise(rng, 512, (16, 64, 128)), rng.uniform([0.05, 0.2, 0.25], [0.2, 0.4, 0.5])
    drift = rng.normal(0, 0.12, 2)

    def draw(canvas: Canvas) -> Array:
        rays, height = canvas.rays(), canvas.pose_wc[2] - level
        down = np.where(rays[..., 2] < -1e-4, rays[..., 2], np.inf)
        distance = -height / down
        covered = (distance > 0) & (distance < canvas.depth)
        x = canvas.pose_wc[0] + distance * rays[..., 0]
        y = canvas.pose_wc[1] + distance * rays[..., 1]
        slope = sum(np.sin(a * x + b * y + c * canvas.time + d) for a, b, c, d in waves) / np.sqrt(len(waves))
        white = lookup(foam, (x + drift[0] * canvas.time) / 6, (y + drift[1] * canvas.time) / 6) + 0.06 * slope
        bright = 0.10 * slope[..., None] + 0.5 * np.clip((white[..., None] - 0.55) * 8, 0, 1)
        bright = bright + 0.6 * (slope[..., None] > 1.7)
        canvas.image[covered] = (colour + bright)[covered].clip(0, 1)
        return covered

    return draw


def sky(rng: np.random.Generator, _: Array) -> Drawing:
    """Clouds that drift, over all that is far or above the horizon: two thirds of what a drone sees."""
    clouds, speed, nearest = noise(rng, 512, (4, 8, 16, 32)), rng.normal(0, 0.02, 2), rng.uniform(3.0, 5.0)

    def draw(canvas: Canvas) -> Array:
        rays = canvas.rays()
        above = rays[..., 2] / np.linalg.norm(rays, axis=-1)
        covered = (above > 0.02) & (canvas.depth > nearest)
        high = 1 / np.maximum(above, 0.02)
        x = rays[..., 0] / np.linalg.norm(rays, axis=-1) * high * 0.05 + speed[0] * canvas.time
        y = rays[..., 1] / np.linalg.norm(rays, axis=-1) * high * 0.05 + speed[1] * canvas.time
        white = ((lookup(clouds, x, y) - 0.4) * 3).clip(0, 1)[..., None]
        colours = (1 - white) * np.array([0.35, 0.55, 0.85]) + white * 0.95
        canvas.image[covered] = colours[covered]
        return covered

    return draw


def _sprites(
    rng: np.random.Generator, count: int, sizes: tuple[float, float], tall: float, move: Callable[[float], Array],
    places: Array,
) -> Drawing:  # fmt: skip
    """Textured ellipses that face the camera, at places ``(count, 3)`` that move."""
    textures = [noise(rng, 64, (4, 16)) for _ in range(count)]
    colours, radii = rng.uniform(0.1, 0.9, (count, 2, 3)), rng.uniform(sizes[0], sizes[1], count)

    def draw(canvas: Canvas) -> Array:
        seen = (places + move(canvas.time) - canvas.pose_wc[:3]) @ canvas.rotation
        covered = np.zeros(canvas.depth.shape, bool)
        height, width = canvas.depth.shape
        for k in np.argsort(-seen[:, 2]):
            x, y, z = seen[k]
            if z < 0.4:
                continue
            centre = np.array([x, y]) / z * [canvas.camera.fx, canvas.camera.fy] + [canvas.camera.cx, canvas.camera.cy]
            half = radii[k] / z * canvas.camera.fx * np.array([1.0, tall])
            low, high = np.maximum(np.floor(centre - half), 0).astype(int), np.ceil(centre + half).astype(int)
            if not (low < [width, height]).all() or not (high > low).all():
                continue
            v, u = np.mgrid[low[1] : min(high[1], height), low[0] : min(high[0], width)]
            if not v.size:
                continue
            a, b = (u - centre[0]) / half[0], (v - centre[1]) / half[1]
            inside = (a * a + b * b < 1) & (canvas.depth[v, u] > z)
            share = lookup(textures[k], (a + 1) / 2.001, (b + 1) / 2.001)[..., None]
            part = (1 - share) * colours[k, 0] + share * colours[k, 1]
            canvas.image[v[inside], u[inside]] = part[inside]
            covered[v[inside], u[inside]] = True
        return covered

    return draw


def foliage(rng: np.random.Generator, centre: Array) -> Drawing:
    """Leaves and twigs around the way of the camera that sway in the wind."""
    count = 1500
    places = centre + rng.uniform([-6, -6, -1.2], [6, 6, 1.8], (count, 3))
    reach, rate, phase = (
        rng.uniform(0.05, 0.3, (count, 3)),
        rng.uniform(1.5, 6.0, (count, 1)),
        rng.uniform(0, 6.3, (count, 3)),
    )
    return _sprites(rng, count, (0.06, 0.2), 0.7, lambda time: reach * np.sin(rate * time + phase), places)


def crowd(rng: np.random.Generator, centre: Array) -> Drawing:
    """People who walk past around the way of the camera, some of them near."""
    count = 90
    places = np.column_stack([rng.uniform(-6, 6, (count, 2)), rng.uniform(-0.5, -0.1, count)]) + centre
    way = rng.uniform(0, 6.3, count)
    speed = rng.uniform(0.5, 1.6, count)[:, None] * np.column_stack([np.cos(way), np.sin(way), np.zeros(count)])

    def move(time: float) -> Array:
        here = places[:, :2] - centre[:2]
        there = (here + speed[:, :2] * time + 6) % 12 - 6  # who leaves comes back on the other side
        return np.column_stack([there - here, np.zeros(count)])

    return _sprites(rng, count, (0.25, 0.4), 2.6, move, places)


def bonnet(rng: np.random.Generator, _: Array) -> Drawing:
    """Bonnet with reflections, a dashboard's edge, a dark corner and a clock: fixed to the camera."""
    share, curve, colour = rng.uniform(0.35, 0.5), rng.uniform(0.05, 0.25), rng.uniform(0.1, 0.6, 3)
    gloss, scroll = noise(rng, 256, (4, 8)), rng.uniform(0.02, 0.1)
    texture, word = noise(rng, 256, (8, 32)), f"{rng.integers(10, 24)}:{rng.integers(10, 60)}"
    corner = rng.integers(0, 2)

    def draw(canvas: Canvas) -> Array:
        height, width = canvas.depth.shape
        y, x = np.mgrid[0:height, 0:width]
        u, v = x / width, y / height
        covered = v > 1 - share + curve * (2 * u - 1) ** 2
        reflected = lookup(gloss, u, v + scroll * canvas.time) * 0.3 + 0.35 * lookup(texture, u * 2, v * 2)
        canvas.image[covered] = (colour * 0.6 + reflected[..., None] * 0.6)[covered].clip(0, 1)
        dark = (u if corner else 1 - u) + v < 0.35
        canvas.image[dark] *= 0.15
        letters = np.zeros((height, width), np.uint8)
        size = height / 240
        cv2.putText(letters, word, (int(0.68 * width), int(0.12 * height)), cv2.FONT_HERSHEY_SIMPLEX, size, 255, 2)
        canvas.image[letters > 0] = 1.0
        return covered | dark | (letters > 0)

    return draw


def rain(rng: np.random.Generator, _: Array) -> Drawing:
    """Drops on the lens that stay for seconds, some that run down, and streaks in the air."""
    count, seed = 90, int(rng.integers(2**31))
    places, radii, born = rng.random((count, 2)), rng.uniform(0.015, 0.06, count), rng.uniform(-6, 30, count)
    runs = (rng.random(count) < 0.2) * rng.uniform(0.02, 0.2, count)

    def draw(canvas: Canvas) -> Array:
        height, width = canvas.depth.shape
        covered = np.zeros((height, width), bool)
        blurred = cv2.GaussianBlur(canvas.image, (0, 0), width / 40)
        y, x = np.mgrid[0:height, 0:width]
        for k in range(count):
            age = canvas.time - born[k]
            if not 0 <= age < 8:
                continue
            centre = places[k] * [width, height] + [0, runs[k] * age * height]
            a, b = (x - centre[0]) / (radii[k] * width), (y - centre[1]) / (radii[k] * width)
            inside = a * a + b * b < 1
            edge = (0.25 * b - 0.35 * (a * a + b * b > 0.7))[..., None]  # refracted upside down, with a dark rim
            canvas.image[inside] = (blurred[::-1] + edge)[inside].clip(0, 1)
            covered |= inside
        drops = np.random.default_rng([seed, round(canvas.time * 1e4)])
        streaks = np.zeros((height, width), np.uint8)
        for _ in range(60):
            at = drops.integers(0, [width, height])
            end = at + [int(drops.integers(-3, 4)), int(drops.integers(height // 20, height // 6))]
            cv2.line(streaks, at.tolist(), end.tolist(), 255, 1)
        canvas.image[streaks > 0] = 0.6 * canvas.image[streaks > 0] + 0.35
        return covered | (streaks > 0)

    return draw


SURROUNDINGS: dict[str, Callable[[np.random.Generator, Array], Drawing]] = {
    "water": water, "sky": sky, "foliage": foliage, "crowd": crowd, "bonnet": bonnet, "rain": rain,
}  # fmt: skip
"""Drawings by name, of a random stream and the middle of the way of the camera ``(3,)``."""


def check_surroundings(names: str) -> None:
    """Reject names that are not known.

    Args:
        names: joined by ``+``.

    Raises:
        DvoError: an unknown name, or not a text.
    """
    for name in names.split("+") if isinstance(names, str) and names else [names] if names != "" else []:
        if name not in SURROUNDINGS:
            known = ", ".join(SURROUNDINGS)
            raise DvoError(f"no surroundings {shown(name)}", field="surroundings", remedy=f"use {known}, joined by +")


def drawings(names: str, seed: int, centre: Array) -> tuple[Drawing, ...]:
    """Drawings of names.

    Args:
        names: joined by ``+``, see :func:`check_surroundings`.
        seed: same seed, same picture at every time.
        centre: ``(3,)`` middle of the way of the camera.
    """
    return tuple(
        SURROUNDINGS[name](np.random.default_rng([seed, salts.SURROUNDINGS, number]), centre)
        for number, name in enumerate(filter(None, names.split("+")))
    )
