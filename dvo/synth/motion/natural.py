"""Cameras in a hand and on a quadrotor, with the spectrum of real motion, in metres, seconds and degrees.

A motion is a route (uniform cubic B-spline of waypoints in free space) to which band-limited Gaussian processes are
added: the gaze that wanders (0.05 to 0.5 Hz), the sway of the arm, steps (1.5 to 2.1 Hz), and the tremor of the hand
(0.5 to 8 Hz). The power spectral density of a process falls as ``f^-slope``. With slope 3 of position and angle the
density of velocity falls as ``1/f``, and that of acceleration grows to the upper end of the band, as with a hand
(Stiles, "Frequency and displacement amplitude relations for normal hand tremor", 1976). A quadrotor flies legs, hovers,
and tilts by the acceleration that it needs: ``tan(tilt) = a / g``. The sum is sampled at :data:`RATE` and is again a
uniform cubic B-spline, so that accelerations are continuous.

Four kinds begin with a stretch that tells less than all, and have another one later (:func:`stretches`); both are
followed by ordinary motion of a hand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dvo.core.errors import DvoError
from dvo.synth import salts
from dvo.synth.motion.motion import SplinePath
from dvo.synth.motion.paths import find_start
from dvo.synth.motion.walks import longest_way, nearest_turn, openness, yaw_towards
from dvo.synth.scenes.scene import Scene

Array = np.ndarray
DEGENERATE = ("still", "constant", "turning", "one_axis")
NATURAL_KINDS = ("hand", "hand_fast", "quadrotor", *DEGENERATE)
RATE = 50.0
"""Control points of a motion a second."""
LEAD = 0.5
"""Seconds before the first frame and after the last one that a motion covers: a shutter opens before the time of its
frame, and inertial samples surround the frames."""
GRAVITY = 9.81
_HELD = 0.1  # seconds on either side of a stretch in which it is already whole, as control points reach that far
_EASE = 0.8  # seconds in which a stretch passes into ordinary motion


@dataclass(frozen=True)
class Style:
    """How a carrier moves.

    Attributes:
        pace: range of the mean speed along the route, m/s.
        waypoint: seconds between waypoints.
        turn: largest rate at which the route turns the camera, degrees/s.
        climb: share of the vertical in the direction of a leg.
        room: distance to surfaces that waypoints keep, metres.
        gaze: standard deviation of yaw, pitch and roll about the route, degrees.
        gaze_band: Hz.
        sway: standard deviation of the position about the route, metres.
        sway_band: Hz.
        step: standard deviation of the vertical motion of steps, metres.
        tremor: standard deviations of position (metres) and of each angle (degrees).
        tremor_band: Hz.
    """

    pace: tuple[float, float]
    waypoint: float
    turn: float
    climb: float
    room: float
    gaze: tuple[float, float, float]
    gaze_band: tuple[float, float]
    sway: float
    sway_band: tuple[float, float]
    step: float
    tremor: tuple[float, float]
    tremor_band: tuple[float, float]


HAND = Style(
    pace=(0.3, 1.0), waypoint=0.8, turn=45.0, climb=0.12, room=0.45, gaze=(19.8, 8.485, 4.243), gaze_band=(0.05, 0.5),
    sway=0.07071, sway_band=(0.15, 0.8), step=0.005657, tremor=(0.002828, 1.1314), tremor_band=(0.5, 8.0),
)  # fmt: skip
HASTY = replace(
    HAND, pace=(0.6, 1.3), gaze=(33.94, 12.728, 9.9), gaze_band=(0.3, 1.3), sway=0.14142, sway_band=(0.3, 1.2)
)  # fmt: skip
QUADROTOR = Style(
    pace=(0.7, 1.6), waypoint=1.0, turn=60.0, climb=0.35, room=0.6, gaze=(5.657, 2.828, 0.7071),
    gaze_band=(0.05, 0.4), sway=0.04243, sway_band=(0.1, 0.6), step=0.0, tremor=(0.0005657, 0.35355),
    tremor_band=(2.0, 10.0),
)  # fmt: skip


def band_limited(
    rng: np.random.Generator, times: Array, band: tuple[float, float], slope: float, columns: int
) -> Array:
    """Stationary Gaussian processes of unit variance, band-limited.

    White noise is shaped in the frequency domain, over twice the time so that ends are independent.

    Args:
        rng: draws the noise.
        times: ``(T,)`` evenly spaced, seconds.
        band: lower and upper end, Hz; the upper one below the Nyquist frequency.
        slope: the power spectral density is proportional to ``f^-slope`` within the band.
        columns: number of processes.

    Returns:
        ``(T, columns)``.
    """
    count = max(2 * len(times), 4 * int(np.ceil(1 / (band[0] * (times[1] - times[0])))))
    frequency = np.fft.rfftfreq(count, times[1] - times[0])
    inside = (frequency >= band[0]) & (frequency <= band[1])
    shape = np.where(inside, np.maximum(frequency, band[0]) ** (-slope / 2), 0.0)
    shape *= count / np.sqrt(2 * (shape**2).sum())
    phases = rng.normal(size=(len(frequency), columns, 2)) / np.sqrt(2)
    spectrum = shape[:, None] * (phases[..., 0] + 1j * phases[..., 1])
    return np.fft.irfft(spectrum, count, axis=0)[: len(times)]


def stretches(kind: str, duration: float) -> tuple[tuple[float, float], ...]:
    """Stretches of a degenerate kind that tell less than all: begin and end, seconds; none of other kinds.

    Args:
        kind: one of :data:`NATURAL_KINDS`.
        duration: seconds.
    """
    return ((0.0, 0.27 * duration), (0.6 * duration, 0.8 * duration)) if kind in DEGENERATE else ()


def bursts(kind: str, duration: float) -> tuple[tuple[float, float], ...]:
    """Stretches of haste of the kind ``hand_fast``: begin and end, seconds; none of other kinds.

    Args:
        kind: one of :data:`NATURAL_KINDS`.
        duration: seconds.
    """
    return tuple((at, at + 3.0) for at in np.arange(6.0, duration - 3.5, 6.0)) if kind == "hand_fast" else ()


def natural_path(
    scene: Scene, seed: int, kind: str, duration: float, *, speed: float = 1.0, shake: float = 1.0
) -> SplinePath:
    """Draw a motion that stays in free space all along.

    Args:
        scene: to move in, in metres.
        seed: same seed, same motion.
        kind: one of :data:`NATURAL_KINDS`.
        duration: seconds.
        speed: factor on the pace of the route.
        shake: factor on sway, steps and tremor.

    Returns:
        The motion, from :data:`LEAD` before time 0 to :data:`LEAD` after the end.

    Raises:
        DvoError: an unknown kind, or no room for such a motion.
    """
    if kind not in NATURAL_KINDS:
        raise DvoError(f"no motion {kind!r}", field="kind", remedy=f"choose one of {', '.join(NATURAL_KINDS)}")
    rng = np.random.default_rng([seed, salts.NATURAL_PATH])
    best: tuple[float, SplinePath] | None = None
    checked = np.linspace(0, duration, max(20, int(duration * 10)))
    for attempt in range(40):
        path = _draw(scene, rng, kind, duration, speed * 0.85 ** (attempt // 6), shake)
        if path is None or scene.clearance(path.poses_wc(checked)[:, :3]).min() < 0.15:
            continue
        score = openness(scene, path.poses_wc(checked[:: max(1, len(checked) // 16)]))
        if best is None or score > best[0]:
            best = (score, path)
        if score > 0.25:
            break
    if best is None:
        raise DvoError("found no free path through the scene", field="seed", remedy="try another seed or less speed")
    return best[1]


def _draw(
    scene: Scene, rng: np.random.Generator, kind: str, duration: float, speed: float, shake: float
) -> SplinePath | None:
    """Draw a motion, which may touch something; None without room for its stretches."""
    style = QUADROTOR if kind == "quadrotor" else HAND
    total = duration + 2 * LEAD
    held = [
        (begin + LEAD - _HELD if begin > 0 else 0.0, end + LEAD + _HELD) for begin, end in stretches(kind, duration)
    ]
    waypoints = _route(scene, rng, style, total, speed, kind, held)
    if waypoints is None:
        return None
    times = (np.arange(int(np.ceil(total * RATE)) + 3) - 1) / RATE
    state = _along(waypoints, style.waypoint, times)
    free = 1 - _within(times, held)
    tilt = _tilt(state, times) if kind == "quadrotor" else np.zeros((len(times), 2))
    looks = np.ones_like(free) if kind == "turning" else free
    moved, turned = _moved(rng, times, style, shake), _turned(rng, times, style)
    state = state + np.concatenate([free[:, None] * moved, looks[:, None] * turned], axis=1)
    state[:, 4:] += tilt
    hasty = _within(times, [(begin + LEAD, end + LEAD) for begin, end in bursts(kind, duration)])[:, None]
    if kind == "hand_fast":
        state += hasty * np.concatenate([_moved(rng, times, HASTY, shake), _turned(rng, times, HASTY)], axis=1)
    if kind == "one_axis":
        axis = np.append(rng.normal(size=2), 0.3 * rng.normal())
        swing = 0.1697 * band_limited(rng, times, (0.25, 0.9), 1.0, 1)
        state[:, :3] += (1 - free)[:, None] * swing * axis / np.linalg.norm(axis)
    none = np.zeros(0)
    return SplinePath(kind, state, 1 / RATE, none, np.zeros((0, 2, 6)), start=-LEAD)


def _moved(rng: np.random.Generator, times: Array, style: Style, shake: float) -> Array:
    """Displacement ``(T, 3)`` from the route, metres."""
    moved = style.sway * band_limited(rng, times, style.sway_band, 2.0, 3)
    moved[:, 2] += style.step * band_limited(rng, times, (1.5, 2.1), 0.0, 1)[:, 0]
    return shake * (moved + style.tremor[0] * band_limited(rng, times, style.tremor_band, 3.0, 3))


def _turned(rng: np.random.Generator, times: Array, style: Style) -> Array:
    """Yaw, pitch and roll ``(T, 3)`` about those of the route, rad."""
    turned = band_limited(rng, times, style.gaze_band, 1.0, 3) * style.gaze
    return np.radians(turned + style.tremor[1] * band_limited(rng, times, style.tremor_band, 3.0, 3))


def _within(times: Array, spans: list[tuple[float, float]]) -> Array:
    """1 within the spans and 0 away from them, with smooth (C2) edges outside of them; times as in :func:`_draw`."""
    share = np.zeros(len(times))
    for begin, end in spans:
        outside = np.maximum(begin - times, times - end) if begin > 0 else times - end
        away = np.clip(outside / _EASE, 0, 1)
        share = np.maximum(share, 1 - away**3 * (10 - 15 * away + 6 * away**2))
    return share


def _along(control: Array, interval: float, times: Array) -> Array:
    """Uniform cubic B-spline through control points ``(K, C)``, beginning at time 0; its ends are held."""
    place = np.clip(times / interval, 0, len(control) - 3 - 1e-9)
    index = place.astype(int)
    return (SplinePath.weights(place - index)[..., None] * control[index[:, None] + np.arange(4)]).sum(1)


def _tilt(state: Array, times: Array) -> Array:
    """Pitch and roll ``(T, 2)`` by which a quadrotor accelerates, rad."""
    step = times[1] - times[0]
    acceleration = np.gradient(np.gradient(state[:, :2], step, axis=0), step, axis=0)
    forward = np.stack([-np.sin(state[:, 3]), np.cos(state[:, 3])], -1)
    right = np.stack([forward[:, 1], -forward[:, 0]], -1)
    ahead, aside = ((acceleration * axis).sum(1) for axis in (forward, right))
    return np.stack([-np.arctan(ahead / GRAVITY), np.arctan(aside / GRAVITY)], -1)


def _route(
    scene: Scene, rng: np.random.Generator, style: Style, total: float, speed: float, kind: str,
    held: list[tuple[float, float]],
) -> Array | None:  # fmt: skip
    """Waypoints ``(K, 6)``: position, yaw, pitch, roll. Those that reach into a stretch are as its kind wants them."""
    count = int(np.ceil(total / style.waypoint)) + 4
    pace = speed * rng.uniform(*style.pace) * style.waypoint
    start = find_start(scene, rng, 2)
    low, high = scene.hints.get("focus", (scene.bounds[0], scene.bounds[1]))
    floor, ceiling = scene.hints.get("height", (scene.bounds[0, 2], scene.bounds[1, 2]))
    position, yaw = start.position.copy(), yaw_towards(start.rotation[:, 2])
    if not floor <= position[2] <= ceiling:
        position[2] = rng.uniform(floor, ceiling)
    direction, focus = _heading(rng, style), rng.uniform(low, high)
    pitch = (
        np.radians(-8.0) if kind == "quadrotor" else 0.5 * float(np.clip(np.arcsin(start.rotation[2, 2]), -0.5, 0.4))
    )
    legs = _legs(rng, count) if kind == "quadrotor" else rng.uniform(0.4, 1.5, count)
    spans = [(int(begin / style.waypoint), int(np.ceil(end / style.waypoint)) + 3) for begin, end in held]
    steady = np.zeros(3)
    control = np.zeros((count, 6))
    for i in range(count):
        stretch = next((span for span in spans if span[0] <= i <= span[1]), None)
        if stretch is not None and kind == "constant":
            if i == stretch[0]:
                way, room = longest_way(scene, rng, position)
                length = min(pace, 0.8 * room / (stretch[1] - stretch[0] + 2))
                if length < 0.12 * style.waypoint:
                    return None
                steady = way * length
                direction = way
            position = position + steady
        elif stretch is None:
            position, direction = _step(scene, rng, style, position, direction, pace * legs[i], (floor, ceiling))
        if stretch is None or kind == "turning":
            if rng.random() < 0.25:
                focus = rng.uniform(low, high)
            wanted = yaw_towards(direction if kind == "quadrotor" else focus - position)
            most = np.radians(style.turn) * style.waypoint
            yaw += float(np.clip(nearest_turn(wanted, yaw) - yaw, -most, most)) * (0.6 if kind == "quadrotor" else 1.0)
        control[i] = [*position, yaw, pitch, 0.0]
    return control


def _heading(rng: np.random.Generator, style: Style) -> Array:
    direction = rng.normal(size=3) * [1, 1, style.climb]
    return direction / np.linalg.norm(direction)


def _step(
    scene: Scene, rng: np.random.Generator, style: Style, position: Array, direction: Array, length: float,
    heights: tuple[float, float],
) -> tuple[Array, Array]:  # fmt: skip
    """Next waypoint and direction: onwards, or another way if that is not free."""
    for _ in range(24):
        trial, ahead = position + direction * length, position + direction * max(2.5 * length, 2 * style.room)
        if heights[0] <= ahead[2] <= heights[1] and scene.clearance(np.stack([trial, ahead])).min() > style.room:
            break
        direction = _heading(rng, style)
    else:
        return position, direction
    bent = direction + rng.normal(0, 0.25, 3) * [1, 1, style.climb]
    return trial, bent / np.linalg.norm(bent)


def _legs(rng: np.random.Generator, count: int) -> Array:
    """Share of the pace at every waypoint of a quadrotor: legs of 3 to 6 waypoints, each ended by a hover of 1 to 3."""
    shares: list[float] = []
    while len(shares) < count:
        shares += [float(rng.uniform(0.7, 1.3))] * int(rng.integers(3, 7)) + [0.0] * int(rng.integers(1, 4))
    return np.array(shares[:count])
