"""Planning of moving bodies: boxes and figures that sway, turn and drive through the view of a camera."""

from __future__ import annotations

import numpy as np

from dvo.geometry.poses import split
from dvo.synth import salts
from dvo.synth.motion.motion import Sway
from dvo.synth.protocols import Motion
from dvo.synth.render.renderer import render_depth
from dvo.synth.scenes.bodies import Body
from dvo.synth.scenes.builder import SceneBuilder
from dvo.synth.scenes.furnishing import UP, paint_object, yaw
from dvo.synth.scenes.lighting import bake
from dvo.synth.scenes.scene import Scene

Array = np.ndarray


def random_bodies(scene: Scene, camera_path: Motion, duration: float, seed: int, count: int) -> tuple[Body, ...]:
    """Draw bodies that come into view of a camera path, never touch the camera and avoid solid objects if possible.

    Args:
        scene: to move in; also supplies the textures.
        camera_path: camera to world.
        duration: seconds during which the bodies are to be visible.
        seed: same seed, same bodies.
        count: number of bodies.

    Returns:
        The bodies; fewer than ``count`` if there is no room.
    """
    rng = np.random.default_rng([seed, salts.MOVERS])
    times = np.linspace(0, duration, max(16, int(8 * duration)))
    eyes = camera_path.poses_wc(times)
    k = np.array([16.0, 16.0, 11.5, 8.5])
    bodies = []
    for number in range(count):
        best: tuple[float, Body] | None = None
        for _ in range(24):
            # Each body is placed in its own part of the time, so that some body is in view at most times.
            at = int(np.clip((number + rng.random()) / count * len(times), 0, len(times) - 1))
            depth, _ = render_depth(scene, eyes[at : at + 1], k, 18, 24)
            x, y = rng.uniform(3, 20), rng.uniform(5, 13)
            there = float(depth[0, int(y), int(x)])
            away = rng.uniform(0.3, 0.75) * min(there if there > 0 else 4 * scene.scale, 2.5 * scene.scale)
            rotation, eye = split(eyes[at])
            spot = eye + rotation @ (np.array([(x - k[2]) / k[0], (y - k[3]) / k[1], 1.0]) * away)
            size = away * rng.uniform(0.1, 0.2)
            body = Body(_figure(rng, scene, size), _motion(rng, rotation, spot, away, times[at], scene))
            track = body.motion.poses_wc(times)[:, :3]
            gap = float(np.linalg.norm(track - eyes[:, :3], axis=1).min()) - body.radius
            if gap < 0.5 * body.radius:
                continue
            score = min(gap / body.radius, 1.0) + 2 * float(scene.is_free(track).mean())
            if best is None or score > best[0]:
                best = (score, body)
            if score > 2.8:
                break
        if best is not None:
            bodies.append(best[1])
    return tuple(bodies)


def _motion(rng: np.random.Generator, camera: Array, spot: Array, away: float, when: float, scene: Scene) -> Sway:
    """Oscillation across the view, or a drive along a street; at ``spot`` at the time ``when``."""
    drift = np.zeros(3)
    heading = scene.hints.get("heading")
    across = camera[:, 0] * rng.choice([-1, 1]) + camera[:, 2] * rng.normal(0, 0.5)
    across[2] = 0
    across *= away * rng.uniform(0.25, 0.5) / max(float(np.linalg.norm(across)), 1e-6)
    if heading is not None and rng.random() < 0.6:
        drift = heading * rng.choice([-1, 1]) * scene.scale * rng.uniform(0.1, 0.4)
        across = across * 0.1
    reach = np.stack([across, np.cross(across, UP) * 0.3 + UP * 0.05 * away * rng.normal()])
    rate, phase = 2 * np.pi / rng.uniform(2.5, 6), rng.uniform(0, 2 * np.pi)
    swing = np.array([np.sin(rate * when + phase), np.cos(rate * when + phase)]) @ reach
    spin = rng.normal(0, 0.5) if rng.random() < 0.5 else 0.0
    wobble = rng.normal(0, 0.07, 3)
    return Sway(spot - swing - drift * when, drift, reach, rate, phase, rng.uniform(0, 6), spin, wobble)


def _figure(rng: np.random.Generator, scene: Scene, size: float) -> Scene:
    """Box, stack of boxes, or box with a board, of half height ``size``: not mistaken for a plane."""
    b = SceneBuilder(rng, scene.pool)
    paints = [paint_object(b, (0.7 * size, 3 * size), 0.1) for _ in range(3)]
    kind = rng.random()
    half = size * np.array([rng.uniform(0.35, 0.7), rng.uniform(0.35, 0.7), 1.0])
    if kind < 0.35:
        b.box([0, 0, 0], half, np.eye(3), paints)
    elif kind < 0.75:  # legs, trunk and head
        b.box([0, 0, -0.65 * size], half * [0.6, 0.5, 0.35], np.eye(3), paints[:1])
        b.box([0, 0, 0.1 * size], half * [1, 0.7, 0.42], np.eye(3), paints[1:2])
        b.box([0, 0, 0.76 * size], half * [0.45, 0.45, 0.24], yaw(rng.uniform(0, 1)), paints[2:])
    else:
        b.box([0, 0, -0.3 * size], half * [1, 1, 0.6], np.eye(3), paints[:1])
        normal = np.array([rng.normal(0, 0.3), -1.0, 0.3])
        b.rectangle([0, 0, 0.65 * size], normal, UP, 1.6 * size, 0.7 * size, paints[1], two_sided=True)
    figure = b.build("body", np.array([[-1.0] * 3, [1.0] * 3]) * size, size)
    bake(figure, rng, sun=True, shadows=False)
    return figure
