"""Patterns with drawn shapes: cloth, dead leaves, facades, posters, shelves, doors, wallpaper, paintings.

Each function takes a generator and the edge length S in texels, and returns ``(S, S, 3)`` float32 RGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from dvo.synth.textures.patterns.base import Rng, colour, grain, noise
from dvo.synth.textures.patterns.surfaces import bricks, plain, stains

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789&%#+"


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
    """Leaves of a plant."""
    base = np.array([rng.uniform(0.15, 0.45), rng.uniform(0.3, 0.6), rng.uniform(0.08, 0.25)])
    return leaves(rng, size, lambda: np.clip(base * np.exp(rng.normal(0, 0.45)) + rng.normal(0, 0.03, 3), 0, 1))


def facade(rng: Rng, size: int) -> np.ndarray:
    """Grid of windows in a wall; tileable."""
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
    """Poster: headline, lines of letters, a picture."""
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


def wallpaper(rng: Rng, size: int) -> np.ndarray:
    """One motif on a lattice, exactly repeated, which is ambiguous for matching."""
    count = 2 * int(rng.integers(2, 6))
    cell = size // count
    motif = np.broadcast_to(colour(rng, 0.3, 0.4, 0.9), (cell, cell, 3)).astype(np.float32).copy()
    for _ in range(int(rng.integers(2, 6))):
        tint, radius = colour(rng, 0.4).tolist(), cell * rng.uniform(0.06, 0.3)
        spot = rng.uniform(0.2, 0.8, 2) * cell
        corners = int(rng.integers(3, 9))
        angle = np.arange(2 * corners) * np.pi / corners + rng.uniform(0, np.pi)
        reach = radius * np.where(np.arange(2 * corners) % 2, rng.uniform(0.4, 1), 1)[:, None]
        ring = spot + reach * np.stack([np.cos(angle), np.sin(angle)], -1)
        cv2.fillPoly(motif, [ring.astype(np.int32)], tint, cv2.LINE_AA)
    mirrored = np.concatenate([motif, motif[:, ::-1]], 1)
    image = np.tile(mirrored, (count, count // 2, 1)) if rng.random() < 0.5 else np.tile(motif, (count, count, 1))
    image = cv2.resize(image, (size, size), interpolation=cv2.INTER_LINEAR)
    return grain(rng, image, rng.uniform(0.005, 0.03))


def painting(rng: Rng, size: int) -> np.ndarray:
    """Painting in a frame: sky, hills, shapes, brush strokes."""
    y = np.linspace(0, 1, size, dtype=np.float32)[:, None, None]
    top, low = colour(rng, 0.4, 0.4, 0.95), colour(rng, 0.4, 0.3, 0.95)
    image = np.ascontiguousarray(np.broadcast_to(top + y * (low - top), (size, size, 3)), np.float32)
    for level in np.sort(rng.uniform(0.3, 0.9, int(rng.integers(2, 5)))):  # hills, far to near
        line = size * (level + 0.1 * noise(rng, size, 1.6)[0])
        shape = np.stack([np.arange(size), line], -1)
        hill = np.concatenate([shape, [[size, size], [0, size]]]).astype(np.int32)
        cv2.fillPoly(image, [hill], colour(rng, 0.5, 0.1, 0.8).tolist(), cv2.LINE_AA)
    for _ in range(int(rng.integers(60, 300))):
        spot, turn = rng.integers(0, size, 2), rng.uniform(0, np.pi)
        tint = image[spot[1], spot[0]] * np.exp(rng.normal(0, 0.2)) + rng.normal(0, 0.04, 3)
        axes = (int(size * rng.uniform(0.01, 0.05)), max(1, int(size * 0.008)))
        where = (int(spot[0]), int(spot[1]))
        cv2.ellipse(image, where, axes, np.degrees(turn), 0, 360, np.clip(tint, 0, 1).tolist(), -1, cv2.LINE_AA)
    border = int(size * rng.uniform(0.03, 0.08))
    for inset, tint in ((0, colour(rng, 0.3, 0.1, 0.7)), (border - 2, colour(rng, 0.1, 0.6, 1.0))):
        corner, opposite = (inset, inset), (size - 1 - inset, size - 1 - inset)
        cv2.rectangle(image, corner, opposite, tint.tolist(), max(1, border if inset == 0 else 2))
    return grain(rng, np.clip(image, 0, 1), rng.uniform(0.01, 0.05))
