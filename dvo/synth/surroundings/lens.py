"""What is between camera and scene: a bonnet, drops and flakes, borders and text, a window."""

from __future__ import annotations

import cv2
import numpy as np

from dvo.synth.surroundings.canvas import Canvas, Drawing, Style, lookup, within

Array = np.ndarray


def bonnet(rng: np.random.Generator, _: Array, style: Style) -> Drawing:
    """Bonnet with reflections, a dashboard's edge, a dark corner and a clock: fixed to the camera."""
    share, curve, colour = rng.uniform(0.35, 0.5), rng.uniform(0.05, 0.25), rng.uniform(0.1, 0.6, 3)
    gloss, scroll = style.texture(rng, 256, (4, 8)), rng.uniform(0.02, 0.1)
    texture, word = style.texture(rng, 256, (8, 32)), f"{rng.integers(10, 24)}:{rng.integers(10, 60)}"
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


def rain(rng: np.random.Generator, _: Array, style: Style) -> Drawing:
    """Drops on the lens that stay for seconds, some that run down, and streaks in the air."""
    count, seed = 90, int(rng.integers(2**31))
    places, radii, born = rng.random((count, 2)), rng.uniform(0.015, 0.06, count), rng.uniform(-6, 30, count)
    powers = [style.power(rng) for _ in range(count)]
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
            inside = within(a, b, powers[k])
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


def snow(rng: np.random.Generator, centre: Array, _: Style) -> Drawing:
    """Flakes that fall around the camera, large and out of focus where they are near."""
    count = 900
    places = rng.uniform(-4, 4, (count, 3))
    wind = np.append(rng.normal(0, 0.8, 2), -rng.uniform(0.8, 1.6))
    sway, phase = rng.uniform(0.02, 0.15, (count, 3)), rng.uniform(0, 6.3, (count, 3))

    def draw(canvas: Canvas) -> Array:
        camera, (height, width) = canvas.camera, canvas.depth.shape
        there = places + wind * canvas.time + sway * np.sin(2 * canvas.time + phase) + centre - canvas.pose_wc[:3]
        seen = ((there + 4) % 8 - 4) @ canvas.rotation  # a box of flakes that goes with the camera
        drawn = np.zeros((height, width), np.float32)
        for x, y, z in seen[seen[:, 2] > 0.3]:
            u, v = round(camera.fx * x / z + camera.cx), round(camera.fy * y / z + camera.cy)
            if 0 <= u < width and 0 <= v < height and canvas.depth[v, u] > z:
                radius = max(round(0.012 * camera.fx / z), 1)
                cv2.circle(drawn, (u, v), radius, float(np.clip(1.3 - 0.1 * radius, 0.4, 0.95)), -1)
        white = np.asarray(cv2.GaussianBlur(drawn, (0, 0), max(width / 400, 0.4)))
        covered = white > 0.05
        share = np.where(covered, white, 0)[..., None]
        canvas.image[:] = (1 - share) * canvas.image + share * 0.95
        return covered

    return draw


def border(rng: np.random.Generator, _: Array, style: Style) -> Drawing:
    """What is fixed to the image: black bars or a round border, a watermark, the blades of a propeller."""
    round_border, bar = rng.random() < 0.5, rng.uniform(0.05, 0.16)
    radius, text = rng.uniform(0.85, 1.1), "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVXZ"), 7))
    at, grey = rng.uniform([0.05, 0.75], [0.4, 0.95]), rng.uniform(0.6, 1.0)
    hub, blades, rate = rng.uniform([0.2, -0.25], [0.8, -0.05]), int(rng.integers(2, 4)), rng.uniform(20, 60)
    with_propeller = rng.random() < 0.4

    def draw(canvas: Canvas) -> Array:
        height, width = canvas.depth.shape
        y, x = np.mgrid[0:height, 0:width]
        u, v = (x + 0.5) / width, (y + 0.5) / height
        if round_border:
            power = 2.0 if style.training else 3.0
            black = np.abs((2 * u - 1) * width / height) ** power + np.abs(2 * v - 1) ** power > radius**power
        else:
            black = (v < bar) | (v > 1 - bar)
        canvas.image[black] = 0.02
        letters = np.zeros((height, width), np.uint8)
        place = (at * [width, height]).astype(int).tolist()
        cv2.putText(letters, text, place, cv2.FONT_HERSHEY_DUPLEX, height / 260, 255, max(height // 120, 1))
        shown = letters > 0
        canvas.image[shown] = 0.3 * canvas.image[shown] + 0.7 * grey
        blurred = np.zeros((height, width), bool)
        if with_propeller:
            a, b = (u - hub[0]) * width / height, v - hub[1]
            angle = np.arctan2(b, a) * blades + rate * canvas.time
            blurred = (np.hypot(a, b) < 0.45) & (np.cos(angle) > 0.6)
            canvas.image[blurred] = 0.5 * canvas.image[blurred] + 0.05
        return black | shown | blurred

    return draw


def glass(rng: np.random.Generator, _: Array, style: Style) -> Drawing:
    """Window before the camera: in a part of it the reflection of a room that stays with the camera."""
    texture = np.stack([style.texture(rng, 256, (4, 8, 32)) for _ in range(3)], -1)
    strength, low, high = rng.uniform(0.3, 0.6), rng.uniform(0.0, 0.4), rng.uniform(0.6, 1.0)
    slope, sway, rate = rng.uniform(-0.4, 0.4), rng.uniform(0.02, 0.05), rng.uniform(1, 3)

    def draw(canvas: Canvas) -> Array:
        height, width = canvas.depth.shape
        y, x = np.mgrid[0:height, 0:width]
        u, v = x / width, y / height
        covered = (u + slope * (v - 0.5) > low) & (u + slope * (v - 0.5) < high)
        moved = u + sway * np.sin(rate * canvas.time)
        room = np.stack([lookup(texture[..., k], moved, v) for k in range(3)], -1)
        canvas.image[covered] = ((1 - strength) * canvas.image + strength * room)[covered]
        return covered

    return draw
