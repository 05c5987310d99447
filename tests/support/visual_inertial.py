"""A visual trajectory of random motion with noise, in a world and a unit of its own, and the samples of a sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dvo.data.inertial import NOISE_PRESETS, InertialSamples
from dvo.geometry.poses import matrix_to_quaternion, quaternion_to_matrix, rotation_vector, so3_exp
from dvo.odometry.inertial.smoother import GRAVITY, SHIFTED, Smoother, VisualNodes

Array = np.ndarray
RATE = 1000
CAMERA_IMU = quaternion_to_matrix(np.array([0.5, -0.5, 0.5, -0.5])) @ so3_exp(np.array([0.02, -0.01, 0.03]))
SHIFT = np.array([0.05, -0.02, 0.03])
LEVER = -CAMERA_IMU.T @ SHIFT
SCALE = 0.37
DEPTH = 2.0
OFFSET = 0.004


@dataclass(frozen=True)
class Recording:
    """Poses by images and samples, with the truth.

    Attributes:
        samples: of the sensor, whose clock is ``OFFSET`` ahead.
        times: ``(N,)`` of the frames.
        rotation, position: of the camera in the world of the images, whose unit has ``SCALE`` metres.
        turn: ``(3, 3)`` from the true world to that of the images.
        body: true rotation, position and velocity of the sensor at the frames.
    """

    samples: InertialSamples
    times: Array
    rotation: Array
    position: Array
    turn: Array
    body: tuple[Array, Array, Array]

    def nodes(self, start: float, end: float, step: int = 4) -> VisualNodes:
        """Every few frames of an interval, its first and its last one."""
        inside = np.flatnonzero((self.times >= start) & (self.times <= end))
        chosen = np.union1d(inside[inside % step == 0], inside[[0, -1]])
        none = np.zeros(len(chosen), int)
        depth = np.full(len(chosen), DEPTH / SCALE)
        return VisualNodes(self.times[chosen], none, self.rotation[chosen], self.position[chosen], depth)

    def problem(self, start: float, end: float) -> Smoother:
        """Problem of an interval."""
        noise = self.samples.noise
        assert noise is not None
        return Smoother(self.nodes(start, end), self.samples, noise, CAMERA_IMU, LEVER)

    def with_samples(
        self, times: Array | None = None, gyro: Array | None = None, accel: Array | None = None
    ) -> Recording:
        """The same with other samples."""
        s = self.samples
        changed = InertialSamples(
            s.timestamps if times is None else times, s.gyro if gyro is None else gyro,
            s.accel if accel is None else accel, s.T_camera_imu, s.noise,
        )  # fmt: skip
        return replace(self, samples=changed)


def record(seed: int, *, still: float = 0.0, speed: tuple[float, float, float] = (0, 0, 0), grade: str = "euroc",
           seconds: float = 14.0, turning: bool = True, drift: float = 0.0, swing: float = 0.0,
           walk: float = 0.0, unit: float = 0.0, reach: float = 0.25, arm: float = 0.0) -> Recording:  # fmt: skip
    """Recording of a hand that moves about.

    Images tell a turn and a shift sideways apart by parallax alone: a wrong orientation comes with a wrong place.

    Args:
        seed: of everything.
        still: seconds without acceleration at the beginning.
        speed: of a constant motion beside, m/s.
        grade: of the noise.
        seconds: length.
        turning: it rotates before ``still`` has passed, too.
        drift: change of the logarithm of the unit of the images in a second.
        swing: motion along one axis before ``still`` has passed, metres.
        walk: random walk of the orientation of the images, rad in the root of a second.
        unit: random walk of the logarithm of their unit, in the root of a second.
        reach: deviation of the place, metres.
        arm: from a point that the camera turns about to it, along its axis, metres.
    """
    rng, further = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    count = int(seconds * RATE) + 1
    time = np.arange(count) / RATE
    rise = np.clip((time - still + 1) / 2, 0, 1)[:, None] if still else np.ones((count, 1))
    rise = rise**3 * (10 - 15 * rise + 6 * rise**2)
    path = reach * _wander(rng, count) * rise + np.outer(time, speed)
    if swing:
        axis = further.normal(size=3)
        path = path + swing * _wander(further, count)[:, :1] * (1 - rise) * axis / np.linalg.norm(axis)
    turns = 0.35 * _wander(rng, count) * (1 if turning else rise)
    camera = so3_exp(turns)
    path = path + arm * camera[..., 2]
    rotation, position = camera @ CAMERA_IMU, path - camera @ CAMERA_IMU @ LEVER
    velocity = np.gradient(position, 1 / RATE, axis=0, edge_order=2)
    speeding = np.gradient(velocity, 1 / RATE, axis=0, edge_order=2)
    rates = np.zeros_like(path)
    rates[1:-1] = rotation_vector(np.swapaxes(rotation[:-2], -1, -2) @ rotation[2:]) * RATE / 2
    forces = (np.swapaxes(rotation, -1, -2) @ (speeding - GRAVITY)[..., None])[..., 0]
    noise, every = NOISE_PRESETS[grade], slice(5, -5, 5)
    stamps, step = time[every], 5 / RATE

    def measured(values: Array, density: float, walk: float, first: float) -> Array:
        bias = rng.normal(0, first, 3) + np.cumsum(rng.normal(0, walk * np.sqrt(step), (len(stamps), 3)), 0)
        return values[every] + bias + rng.normal(0, density / np.sqrt(step), (len(stamps), 3))

    gyro = measured(rates, noise.gyro, noise.gyro_walk, noise.gyro_bias)
    accel = measured(forces, noise.accel, noise.accel_walk, noise.accel_bias)
    extrinsic = np.concatenate([SHIFT, matrix_to_quaternion(CAMERA_IMU)])
    frames = np.arange(100, count - 100, 50)
    turn = so3_exp(rng.normal(size=3))
    drifted = turn @ camera[frames]  # each step of the camera, and an error that stays
    spans = np.sqrt(np.diff(time[frames]))[:, None]
    errors = so3_exp(walk * spans * further.normal(size=(len(spans), 3)))
    for k, error in enumerate(errors):
        step = camera[frames[k]].T @ camera[frames[k + 1]]
        drifted[k + 1] = drifted[k] @ step @ error
    wrong = rng.normal(0, 1e-3, (len(frames), 3))
    seen, shifts = drifted @ so3_exp(wrong), SHIFTED * DEPTH * np.cross([0.0, 0.0, 1.0], wrong)
    logs = drift * (time[frames] - time[frames[0]])
    logs[1:] += np.cumsum(unit * spans[:, 0] * further.normal(size=len(spans)))
    steps = np.diff(path[frames], axis=0, prepend=path[frames[:1]]) * np.exp(-logs)[:, None]
    bent = drifted @ np.swapaxes(turn @ camera[frames], -1, -2) @ turn
    steps[0] = path[frames[0]]
    shown = np.cumsum((bent @ steps[..., None])[..., 0], 0)
    noise_of_places = rng.normal(0, 1e-3 * DEPTH, (len(frames), 3)) @ turn.T
    places = (shown + noise_of_places + (drifted @ shifts[..., None])[..., 0]) / SCALE
    samples = InertialSamples(stamps + OFFSET, gyro, accel, extrinsic, noise)
    return Recording(samples, time[frames], seen, places, turn, (rotation[frames], position[frames], velocity[frames]))


def _wander(rng: np.random.Generator, count: int) -> Array:
    """``(count, 3)`` random signal below 4 Hz with a deviation of 1."""
    frequency = np.fft.rfftfreq(count, 1 / RATE)
    size = (frequency > 0) * (frequency < 4) / np.maximum(frequency, 0.1) ** 1.5
    spectrum = rng.normal(size=(3, len(size))) + 1j * rng.normal(size=(3, len(size)))
    signal = np.fft.irfft(spectrum * size, count).T
    return signal / signal.std(0)
