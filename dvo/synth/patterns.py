"""Procedural textures: each function draws one ``(S, S, 3)`` float32 RGB image in [0, 1] from a numpy Generator.

``PATTERNS`` maps a name to (function, tag); scenes ask for tags ("facade", "floor"...), so that walls look like walls.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

Rng = np.random.Generator
Pattern = Callable[[Rng, int], np.ndarray]
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789&%#+"


def colour(rng: Rng, saturation: float = 0.3, low: float = 0.1, high: float = 0.9) -> np.ndarray:
    """One plausible colour ``(3,)``: mostly earthy, at times of any hue; moderate saturation."""
    hue = rng.uniform(0, 6) if rng.random() < 0.4 else rng.normal(0.6, 0.4)
    sat, value = min(0.9, abs(rng.normal(0, saturation))), rng.uniform(low, high)
    ramp = np.clip(np.abs((hue + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return value * (1 - sat * (1 - ramp))


def noise(rng: Rng, size: int, beta: float, stretch: float = 1.0, low_cut: float = 0.0) -> np.ndarray:
    """Tileable Gaussian field ``(S, S)`` of spectrum ``1 / f^beta``, zero mean, unit deviation."""
    fy = np.fft.fftfreq(size)[:, None] * size * stretch
    fx = np.fft.rfftfreq(size)[None] * size / stretch
    f = np.sqrt(fx**2 + fy**2)
    amplitude = np.where(f > low_cut, 1 / np.maximum(f, 0.5) ** beta, 0)
    amplitude[0, 0] = 0
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * amplitude, s=(size, size))
    return (field / (field.std() + 1e-9)).astype(np.float32)


def shade(field: np.ndarray, colours: list[np.ndarray]) -> np.ndarray:
    """Map a field in [0, 1] through a colour ramp -> ``(S, S, 3)``."""
    stops = np.linspace(0, 1, len(colours))
    table = np.stack(colours)
    return np.stack([np.interp(field, stops, table[:, k]) for k in range(3)], -1).astype(np.float32)


def grain(rng: Rng, image: np.ndarray, amount: float) -> np.ndarray:
    """Overlay fine and coarse grain so that no area is exactly constant."""
    size = image.shape[0]
    field = noise(rng, size, rng.uniform(0.3, 1.4)) * 0.7 + noise(rng, size, 1.8) * 0.5
    # Contiguous, because broadcasting leaves layouts that OpenCV cannot draw on.
    return np.ascontiguousarray(np.clip(image * (1 + amount * field[..., None]), 0, 1), np.float32)


def fractal(rng: Rng, size: int) -> np.ndarray:
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


def stripes(rng: Rng, size: int) -> np.ndarray:
    """Stripes or plaid."""
    image: np.ndarray = np.broadcast_to(colour(rng), (size, size, 3)).astype(np.float32)
    for axis in (0, 1)[: int(rng.integers(1, 3))]:
        for _ in range(int(rng.integers(1, 5))):
            period = size / int(rng.integers(2, 20))
            phase = (np.arange(size) / period + rng.random()) % 1
            mask = (phase < rng.uniform(0.1, 0.6)).astype(np.float32) * rng.uniform(0.3, 0.9)
            mask = mask[:, None, None] if axis == 0 else mask[None, :, None]
            image = image + mask * (colour(rng) - image)
    return grain(rng, image, rng.uniform(0.02, 0.12))


def leaves(rng: Rng, size: int, palette: Callable[[], np.ndarray] | None = None) -> np.ndarray:
    """Dead leaves: occluding shapes with power-law sizes, which share the statistics of natural images."""
    draw = palette or (lambda: colour(rng, 0.4))
    image: np.ndarray = np.broadcast_to(draw(), (size, size, 3)).astype(np.float32).copy()
    smallest, kind = rng.uniform(0.012, 0.04), int(rng.integers(0, 4))
    for _ in range(int(rng.integers(250, 900))):
        radius = size * smallest / np.sqrt(rng.uniform(smallest**2 / 0.09, 1))
        centre = rng.uniform(0, size, 2)
        tint = draw()
        shape = kind if kind < 3 else int(rng.integers(0, 3))
        if shape == 0:
            axes = (max(1, int(radius)), max(1, int(radius * rng.uniform(0.3, 1))))
            spot = (int(centre[0]), int(centre[1]))
            cv2.ellipse(image, spot, axes, rng.uniform(0, 360), 0, 360, tint.tolist(), -1, cv2.LINE_AA)
        else:
            corners = int(rng.integers(3, 7)) if shape == 1 else 4
            angle = (
                np.sort(rng.uniform(0, 2 * np.pi, corners)) if shape == 1 else np.arange(4) * np.pi / 2 + rng.random()
            )
            points = centre + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
            cv2.fillPoly(image, [points.astype(np.int32)], tint.tolist(), cv2.LINE_AA)
    return grain(rng, image, rng.uniform(0.02, 0.15))


def foliage(rng: Rng, size: int) -> np.ndarray:
    base = np.array([rng.uniform(0.15, 0.45), rng.uniform(0.3, 0.6), rng.uniform(0.08, 0.25)])
    return leaves(rng, size, lambda: np.clip(base * np.exp(rng.normal(0, 0.45)) + rng.normal(0, 0.03, 3), 0, 1))


def grass(rng: Rng, size: int) -> np.ndarray:
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


def facade(rng: Rng, size: int) -> np.ndarray:
    """A grid of windows in a wall; tiles without a seam."""
    kind = rng.random()
    wall = bricks(rng, size) if kind < 0.35 else stains(rng, size) if kind < 0.5 else plain(rng, size)
    image = (0.75 * wall + 0.25 * wall.mean((0, 1))).astype(np.float32)
    rows, columns = int(rng.integers(1, 5)), int(rng.integers(1, 6))
    frame, lit = colour(rng, 0.1, 0.1, 1), colour(rng, 0.15, 0.05, 0.35)
    w, h = size / columns, size / rows
    ww, hh = w * rng.uniform(0.35, 0.8), h * rng.uniform(0.45, 0.8)
    bars, border = int(rng.integers(1, 4)), max(1, int(size * 0.01))
    for i in range(rows):
        for j in range(columns):
            x0, y0 = (j + 0.5) * w - ww / 2, (i + 0.5) * h - hh / 2
            a, b = (int(x0), int(y0)), (int(x0 + ww), int(y0 + hh))
            cv2.rectangle(image, a, b, frame.tolist(), -1)
            cv2.rectangle(image, (a[0], b[1]), (b[0] + border, b[1] + 2 * border), (frame * 0.6).tolist(), -1)
            glass = np.clip(lit * np.exp(rng.normal(0, 0.5)), 0, 1)
            ramp = np.linspace(rng.uniform(0.8, 1.6), rng.uniform(0.5, 1.1), b[1] - a[1])[:, None, None]
            pane = np.clip(glass * ramp, 0, 1) * np.ones((1, b[0] - a[0], 1))
            if rng.random() < 0.3:  # curtain
                pane[: int(pane.shape[0] * rng.uniform(0.2, 0.8))] = colour(rng, 0.2, 0.4, 0.9)
            image[a[1] + border : b[1] - border, a[0] + border : b[0] - border] = pane[border:-border, border:-border]
            for k in range(1, bars):
                x = int(x0 + ww * k / bars)
                cv2.line(image, (x, a[1]), (x, b[1]), frame.tolist(), border)
    return grain(rng, image, 0.04)


def text(rng: Rng, size: int) -> np.ndarray:
    """A poster: headline, lines of letters, a picture block."""
    image: np.ndarray = np.broadcast_to(colour(rng, 0.4, 0.5, 1), (size, size, 3)).astype(np.float32).copy()
    for _ in range(int(rng.integers(0, 4))):
        x, y, w, h = rng.uniform(0.05, 0.6, 4) * size
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), colour(rng, 0.5).tolist(), -1)
    ink, y = colour(rng, 0.4, 0, 0.35) * 255, 0.0
    image = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)  # the only depth that putText takes
    while y < size:
        scale = float(np.exp(rng.uniform(np.log(0.3), np.log(2.5))))
        y += 30 * scale
        word = "".join(rng.choice(list(LETTERS), int(rng.integers(2, 30))))
        spot = (int(rng.uniform(-0.05, 0.3) * size), int(y))
        font = int(rng.choice([cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX]))
        cv2.putText(image, word, spot, font, scale, ink.tolist(), max(1, int(2 * scale)), cv2.LINE_AA)
    return grain(rng, image.astype(np.float32) / 255, rng.uniform(0.01, 0.06))


def shelf(rng: Rng, size: int) -> np.ndarray:
    """Rows of upright coloured rectangles: books, boxes on a shelf."""
    image = np.zeros((size, size, 3), np.float32) + colour(rng, 0.2, 0.02, 0.2)
    rows, board = int(rng.integers(2, 6)), colour(rng, 0.3, 0.3, 0.9)
    for i in range(rows):
        floor, x = int((i + 1) * size / rows), 0.0
        while x < size:
            width, height = size * rng.uniform(0.012, 0.07), size / rows * rng.uniform(0.45, 0.85)
            tint = colour(rng, 0.5)
            if rng.random() < 0.92:
                cv2.rectangle(image, (int(x), int(floor - height)), (int(x + width) - 1, floor), tint.tolist(), -1)
                band = int(floor - height * rng.uniform(0.2, 0.9))
                cv2.rectangle(image, (int(x), band), (int(x + width) - 1, band + 4), (1 - tint).tolist(), -1)
            x += width
        cv2.rectangle(image, (0, floor - 5), (size, floor), board.tolist(), -1)
    return grain(rng, image, 0.06)


def panel(rng: Rng, size: int) -> np.ndarray:
    """Nested rectangles on a plain ground: doors, cupboards, appliances."""
    image = plain(rng, size)
    base = image.mean((0, 1))
    for i in range(columns := int(rng.integers(1, 4))):
        for j in range(rows := int(rng.integers(1, 5))):
            inset = rng.uniform(0.03, 0.12) * size / max(rows, columns)
            x0, x1 = i * size / columns + inset, (i + 1) * size / columns - inset
            y0, y1 = j * size / rows + inset, (j + 1) * size / rows - inset
            a, b = (int(x0), int(y0)), (int(x1), int(y1))
            cv2.rectangle(image, a, b, np.clip(base * np.exp(rng.normal(0, 0.15)), 0, 1).tolist(), -1)
            cv2.rectangle(image, a, b, (base * rng.uniform(0.4, 0.9)).tolist(), int(rng.integers(1, 5)))
            if rng.random() < 0.6:
                knob = (int(x0 + (x1 - x0) * rng.uniform(0.1, 0.9)), int(y0 + (y1 - y0) * rng.uniform(0.2, 0.8)))
                cv2.circle(image, knob, int(rng.integers(2, 7)), colour(rng, 0.1).tolist(), -1, cv2.LINE_AA)
    return grain(rng, image, rng.uniform(0.01, 0.05))


def clouds(rng: Rng, size: int) -> np.ndarray:
    field = np.clip(0.5 + noise(rng, size, rng.uniform(1.6, 2.4), 1.3) * rng.uniform(0.1, 0.35), 0, 1)
    sky = np.array([rng.uniform(0.4, 0.75), rng.uniform(0.6, 0.8), rng.uniform(0.8, 0.98)])
    grey = rng.uniform(0.0, 1.0)
    sky = sky + grey * (sky.mean() - sky)
    return shade(field, [sky, sky, np.array([0.95, 0.95, 0.96])])


PATTERNS: dict[str, tuple[Pattern, str]] = {
    "fractal": (fractal, "stone"),
    "stains": (stains, "wall"),
    "plain": (plain, "plain"),
    "cells": (cells, "stone"),
    "bricks": (bricks, "wall"),
    "tiles": (tiles, "floor"),
    "wood": (wood, "floor"),
    "stripes": (stripes, "cloth"),
    "leaves": (leaves, "busy"),
    "foliage": (foliage, "plant"),
    "grass": (grass, "ground"),
    "asphalt": (asphalt, "road"),
    "facade": (facade, "facade"),
    "text": (text, "poster"),
    "shelf": (shelf, "busy"),
    "panel": (panel, "panel"),
    "clouds": (clouds, "sky"),
}
