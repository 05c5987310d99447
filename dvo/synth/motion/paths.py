"""Planning of short camera paths, for training clips: a start pose in free space and a random motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.core.errors import DvoError
from dvo.geometry.poses import look_rotation, pose_from, quaternion_to_matrix
from dvo.synth import salts
from dvo.synth.motion.motion import UP, Path
from dvo.synth.render.renderer import render_depth
from dvo.synth.scenes.scene import Scene

Array = np.ndarray
KINDS = ("handheld", "forward", "sideways", "orbit", "rotation", "drone", "stop_and_go")


@dataclass(frozen=True)
class Start:
    """Pose with free space around it and several surfaces in view.

    Attributes:
        rotation, position: ``(3, 3)``, ``(3,)`` camera to world.
        depth: median depth in view.
    """

    rotation: Array
    position: Array
    depth: float


def find_start(scene: Scene, rng: np.random.Generator, tries: int = 4) -> Start:
    """Draw a start pose: of some random ones, the first that sees several surfaces and none of them too close.

    Args:
        scene: to start in.
        rng: draws poses.
        tries: rounds of up to three poses.

    Returns:
        The best of the poses.
    """
    best: tuple[float, Start] | None = None
    k = np.array([16.0, 16.0, 11.5, 8.5])
    heading, focus = scene.hints.get("heading"), scene.hints.get("focus")
    for _ in range(tries):
        spots = rng.uniform(scene.bounds[0], scene.bounds[1], (8, 3))
        if "height" in scene.hints:
            low, high = scene.hints["height"]
            spots[:, 2] = rng.uniform(low, high, 8)
        spots = spots[scene.clearance(spots) > 0.06 * scene.scale][:3]
        poses: list[Array] = []
        for spot in spots:
            if heading is not None and rng.random() < 0.8:
                forward = heading * rng.choice([-1, 1]) + rng.normal(0, 0.12, 3) * [1, 1, 0.5]
            elif focus is not None:
                forward = rng.uniform(*focus) - spot
            else:
                forward = rng.normal(size=3) * [1, 1, 0.25]
            if abs(forward[2]) > 0.8 * np.linalg.norm(forward) and rng.random() < 0.7:
                forward[2] *= 0.3
            poses.append(pose_from(look_rotation(forward, UP, rng.normal(0, 0.06)), spot))
        if not poses:
            continue
        depths, surfaces = render_depth(scene, np.stack(poses), k, 18, 24)
        for pose, depth, surface in zip(poses, depths.numpy(), surfaces.numpy(), strict=True):
            near, median = float(np.quantile(depth, 0.03)), float(np.median(depth))
            share = np.bincount(surface.ravel() + 1) / surface.size
            variety = 1 - float((share**2).sum())  # chance that two pixels show different surfaces
            score = min(near / max(median, 1e-6), 0.35) + 0.5 * min(variety, 0.75) + 0.1 * rng.random()
            if best is None or score > best[0]:
                best = (score, Start(quaternion_to_matrix(pose[3:]), pose[:3].copy(), median))
        if best is not None and best[0] > 0.55:
            break
    if best is not None:
        return best[1]
    # Too cluttered: the point of largest clearance of many.
    spots = rng.uniform(scene.bounds[0], scene.bounds[1], (200, 3))
    spot = spots[int(scene.clearance(spots).argmax())]
    return Start(look_rotation(rng.normal(size=3) * [1, 1, 0.2], UP), spot, scene.scale)


def random_path(
    scene: Scene, seed: int, kind: str | None = None, *, shake: float = 1.0, start: Start | None = None
) -> Path:
    """Draw a path that starts in free space. Motion is scaled to the depth in view; the end is not checked.

    Args:
        scene: to move in.
        seed: same seed, same path.
        kind: one of ``KINDS``; drawn to suit the scene if None.
        shake: factor on the amplitude of the shake.
        start: start pose; drawn if None.

    Returns:
        The path.

    Raises:
        DvoError: an unknown kind.
    """
    rng = np.random.default_rng([seed, salts.PATH])
    vehicle = scene.hints.get("heading") is not None
    odds = [0.1, 0.5, 0.08, 0.02, 0.08, 0.1, 0.12] if vehicle else [0.3, 0.1, 0.14, 0.16, 0.1, 0.1, 0.1]
    drawn = str(rng.choice(KINDS, p=odds))
    name = kind or drawn
    if name not in KINDS:
        raise DvoError(f"no path kind {name!r}", field="kind", remedy=f"choose one of {', '.join(KINDS)}")
    if start is None:
        start = find_start(scene, rng)
    rotation, position, depth = start.rotation, start.position, start.depth
    base = name if name != "stop_and_go" else str(rng.choice(["handheld", "forward", "sideways", "drone"]))
    twist = np.zeros(6)
    sign = float(rng.choice([-1, 1]))
    up = rotation.T @ UP  # the vertical in body axes
    shake_move, shake_turn = 0.02, 0.02
    if base == "forward":
        twist[2] = depth * 0.35 * (sign if rng.random() < 0.2 else 1)
        twist[:2] = twist[2] * rng.normal(0, 0.05, 2)
        twist[3:] = up * rng.normal(0, 0.12) * (rng.random() < 0.7)
        shake_move, shake_turn = 0.008, np.exp(rng.normal(np.log(0.008), 0.6))
    elif base == "sideways":
        twist[0] = sign * depth * 0.3
        twist[1:3] = rng.normal(0, 0.08, 2) * depth
        twist[3:] = rng.normal(0, 0.06, 3)
    elif base == "orbit":
        twist[0] = sign * depth * 0.3
        twist[1] = rng.normal(0, 0.06) * depth
        twist[3:] = up * sign * 0.3 * rng.uniform(0.7, 1.2)  # turns towards what it circles
    elif base == "rotation":
        axis = up + rng.normal(0, 0.35, 3) if rng.random() < 0.7 else rng.normal(size=3)
        twist[3:] = sign * 0.4 * axis / np.linalg.norm(axis)
        twist[:3] = rng.normal(0, 0.03, 3) * depth * rng.random()
        shake_move = 0.005
    elif base == "drone":
        direction = rng.normal(size=3) * [1, 0.5, 1]
        twist[:3] = direction / np.linalg.norm(direction) * depth * 0.3
        twist[3:] = rng.normal(0, 0.12, 3)
        shake_move, shake_turn = 0.03, 0.03
    else:  # handheld
        twist[:3] = rng.normal(0, 0.08, 3) * depth
        twist[3:] = rng.normal(0, 0.05, 3)
        mix = rng.uniform(0.15, 1)
        shake_move, shake_turn = 0.09 * mix, 0.09 * (1.2 - mix)
    hertz = np.exp(rng.uniform(np.log(0.25), np.log(2.2), 5))
    amplitude = rng.normal(size=(5, 2, 6)) / (hertz[:, None, None] / 0.4) / np.sqrt(5)
    amplitude[..., :3] *= shake_move * depth * shake
    amplitude[..., 3:] *= shake_turn * np.array([1, 1, 0.7]) * shake
    warp = (0.0, 1.0, 0.0)
    if name == "stop_and_go":
        warp = (float(rng.uniform(0.7, 0.97)), float(rng.uniform(2, 6)), float(rng.uniform(0, 2 * np.pi)))
    elif rng.random() < 0.3:
        warp = (float(rng.uniform(0.2, 0.6)), float(rng.uniform(1, 4)), float(rng.uniform(0, 2 * np.pi)))
    return Path(name, rotation, position, twist, hertz * 2 * np.pi, amplitude, depth, warp)
