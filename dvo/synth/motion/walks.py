"""Planning of long camera paths: walks, drives and orbits of any length in free space."""

from __future__ import annotations

import numpy as np

from dvo.core.errors import DvoError
from dvo.synth import salts
from dvo.synth.motion.motion import SplinePath
from dvo.synth.motion.paths import KINDS, find_start
from dvo.synth.motion.returns import INTERVAL, begun_again, jump, jump_parts, there_and_back
from dvo.synth.render.renderer import render_depth
from dvo.synth.scenes.scene import Scene

Array = np.ndarray
# Long paths add to the kinds of short ones: a closed circuit, a way without turns, a hasty hand; and, for loop closure,
# a circuit on which the camera faces along the way, a way there and back, and one that jumps back to its start.
LONG_KINDS = tuple(dict.fromkeys((*KINDS, "loop", "straight", "fast", "revisit", "return", "kidnap")))
TURNS = 1.4  # rounds of a loop
CONTROL_INTERVAL = 0.8  # seconds between control points


def yaw_towards(direction: Array) -> float:
    """Yaw of a camera that looks along ``direction (3,)``, rad; 0 looks along y."""
    return float(np.arctan2(-direction[0], direction[1]))


def nearest_turn(angle: float, previous: float) -> float:
    """Angle, rad, with those turns added that bring it within half a turn of ``previous``."""
    return previous + (angle - previous + np.pi) % (2 * np.pi) - np.pi


def long_path(
    scene: Scene, seed: int, kind: str, duration: float, *, speed: float = 1.0, shake: float = 1.0
) -> SplinePath:
    """Draw a path that stays in free space all along.

    Args:
        scene: to move in.
        seed: same seed, same path.
        kind: one of ``LONG_KINDS``.
        duration: seconds.
        speed: 1 is a relaxed pace: a tenth of the scene's scale per second, six times that for a vehicle in a street.
        shake: factor on the amplitude of the hand's shake.

    Returns:
        The path.

    Raises:
        DvoError: an unknown kind, or no room for such a path.
    """
    if kind not in LONG_KINDS:
        raise DvoError(f"no path kind {kind!r}", field="kind", remedy=f"choose one of {', '.join(LONG_KINDS)}")
    rng = np.random.default_rng([seed, salts.LONG_PATH])
    best: tuple[float, SplinePath] | None = None
    for attempt in range(24):
        pace = speed * 0.85 ** (attempt // 4)
        path = _draw(scene, rng, kind, duration, pace, shake)
        times = np.linspace(0, duration, max(20, int(duration * 10)))
        if kind == "kidnap":
            begin, end = jump(duration)
            times = times[(times < begin) | (times > end)]
        room_left = scene.clearance(path.poses_wc(times)[:, :3]).min() / scene.scale
        if room_left < 0.03:
            continue
        score = openness(scene, path.poses_wc(times[:: max(1, len(times) // 12)]))
        if best is None or score > best[0]:
            best = (score, path)
        if score > 0.35:
            break
    if best is None:
        raise DvoError("found no free path through the scene", field="seed", remedy="try another seed or less speed")
    return best[1]


def openness(scene: Scene, poses_wc: Array) -> float:
    """How far away the nearest surfaces in the views of a path are, against the median depth of all.

    Args:
        scene: to look at.
        poses_wc: ``(N, 7)`` of the cameras.

    Returns:
        0 to 0.6.
    """
    depth = render_depth(scene, poses_wc, np.array([16.0, 16.0, 11.5, 8.5]), 18, 24)[0].numpy()
    near = np.minimum(np.quantile(depth, 0.03, axis=(1, 2)) / np.median(depth), 0.3)
    return float(near.min() + near.mean())


def _draw(scene: Scene, rng: np.random.Generator, kind: str, duration: float, pace: float, shake: float) -> SplinePath:
    """Draw a path of any kind."""
    if kind in ("loop", "revisit"):
        return _draw_loop(scene, rng, duration, pace, shake, follow=kind == "revisit")
    if kind == "return":
        return there_and_back(_draw_long(scene, rng, "handheld", duration / 2, pace, shake), duration)
    if kind == "kidnap":  # control points follow each other faster than they were planned for
        planned = jump_parts(duration) * CONTROL_INTERVAL
        pace *= INTERVAL / CONTROL_INTERVAL
        return begun_again(_draw_long(scene, rng, "handheld", planned, pace, shake), duration)
    return _draw_long(scene, rng, kind, duration, pace, shake)


def _draw_long(
    scene: Scene, rng: np.random.Generator, kind: str, duration: float, speed: float, shake: float
) -> SplinePath:
    """Draw a path of any kind that is not made of another's."""
    interval = CONTROL_INTERVAL
    count = int(np.ceil(duration / interval)) + 4
    start = find_start(scene, rng, 2)
    heading = scene.hints.get("heading")
    pace = 0.1 * scene.scale * speed * interval  # metres a control interval
    forward = start.rotation[:, 2]
    control = np.zeros((count, 6))
    position, yaw = start.position.copy(), yaw_towards(forward)
    drift = rng.normal(size=3) * [1, 1, 0.4]
    direction = drift / np.linalg.norm(drift)
    low, high = scene.hints.get("focus", (scene.bounds[0], scene.bounds[1]))
    focus, side = rng.uniform(low, high), float(rng.choice([-1, 1]))
    hasty = kind == "fast"
    if hasty:
        pace, shake = 3 * pace, 2.5 * shake
    if kind == "straight" and heading is None:
        direction, room = longest_way(scene, rng, position)
        pace, yaw = min(pace, 0.85 * room / count), yaw_towards(direction)
    if heading is not None and kind in ("forward", "stop_and_go", "drone", "sideways", "straight"):
        along = scene.bounds[:, 1]
        pace *= 6 if scene.family == "street" else 1.5
        pace = min(pace, 0.8 * (along[1] - along[0]) / count)
        towards = float(rng.choice([-1, 1]))
        first = along[0] + 0.05 * np.ptp(along) if towards > 0 else along[1] - 0.05 * np.ptp(along)
        position = np.array([start.position[0] * 0.5, first, start.position[2]])
        direction, yaw = heading * towards, yaw_towards(heading * towards)
        if kind == "sideways":
            yaw += side * np.pi / 2 * rng.uniform(0.4, 1)
    radius = float(np.linalg.norm((position - focus)[:2]))
    rate = np.clip(pace / max(radius, 1e-3), 0, 0.25)
    pitch = float(np.clip(np.arcsin(forward[2]), -0.7, 0.5)) * 0.7
    for i in range(count):
        calm = 1.0 if kind != "stop_and_go" else float(np.clip(0.6 + 0.9 * np.sin(i * 1.1 + side), 0.02, 1.3))
        if kind == "orbit":
            angle = np.arctan2(*(position - focus)[1::-1]) + side * rate
            target = focus + [radius * np.cos(angle), radius * np.sin(angle), position[2] - focus[2]]
            position = target + rng.normal(0, 0.1, 3) * pace
            yaw = nearest_turn(yaw_towards(focus - position), yaw)
            pitch = float(np.arctan2(focus[2] - position[2], max(radius, 1e-3)))
        elif kind == "straight":
            position = position + direction * pace
            pitch = pitch * 0.7
        elif heading is not None and kind in ("forward", "stop_and_go", "drone", "sideways"):
            position = position + direction * pace * calm
            position[0] = np.clip(position[0] + rng.normal(0, 0.12) * pace, *(scene.bounds[:, 0] * 0.5))
            wander = yaw if kind == "sideways" else yaw_towards(direction)
            yaw = yaw + 0.3 * (nearest_turn(wander, yaw) - yaw) + rng.normal(0, 0.02)
            pitch = pitch * 0.7
        else:
            step = pace * calm * (0.15 if kind == "rotation" else 1.0)
            for _ in range(12):  # turn until the way is free
                trial = position + direction * step
                ahead = position + direction * max(4 * step, 0.15 * scene.scale)
                if scene.clearance(np.stack([trial, ahead])).min() > 0.06 * scene.scale:
                    break
                fresh = rng.normal(size=3) * [1, 1, 0.3]
                direction = fresh / np.linalg.norm(fresh)
            else:
                trial = position
            position = trial
            direction = direction + rng.normal(0, 0.25, 3) * [1, 1, 0.4]
            direction /= np.linalg.norm(direction)
            if rng.random() < (0.35 if hasty else 0.12):
                focus = rng.uniform(low, high)
            wanted = yaw_towards(direction if kind == "forward" else focus - position)
            swing = 0.35 if kind == "rotation" else 0.5 if hasty else 0.15
            if kind == "rotation":
                wanted = yaw + side
                side = -side if rng.random() < 0.08 else side
            yaw = yaw + float(np.clip(nearest_turn(wanted, yaw) - yaw, -swing, swing))
            pitch = 0.8 * pitch + rng.normal(0, 0.04)
        control[i] = [*position, yaw, pitch, 0.6 * control[i - 1, 5] + rng.normal(0, 0.015)]
    vehicle = scene.family == "street" and kind in ("forward", "stop_and_go", "straight")
    return SplinePath(kind, control, interval, *_shake(scene, rng, shake, vehicle))


def _shake(scene: Scene, rng: np.random.Generator, shake: float, vehicle: bool) -> tuple[Array, Array]:
    """Frequencies and amplitudes of a hand, or of a vehicle."""
    hertz = np.exp(rng.uniform(np.log(0.4), np.log(3.0), 6))
    amplitude = rng.normal(size=(6, 2, 6)) / hertz[:, None, None] / np.sqrt(6) * shake
    amplitude[..., :3] *= 0.003 * scene.scale * (0.3 if vehicle else 1)
    amplitude[..., 3:] *= 0.012 * (0.25 if vehicle else 1)
    return hertz * 2 * np.pi, amplitude


def longest_way(scene: Scene, rng: np.random.Generator, position: Array) -> tuple[Array, float]:
    """Level direction with the longest free way ahead, of sixteen, and its length.

    Args:
        scene: to move in.
        rng: turns the sixteen.
        position: ``(3,)``.
    """
    reach = np.linspace(0, 6 * scene.scale, 60)[1:]
    best = (np.array([0.0, 1.0, 0.0]), 0.0)
    for angle in rng.uniform(0, 2 * np.pi) + np.arange(16) * np.pi / 8:
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        blocked = scene.clearance(position + reach[:, None] * direction) < 0.08 * scene.scale
        free = float(reach[blocked.argmax()] if blocked.any() else reach[-1])
        if free > best[1]:
            best = (direction, free)
    return best


def _draw_loop(
    scene: Scene, rng: np.random.Generator, duration: float, speed: float, shake: float, follow: bool = False
) -> SplinePath:
    """Draw a rounded circuit of ``TURNS`` rounds: the second round repeats the first except for the shake.

    If the duration allows it the camera turns all the way round, else it looks about and returns to its first
    direction. If it is to ``follow`` the way, it always turns all the way round.
    """
    once = duration / TURNS
    steps = max(8, int(np.ceil(once / CONTROL_INTERVAL)))
    interval = once / steps
    count = int(np.ceil(duration / interval)) + 4
    radius = 0.1 * scene.scale * speed * once / (2 * np.pi)
    start = find_start(scene, rng, 2)
    spots = np.concatenate([start.position[None], rng.uniform(scene.bounds[0], scene.bounds[1], (40, 3))])
    spots[:, 2] = start.position[2]
    centre = spots[int(scene.clearance(spots).argmax())]
    room = np.minimum(centre - scene.bounds[0], scene.bounds[1] - centre)
    angle = rng.uniform(0, 2 * np.pi) + float(rng.choice([-1, 1])) * 2 * np.pi * np.arange(count) / steps
    phase = rng.uniform(0, 2 * np.pi, 3)
    bulge = 1 + 0.25 * np.cos(2 * angle + phase[0]) + 0.12 * np.cos(3 * angle + phase[1])
    offset = np.stack([np.cos(angle), np.sin(angle), 0.12 * np.sin(angle + phase[2])], -1) * bulge[:, None]
    position = centre + offset * np.minimum(radius, 0.6 * room)
    forward = start.rotation[:, 2]
    if follow or (once > 9 and rng.random() < 0.6):
        way = np.gradient(position, axis=0)
        yaw = np.unwrap(np.arctan2(-way[:, 0], way[:, 1])) + rng.choice([0.0, -0.7, 0.7])
    else:
        yaw = yaw_towards(forward) + rng.uniform(0.5, 0.9) * np.sin(angle + phase[2])
    pitch = 0.7 * float(np.clip(np.arcsin(forward[2]), -0.5, 0.4)) + 0.06 * np.sin(2 * angle + phase[0])
    control = np.column_stack([position, yaw, pitch, 0.02 * np.sin(angle + phase[1])])
    return SplinePath("loop", control, interval, *_shake(scene, rng, shake, False))
