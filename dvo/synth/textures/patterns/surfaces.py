"""Patterns of materials: stone, plaster, bricks, tiles, wood, bark, grass, asphalt, roofs, sky.

Each function takes a generator and the edge length S in texels, and returns ``(S, S, 3)`` float32 RGB in [0, 1].
"""

from __future__ import annotations

import cv2
import numpy as np

from dvo.synth.textures.patterns.base import Rng, colour, grain, noise, shade


def fractal(rng: Rng, size: int) -> np.ndarray:
    """Fractal noise of a few colours: stone."""
    field = noise(rng, size, rng.uniform(0.7, 2.4), np.exp(rng.normal(0, 0.3)))
    ranked = np.clip(0.5 + field * rng.uniform(0.15, 0.4), 0, 1)
    base = colour(rng)
    colours = [np.clip(base * k + rng.normal(0, 0.06, 3), 0, 1) for k in np.linspace(0.4, 1.5, int(rng.integers(2, 5)))]
    return shade(ranked, colours)


def stains(rng: Rng, size: int) -> np.ndarray:
    """Thresholded blobs at several scales: plaster, camouflage, worn paint."""
    image: np.ndarray = np.broadcast_to(colour(rng, low=0.3), (size, size, 3)).astype(np.float32)
    for _ in range(int(rng.integers(2, 6))):
        field = noise(rng, size, rng.uniform(1.2, 2.6))
        edge = 0.5 + 0.5 * np.tanh((field - rng.normal(0.4, 0.6)) * rng.uniform(1.5, 20))
        image = image + edge[..., None] * rng.uniform(0.3, 1) * (colour(rng) - image)
    return grain(rng, image, rng.uniform(0.02, 0.12))


def plain(rng: Rng, size: int) -> np.ndarray:
    """Nearly textureless: painted wall with a faint mottle."""
    image: np.ndarray = np.broadcast_to(colour(rng, 0.2, 0.4, 0.95), (size, size, 3)).astype(np.float32)
    image = image * (1 + rng.uniform(0.005, 0.05) * noise(rng, size, rng.uniform(1.5, 2.5))[..., None])
    return grain(rng, image, rng.uniform(0.003, 0.03))


def cells(rng: Rng, size: int) -> np.ndarray:
    """Voronoi cells with joints: cobbles, flagstones, gravel."""
    across = int(np.exp(rng.uniform(np.log(4), np.log(17))))
    y, x = np.mgrid[:size, :size].astype(np.float32) / size * across
    seeds = rng.uniform(0.0, 1.0, (across, across, 2)).astype(np.float32)
    row, column = np.floor(y).astype(int), np.floor(x).astype(int)
    first, second = np.full(x.shape, 9.0, np.float32), np.full(x.shape, 9.0, np.float32)
    owner = np.zeros(x.shape, int)
    for i in (-1, 0, 1):  # one seed a grid square: the two nearest lie in the squares around (nearly always)
        for j in (-1, 0, 1):
            r, c = (row + i) % across, (column + j) % across
            away = np.hypot(row + i + seeds[r, c, 0] - y, column + j + seeds[r, c, 1] - x)
            nearer = away < first
            second = np.where(nearer, first, np.minimum(second, away))
            first = np.where(nearer, away, first)
            owner = np.where(nearer, r * across + c, owner)
    gap = (second - first) * size / across
    count = across * across
    base, joint = colour(rng, low=0.25), colour(rng, 0.2, 0.05, 0.5)
    tint = np.clip(
        base * np.exp(rng.normal(0, rng.uniform(0.05, 0.35), (count, 1)) + rng.normal(0, 0.05, (count, 3))), 0, 1
    )
    image = tint[owner]
    solid = np.clip(gap / rng.uniform(1.5, 8), 0, 1)[..., None]
    return grain(rng, joint + solid * (image - joint), rng.uniform(0.05, 0.2))


def bricks(rng: Rng, size: int) -> np.ndarray:
    """Rows of bricks with mortar."""
    rows = int(rng.integers(5, 16))
    per_row = max(2, int(rows / rng.uniform(1.5, 3.5)))
    base, mortar = colour(rng, 0.5, 0.25, 0.75), colour(rng, 0.1, 0.3, 0.85)
    y, x = np.mgrid[:size, :size] / size
    row = np.floor(y * rows).astype(int)
    shifted = x * per_row + (row % 2) * 0.5
    column = np.floor(shifted).astype(int) % per_row
    jitter = np.exp(
        rng.normal(0, rng.uniform(0.04, 0.22), (rows, per_row, 1)) + rng.normal(0, 0.04, (rows, per_row, 3))
    )
    image = np.clip(base * jitter, 0, 1)[row, column]
    width = rng.uniform(0.03, 0.09)
    fy, fx = y * rows % 1, shifted % 1
    edge = np.minimum(np.minimum(fy, 1 - fy), np.minimum(fx, 1 - fx) * rows / per_row)
    solid = np.clip((edge - width) / 0.04 + 0.5, 0, 1)[..., None]
    return grain(rng, mortar + solid * (image - mortar), rng.uniform(0.04, 0.15))


def tiles(rng: Rng, size: int) -> np.ndarray:
    """Square tiles or a checkerboard, with joints and dirt."""
    count = int(rng.integers(2, 7)) * 2
    y, x = np.mgrid[:size, :size] / size * count
    iy, ix = np.floor(y).astype(int), np.floor(x).astype(int)
    first, second = colour(rng, low=0.3), colour(rng)
    check = rng.random() < 0.5
    palette = np.where(((iy + ix) % 2 == 0)[..., None], first, second if check else first)
    image = palette * np.exp(rng.normal(0, rng.uniform(0.02, 0.12), (count, count, 1)))[iy, ix]
    edge = np.minimum(np.minimum(y % 1, 1 - y % 1), np.minimum(x % 1, 1 - x % 1))
    solid = np.clip((edge - rng.uniform(0.01, 0.05)) / 0.03 + 0.5, 0, 1)[..., None]
    joint = colour(rng, 0.1, 0.1, 0.8)
    return grain(rng, np.clip(joint + solid * (image - joint), 0, 1), rng.uniform(0.01, 0.1))


def wood(rng: Rng, size: int) -> np.ndarray:
    """Planks with grain along y."""
    planks = int(rng.integers(1, 9))
    base = colour(rng, 0.3, 0.3, 0.8) * np.array([1.1, 0.9, 0.7])
    x = np.arange(size) / size * planks
    board = np.floor(x).astype(int)
    rings = noise(rng, size, 1.3, rng.uniform(0.15, 0.35)) * rng.uniform(0.05, 0.2)
    image = base * np.exp(rng.normal(0, 0.18, (planks, 1)))[board][None] * (1 + rings)[..., None]
    gap = np.clip(np.minimum(x % 1, 1 - x % 1) / 0.025, 0.3, 1)
    return grain(rng, np.clip(image * gap[None, :, None], 0, 1), 0.04)


def grass(rng: Rng, size: int) -> np.ndarray:
    """Blades of grass."""
    field = noise(rng, size, rng.uniform(0.6, 1.1), rng.uniform(0.6, 1)) * 0.25 + noise(rng, size, 2) * 0.12 + 0.5
    base = np.array([rng.uniform(0.25, 0.5), rng.uniform(0.35, 0.6), rng.uniform(0.1, 0.25)])
    return shade(np.clip(field, 0, 1), [base * 0.35, base, np.clip(base * 1.6, 0, 1)])


def asphalt(rng: Rng, size: int) -> np.ndarray:
    """Road: fine aggregate, patches, cracks."""
    base = colour(rng, 0.06, 0.22, 0.5)
    field = noise(rng, size, rng.uniform(0.2, 0.7)) * rng.uniform(0.04, 0.14) + noise(rng, size, 1.9) * rng.uniform(
        0.03, 0.12
    )
    image = np.clip(base * (1 + field[..., None]), 0, 1).astype(np.float32)
    for _ in range(int(rng.integers(0, 7))):
        walk = rng.uniform(0, size, 2) + np.cumsum(rng.normal(rng.normal(0, 4, 2), 5, (40, 2)), 0)
        cv2.polylines(image, [walk.astype(np.int32)], False, (base * rng.uniform(0.4, 0.8)).tolist(), 1, cv2.LINE_AA)
    for _ in range(int(rng.integers(0, 3))):
        x, y, w, h = rng.uniform(0, size, 4) * np.array([1, 1, 0.5, 0.5])
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), (base * rng.uniform(0.7, 1.2)).tolist(), -1)
    return grain(rng, image, 0.04)


def clouds(rng: Rng, size: int) -> np.ndarray:
    """Sky with clouds."""
    field = np.clip(0.5 + noise(rng, size, rng.uniform(1.6, 2.4), 1.3) * rng.uniform(0.1, 0.35), 0, 1)
    sky = np.array([rng.uniform(0.4, 0.75), rng.uniform(0.6, 0.8), rng.uniform(0.8, 0.98)])
    grey = rng.uniform(0.0, 1.0)
    sky = sky + grey * (sky.mean() - sky)
    return shade(field, [sky, sky, np.array([0.95, 0.95, 0.96])])


def bark(rng: Rng, size: int) -> np.ndarray:
    """Furrows along a trunk."""
    furrows = noise(rng, size, rng.uniform(1.0, 1.5), rng.uniform(2.2, 4.0))
    depth = np.clip(np.abs(furrows) * rng.uniform(0.6, 1.1), 0, 1)
    base = colour(rng, 0.2, 0.3, 0.65) * np.array([1.1, 0.95, 0.8])
    image = shade(depth, [base * 0.3, base * 0.8, np.clip(base * 1.25, 0, 1)])
    if rng.random() < 0.3:  # moss
        green = np.clip(noise(rng, size, 1.8) * 0.8 - 0.3, 0, 1)[..., None] * 0.7
        image = image + green * (np.array([0.25, 0.4, 0.12]) * rng.uniform(0.6, 1.3) - image)
    return grain(rng, np.clip(image, 0, 1).astype(np.float32), rng.uniform(0.05, 0.15))


def marble(rng: Rng, size: int) -> np.ndarray:
    """Veins along the zero crossings of a warped field."""
    field = noise(rng, size, rng.uniform(1.5, 2.0)) + 0.35 * noise(rng, size, 1.1)
    veins = np.exp(-np.abs(field) * rng.uniform(3, 9))
    ground = 0.5 + 0.2 * noise(rng, size, 1.9)
    base, vein = colour(rng, 0.12, 0.5, 0.95), colour(rng, 0.2, 0.1, 0.6)
    image = shade(np.clip(ground, 0, 1), [base * 0.8, base, np.clip(base * 1.15, 0, 1)])
    image = image + (rng.uniform(0.4, 0.9) * veins)[..., None] * (vein - image)
    return grain(rng, np.clip(image, 0, 1).astype(np.float32), rng.uniform(0.01, 0.05))


def roof(rng: Rng, size: int) -> np.ndarray:
    """Overlapping rows of rounded tiles, each row shaded by the one above it."""
    rows, columns = int(rng.integers(6, 13)), int(rng.integers(5, 11))
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    row = np.floor(y * rows).astype(int)
    shifted = x * columns + (row % 2) * 0.5
    fy, fx = y * rows % 1, shifted % 1
    # Below the arc of its own tile, a pixel belongs to the row underneath.
    below = fy > 1 - 0.35 * (2 * np.abs(fx - 0.5)) ** 2
    row = (row + below) % rows
    shifted = x * columns + (row % 2) * 0.5
    column = np.floor(shifted).astype(int) % columns
    base = colour(rng, 0.2, 0.25, 0.7) * np.array([1.15, 0.9, 0.75])
    tint = base * np.exp(rng.normal(0, rng.uniform(0.08, 0.25), (rows, columns, 1)))
    drop = np.where(below, fy - 1, fy)
    image = np.clip(tint, 0, 1)[row, column] * (0.55 + 0.45 * np.clip((drop + 0.3) / 0.5, 0, 1))[..., None]
    return grain(rng, image.astype(np.float32), rng.uniform(0.05, 0.15))
