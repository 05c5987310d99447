"""Baked light: a small light map per surface, from lamps or a sun, with soft shadows and ambient light."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dvo.synth.scenes.scene import CELL, Scene

Array = np.ndarray
MAX_OCCLUDERS = 48  # the largest surfaces cast shadows; small ones would hardly show


def _blocked(start: Array, end: Array, scene: Scene, occluders: Array) -> Array:
    """``(M,)`` bool: any occluder cuts the segment from ``start`` to ``end (M, 3)``."""
    normal = scene.normal[occluders].astype(np.float32)
    origin = scene.origin[occluders].astype(np.float32)
    constant = (normal * origin).sum(1)
    a, b = start @ normal.T - constant, end @ normal.T - constant  # (M, Q)
    crossing = (a * b < 0) & (np.abs(a) > 1e-4)
    blocked = np.zeros(len(start), bool)
    where, which = np.nonzero(crossing)
    if len(where) == 0:
        return blocked
    share = (a[where, which] / (a[where, which] - b[where, which]))[:, None]
    point = start[where] + share * (end[where] - start[where]) - origin[which]
    u = (point * scene.u_axis.astype(np.float32)[occluders][which]).sum(1)
    v = (point * scene.v_axis.astype(np.float32)[occluders][which]).sum(1)
    edges = scene.edges.astype(np.float32)[occluders][which]
    inside = (edges[..., 0] * u[:, None] + edges[..., 1] * v[:, None] + edges[..., 2] > 0).all(1)
    blocked[where[inside]] = True
    return blocked


def bake(
    scene: Scene, rng: np.random.Generator, *, lamps: int = 0, sun: bool = False, glowing: Array | None = None,
    shadows: bool = True, texel: float = 0.5, exposure: float = 1.0,
    bend: Callable[[Array, Array, Array], Array] | None = None,
) -> None:  # fmt: skip
    """Fill the scene's light maps in place; the median brightness of the result is about ``exposure``.

    Args:
        scene: surfaces to light.
        rng: draws lamps, colours and strengths.
        lamps: number of point lamps inside the bounds; each is sampled at two points for soft shadows.
        sun: add a distant light.
        glowing: indices of surfaces that emit light (sky): constant light 1, no shadow.
        shadows: trace shadow rays.
        texel: target edge of a light texel, in units of a quarter of the scene's scale.
        exposure: target median; below 1 where large surfaces face the light (a floor in the sun).
        bend: from points ``(M, 3)``, their normals and surfaces to the normals to shade with (smooth hills).
    """
    count = len(scene)
    glow = np.zeros(count, bool)
    if glowing is not None:
        glow[glowing] = True
    flat = scene.corners - scene.origin[:, None]
    size = np.stack([(flat * axis[:, None]).sum(-1) for axis in (scene.u_axis, scene.v_axis)], -1)
    low, high = size.min(1), size.max(1)
    extent = high - low
    cells = np.clip(np.ceil(extent / (texel * scene.scale * 0.25)), 1, CELL - 1).astype(np.int64) + 1
    cells[glow] = 2
    total = cells.prod(1)
    offset = np.concatenate([[0], np.cumsum(total)[:-1]])
    # Light-map coordinate = (u - low) / extent * (cells - 1).
    ratio = (cells - 1) / np.maximum(extent, 1e-9)
    mapping = np.zeros((count, 2, 3))
    mapping[:, 0, 0], mapping[:, 1, 1] = ratio[:, 0], ratio[:, 1]
    mapping[:, :, 2] = -low * ratio
    owner = np.repeat(np.arange(count), total)
    local = np.arange(total.sum()) - offset[owner]
    grid = np.stack([local % cells[owner, 0], local // cells[owner, 0]], -1) / np.maximum(cells[owner] - 1, 1)
    uv = low[owner] + (0.02 + 0.96 * grid) * extent[owner]  # a little inside, or walls would shade their own corners
    points = scene.origin[owner] + uv[:, :1] * scene.u_axis[owner] + uv[:, 1:] * scene.v_axis[owner]
    normal = scene.normal[owner]
    if bend is not None:
        normal = bend(points, normal, owner)
    double = scene.two_sided[owner]
    area = np.where(glow, -1.0, extent.prod(1))
    occluders = np.argsort(-area)[:MAX_OCCLUDERS]
    occluders = occluders[area[occluders] > 0]
    ambient = rng.uniform(0.35, 0.75)
    sky = np.exp(rng.normal(0, 0.08, 3))
    # Hemispheric ambient light: upward faces get more; flat in the walls' own plane.
    light = ambient * (0.8 + 0.25 * normal[:, 2:]) * sky
    sources: list[tuple[Array, Array, float, bool]] = []
    for _ in range(lamps):
        spot = rng.uniform(*(scene.bounds + (scene.bounds[1] - scene.bounds[0]) * [[0.1], [-0.1]]))
        spot[2] = scene.bounds[1, 2] - rng.uniform(0, 0.25) * (scene.bounds[1, 2] - scene.bounds[0, 2])
        tint, power = np.exp(rng.normal(0, 0.1, 3)), rng.uniform(0.5, 1.4) / np.sqrt(lamps)
        sources += [(spot + rng.normal(0, 0.05, 3) * scene.scale, tint, power / 2, False) for _ in range(2)]
    if sun:
        direction = rng.normal(size=3)
        direction[2] = abs(direction[2]) + rng.uniform(0.3, 1.5)
        direction /= np.linalg.norm(direction)
        warm = np.array([1.05, 1.0, 0.9]) * np.exp(rng.normal(0, 0.03, 3))
        sources.append((direction * 1e3 * scene.scale, warm, rng.uniform(0.2, 1.1), True))
    for spot, tint, power, distant in sources:
        ray = spot - points
        distance = np.linalg.norm(ray, axis=1)
        cosine = (ray * normal).sum(1) / np.maximum(distance, 1e-9)
        cosine = np.where(double, np.abs(cosine), np.maximum(cosine, 0))
        strength = power * cosine
        if not distant:
            strength = strength / (0.35 + (distance / scene.scale) ** 2 * 0.9)
        if shadows:
            lit = np.flatnonzero(strength > 0.03)
            begin = (points[lit] + 2e-3 * scene.scale * normal[lit]).astype(np.float32)
            reach = np.minimum(distance[lit], 50 * scene.scale) / distance[lit]
            end = (points[lit] + reach[:, None] * ray[lit]).astype(np.float32)
            dark = _blocked(begin, end, scene, occluders)
            strength[lit[dark]] *= rng.uniform(0.0, 0.3)
        light = light + strength[:, None] * tint
    visible = ~glow[owner]
    level = np.median(light[visible].mean(1)) if visible.any() else 1.0
    light = light / max(level, 1e-6) * exposure
    light[~visible] = 1.0
    scene.light[owner, local // cells[owner, 0], local % cells[owner, 0]] = np.clip(light, 0.12, 1.9)
    scene.light_map = mapping
