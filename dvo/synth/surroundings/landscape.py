"""What moves in the world beside a rigid scene: water, clouds, leaves, people, cars, screens, lamps at night."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dvo.synth.surroundings.canvas import Canvas, Drawing, Style, lookup, within

Array = np.ndarray


def water(rng: np.random.Generator, _: Array, style: Style) -> Drawing:
    """A sea that covers the ground: waves that travel, foam, glitter."""
    level = rng.uniform(0.25, 0.45)
    waves = [rng.uniform([-9, -9, 1, 0], [9, 9, 4, 6.3]) for _ in range(12)]
    foam, colour = style.texture(rng, 512, (16, 64, 128)), rng.uniform([0.05, 0.2, 0.25], [0.2, 0.4, 0.5])
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


def sky(rng: np.random.Generator, _: Array, style: Style) -> Drawing:
    """Clouds that drift, over all that is far or above the horizon: two thirds of what a drone sees."""
    clouds, speed, nearest = style.texture(rng, 512, (4, 8, 16, 32)), rng.normal(0, 0.02, 2), rng.uniform(3.0, 5.0)

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
    rng: np.random.Generator, style: Style, count: int, sizes: tuple[float, float], tall: float,
    move: Callable[[float], Array], places: Array,
) -> Drawing:  # fmt: skip
    """Textured shapes that face the camera, at places ``(count, 3)`` that move."""
    textures = [style.texture(rng, 64, (4, 16)) for _ in range(count)]
    colours, radii = rng.uniform(0.1, 0.9, (count, 2, 3)), rng.uniform(sizes[0], sizes[1], count)
    powers = [style.power(rng) for _ in range(count)]

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
            inside = within(a, b, powers[k]) & (canvas.depth[v, u] > z)
            share = lookup(textures[k], (a + 1) / 2.001, (b + 1) / 2.001)[..., None]
            part = (1 - share) * colours[k, 0] + share * colours[k, 1]
            canvas.image[v[inside], u[inside]] = part[inside]
            covered[v[inside], u[inside]] = True
        return covered

    return draw


def foliage(rng: np.random.Generator, centre: Array, style: Style) -> Drawing:
    """Leaves and twigs around the way of the camera that sway in the wind."""
    count = 1500
    places = centre + rng.uniform([-6, -6, -1.2], [6, 6, 1.8], (count, 3))
    reach, rate, phase = (
        rng.uniform(0.05, 0.3, (count, 3)),
        rng.uniform(1.5, 6.0, (count, 1)),
        rng.uniform(0, 6.3, (count, 3)),
    )
    return _sprites(rng, style, count, (0.06, 0.2), 0.7, lambda time: reach * np.sin(rate * time + phase), places)


def crowd(rng: np.random.Generator, centre: Array, style: Style) -> Drawing:
    """People who walk past around the way of the camera, some of them near."""
    count = 90
    places = np.column_stack([rng.uniform(-6, 6, (count, 2)), rng.uniform(-0.5, -0.1, count)]) + centre
    way = rng.uniform(0, 6.3, count)
    speed = rng.uniform(0.5, 1.6, count)[:, None] * np.column_stack([np.cos(way), np.sin(way), np.zeros(count)])

    def move(time: float) -> Array:
        here = places[:, :2] - centre[:2]
        there = (here + speed[:, :2] * time + 6) % 12 - 6  # who leaves comes back on the other side
        return np.column_stack([there - here, np.zeros(count)])

    return _sprites(rng, style, count, (0.25, 0.4), 2.6, move, places)


def traffic(rng: np.random.Generator, centre: Array, style: Style) -> Drawing:
    """Cars and vans that drive past on both sides of the way of the camera, all along one direction."""
    count = 14
    way = rng.uniform(0, 6.3)
    along, across = np.array([np.cos(way), np.sin(way), 0.0]), np.array([-np.sin(way), np.cos(way), 0.0])
    sides = rng.choice([-1.0, 1.0], count)
    place = rng.uniform(-15, 15, count)
    offset = centre + np.outer(sides * rng.uniform(1.2, 3.5, count), across) - [0, 0, 0.5]
    speed = sides * rng.uniform(2.0, 9.0, count)

    def move(time: float) -> Array:
        return np.outer((place + speed * time + 15) % 30 - 15, along)  # who leaves comes back on the other side

    return _sprites(rng, style, count, (0.6, 1.4), 0.7, move, offset)


def screen(rng: np.random.Generator, centre: Array, style: Style) -> Drawing:
    """Upright screens and posters of light around the way of the camera: a picture that scrolls, and cuts."""
    count, cuts = 7, 3
    way, distance = rng.uniform(0, 6.3) + np.arange(count) * 6.3 / count, rng.uniform(1.5, 4.0, count)
    places = centre + np.column_stack([distance * np.cos(way), distance * np.sin(way), rng.uniform(-0.5, 0.6, count)])
    facing = way + rng.uniform(-0.6, 0.6, count)
    half = rng.uniform(0.35, 1.0, count)[:, None] * np.array([1.0, 0.6])
    pictures = [
        np.stack([style.texture(rng, 128, (4, 16, 32)) for _ in range(3)], -1) for _ in range(cuts)
    ]  # fmt: skip
    scroll, every = rng.normal(0, 0.3, (count, 2)), rng.uniform(0.7, 2.5, count)

    def draw(canvas: Canvas) -> Array:
        rays, nearest = canvas.rays(), canvas.depth.copy()
        covered = np.zeros(canvas.depth.shape, bool)
        for k in range(count):
            normal = np.array([np.cos(facing[k]), np.sin(facing[k]), 0.0])
            along = rays @ normal
            depth = (places[k] - canvas.pose_wc[:3]) @ normal / np.where(np.abs(along) > 1e-6, along, 1e-6)
            a = (canvas.pose_wc[:3] + depth[..., None] * rays - places[k]) @ np.array([-normal[1], normal[0], 0.0])
            b = canvas.pose_wc[2] + depth * rays[..., 2] - places[k, 2]
            inside = (depth > 0.2) & (depth < nearest) & (np.abs(a) < half[k, 0]) & (np.abs(b) < half[k, 1])
            picture = pictures[(k + int(canvas.time / every[k])) % cuts]
            u, v = 0.4 * a + scroll[k, 0] * canvas.time, 0.4 * b + scroll[k, 1] * canvas.time
            shown = np.stack([lookup(picture[..., channel], u, v) for channel in range(3)], -1)
            canvas.image[inside] = (1.6 * shown - 0.2).clip(0, 1)[inside]
            nearest[inside], covered[inside] = depth[inside], True
        return covered

    return draw


def night(rng: np.random.Generator, centre: Array, style: Style) -> Drawing:
    """Night: the scene is lit by lamps around the way of the camera, which shine into the lens; some drive past.

    Light on a surface is no motion: only the lamps and their glare are covered.
    """
    count, reach = 18, 7.0
    places = np.column_stack([rng.uniform(-reach, reach, (count, 2)), rng.uniform(0.2, 1.8, count)]) + centre
    way, moves = rng.uniform(0, 6.3, count), rng.random(count) < 0.35
    speed = (moves * rng.uniform(1, 5, count))[:, None] * np.column_stack([np.cos(way), np.sin(way), np.zeros(count)])
    colours, strength = rng.uniform([0.9, 0.6, 0.3], [1.0, 1.0, 0.9], (count, 3)), rng.uniform(0.15, 0.6, count)
    ambient, powers = rng.uniform(0.04, 0.12), [style.power(rng) for _ in range(count)]

    def draw(canvas: Canvas) -> Array:
        camera, (height, width) = canvas.camera, canvas.depth.shape
        there = places + speed * canvas.time - centre
        there[:, :2] = (there[:, :2] + reach) % (2 * reach) - reach  # who leaves comes back on the other side
        there += centre
        points = canvas.pose_wc[:3] + canvas.rays() * np.where(np.isfinite(canvas.depth), canvas.depth, 1e3)[..., None]
        light = np.full((height, width, 3), ambient)
        glare = np.zeros((height, width, 3))
        y, x = np.mgrid[0:height, 0:width]
        seen = (there - canvas.pose_wc[:3]) @ canvas.rotation
        for k in range(count):
            light += strength[k] * colours[k] / (((points - there[k]) ** 2).sum(-1, keepdims=True) + 0.3)
            u, v = camera.fx * seen[k, 0] / seen[k, 2] + camera.cx, camera.fy * seen[k, 1] / seen[k, 2] + camera.cy
            if seen[k, 2] < 0.3 or not (0 <= u <= width - 1 and 0 <= v <= height - 1):
                continue
            if canvas.depth[round(v), round(u)] < seen[k, 2]:
                continue
            radius = 0.12 * camera.fx / seen[k, 2] + 0.01 * width
            power = powers[k]
            away = (np.abs((x - u) / radius) ** power + np.abs((y - v) / radius) ** power) ** (1 / power)
            glare += (2 * strength[k] * np.exp(-(away**2)) + 1.5 * (away < 0.35))[..., None] * colours[k]
        canvas.image[:] = (canvas.image * np.minimum(light, 1.5) + glare).clip(0, 1)
        return glare.max(-1) > 0.02

    return draw
