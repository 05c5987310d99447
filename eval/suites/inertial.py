"""Inertial streams of rendered sequences: what a sensor beside the camera measures, and the truth about it.

The rendering keeps exact samples (``inertial.npz``); noise, time offset and faults are added when a sequence is opened,
so that one rendering serves streams of any grade, and those that are faulty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.settings import Range, from_table
from dvo.data.inertial import NOISE_PRESETS, InertialSamples
from dvo.geometry.poses import pose_from, so3_exp

FILE = "inertial.npz"
RATE = 200.0  # samples a second
MARGIN = 0.3  # seconds before the first frame and after the last one with exact samples
MOUNT = 7702  # salt of the place of a sensor
LEVER = 0.04  # metres, standard deviation of the place of the sensor along each axis
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # x forward, y left, z up, of a camera
TILT = 3.0  # degrees, standard deviation about each axis of how the sensor is turned from that


@dataclass(frozen=True)
class Stream:
    """How a stream is measured.

    Attributes:
        noise: name in :data:`dvo.data.inertial.NOISE_PRESETS`.
        offset: seconds by which its stamps are later than the frames' clock would say.
        fault: name in :data:`FAULTS`; empty for none.
        seed: of noise and faults.
    """

    RANGES: ClassVar[dict[str, Range]] = {"offset": (-0.2, 0.2), "seed": (0, 2**53)}

    noise: str = "euroc"
    offset: float = 0.0
    fault: str = ""
    seed: int = 0


@dataclass(frozen=True)
class InertialTruth:
    """Truth about a stream, at the times of the frames.

    Attributes:
        timestamps: ``(N,)`` of the frames, seconds.
        velocity_w: ``(N, 3)`` of the sensor in the world, m/s; z of the world is up.
        gyro_bias, accel_bias: ``(N, 3)`` in the axes of the sensor, rad/s and m/s^2.
        T_camera_imu: ``(7,)`` sensor to camera.
        offset: see :class:`Stream`, seconds.
        stretches: ``(M, 2)`` begin and end of stretches of degenerate motion, seconds.
    """

    timestamps: np.ndarray
    velocity_w: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    T_camera_imu: np.ndarray
    offset: float
    stretches: np.ndarray

    def write(self, file: Path) -> None:
        """Write a file of arrays.

        Args:
            file: ends in ``.npz``.
        """
        np.savez(file, **vars(self))

    @classmethod
    def read(cls, file: Path) -> InertialTruth:
        """Read a file of :meth:`write`.

        Args:
            file: of arrays.
        """
        with np.load(file) as arrays:
            found = {name: arrays[name] for name in arrays.files}
        return cls(**{**found, "offset": float(found["offset"])})


def mount(seed: int) -> np.ndarray:
    """Pose ``(7,)`` of a sensor in the camera: a few centimetres away, its axes nearly forward, left and up.

    Args:
        seed: of the sequence.
    """
    rng = np.random.default_rng([seed, MOUNT])
    rotation = AXES @ so3_exp(np.radians(rng.normal(0, TILT, 3)))
    return pose_from(rotation, rng.normal(0, LEVER, 3))


def write_exact(folder: Path, sequence: Any, kind: str, duration: float) -> None:
    """Write the exact samples of a rendered sequence, without bias and noise.

    Args:
        folder: of the sequence.
        sequence: :class:`dvo.synth.SyntheticSequence` whose path goes on beyond its first and last frame.
        kind, duration: of its motion.
    """
    from dvo.synth.motion.natural import stretches
    from dvo.synth.render.shot import Offset

    T_camera_imu = mount(sequence.seed)
    exact = sequence.imu(RATE, T_camera_imu=T_camera_imu, margin=MARGIN)
    step = 1e-3
    path, frames = Offset(sequence.path, T_camera_imu), sequence.groundtruth.timestamps
    velocity = (path.poses_wc(frames + step)[:, :3] - path.poses_wc(frames - step)[:, :3]) / (2 * step)
    np.savez(
        folder / FILE, timestamps=exact.timestamps, gyro=exact.gyro, accel=exact.accel, frames=frames,
        velocity_w=velocity, T_camera_imu=T_camera_imu,
        stretches=np.array(stretches(kind, duration), float).reshape(-1, 2),
    )  # fmt: skip


def read_stream(folder: Path, options: dict[str, Any]) -> tuple[InertialSamples, InertialTruth]:
    """Samples of a rendered sequence as its sensor delivers them, and the truth about them.

    Args:
        folder: of the sequence.
        options: of :class:`Stream`.

    Raises:
        DvoError: the rendering has no samples, or an option is unknown or out of range.
    """
    from dvo.synth.sensors.imu import GRAVITY, Imu, with_noise

    file = folder / FILE
    stream = from_table(Stream, options, file)
    for name, known, field in ((stream.noise, NOISE_PRESETS, "noise"), (stream.fault, {"": None, **FAULTS}, "fault")):
        if name not in known:
            remedy = f"choose from {', '.join(filter(None, known))}"
            raise DvoError(f"unknown: {name!r}", file=file, field=field, remedy=remedy)
    if not file.is_file():
        raise DvoError("no inertial samples", file=file, remedy="choose a motion of dvo.synth.NATURAL_KINDS")
    with np.load(file) as arrays:
        exact = {name: arrays[name] for name in arrays.files}
    zero = np.zeros_like(exact["gyro"])
    noise = NOISE_PRESETS[stream.noise]
    measured = with_noise(
        Imu(exact["timestamps"], exact["gyro"], exact["accel"], zero, zero, GRAVITY), noise, stream.seed
    )
    frames = exact["frames"]
    gyro_bias, accel_bias = (
        np.stack([np.interp(frames, measured.timestamps, bias[:, k]) for k in range(3)], -1)
        for bias in (measured.gyro_bias, measured.accel_bias)
    )
    samples = InertialSamples(
        measured.timestamps + stream.offset, measured.gyro, measured.accel, exact["T_camera_imu"], noise
    )
    if stream.fault:
        samples = FAULTS[stream.fault](samples, np.random.default_rng([stream.seed, MOUNT]))
    return samples, InertialTruth(
        frames, exact["velocity_w"], gyro_bias, accel_bias, exact["T_camera_imu"], stream.offset, exact["stretches"]
    )


def _units(samples: InertialSamples, rng: np.random.Generator) -> InertialSamples:
    """Degrees a second and multiples of gravity, called rad/s and m/s^2."""
    return replace(samples, gyro=np.degrees(samples.gyro), accel=samples.accel / 9.81)


def _axes(samples: InertialSamples, rng: np.random.Generator) -> InertialSamples:
    """Two axes swapped, and so a third one turned round."""
    turn = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return replace(samples, gyro=samples.gyro @ turn, accel=samples.accel @ turn)


def _late(samples: InertialSamples, rng: np.random.Generator) -> InertialSamples:
    """Stamps that are 100 ms late."""
    return replace(samples, timestamps=samples.timestamps + 0.1)


def _missing(samples: InertialSamples, rng: np.random.Generator) -> InertialSamples:
    """A tenth of the samples lost, five in a row on average."""
    lost = np.zeros(len(samples), bool)
    while lost.mean() < 0.1:
        begin = int(rng.integers(len(samples)))
        lost[begin : begin + int(rng.geometric(0.2))] = True
    keep = ~lost
    return replace(samples, timestamps=samples.timestamps[keep], gyro=samples.gyro[keep], accel=samples.accel[keep])


def _dropped(samples: InertialSamples, rng: np.random.Generator) -> InertialSamples:
    """A sensor that fell after two fifths of the time: biases of 0.2 rad/s and 2 m/s^2 from then on."""
    axes = rng.normal(size=(2, 3))
    gyro, accel = (axes / np.linalg.norm(axes, axis=1, keepdims=True)) * [[0.2], [2.0]]
    after = (np.arange(len(samples)) > 0.4 * len(samples))[:, None]
    return replace(samples, gyro=samples.gyro + after * gyro, accel=samples.accel + after * accel)


def _drift(samples: InertialSamples, rng: np.random.Generator) -> InertialSamples:
    """A clock that gains 3 ms a second."""
    begin = samples.timestamps[0]
    return replace(samples, timestamps=begin + 1.003 * (samples.timestamps - begin))


FAULTS = {
    "units": _units, "axes": _axes, "late": _late, "missing": _missing, "dropped": _dropped, "drift": _drift,
}  # fmt: skip
"""Faults of a stream by name."""
