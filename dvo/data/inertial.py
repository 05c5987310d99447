"""Samples of an inertial measurement unit, and the noise in them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.files import MAX_NUMBER

LONGEST_ARM = 10.0
"""Metres from camera to sensor: numbers above it are millimetres."""
LEAST_NOISE, MOST_NOISE = 1e-12, 1e6
"""Bounds of each number of :class:`ImuNoise`: without noise the information of a measurement is infinite."""


@dataclass(frozen=True)
class ImuNoise:
    """Noise densities; the defaults are those of the ADIS16448 in EuRoC's calibration (Burri et al., 2016).

    Attributes:
        gyro: rad/s/sqrt(Hz).
        gyro_walk: rad/s^2/sqrt(Hz).
        accel: m/s^2/sqrt(Hz).
        accel_walk: m/s^3/sqrt(Hz).
        gyro_bias, accel_bias: standard deviation of the initial bias, rad/s and m/s^2.

    Raises:
        DvoError: no numbers within :data:`LEAST_NOISE` and :data:`MOST_NOISE`.
    """

    gyro: float = 1.6968e-4
    gyro_walk: float = 1.9393e-5
    accel: float = 2.0e-3
    accel_walk: float = 3.0e-3
    gyro_bias: float = 2e-3
    accel_bias: float = 2e-2

    def __post_init__(self) -> None:
        for name in fields(self):
            value = getattr(self, name.name)
            is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if not is_number or not LEAST_NOISE <= value <= MOST_NOISE:
                remedy = f"give a number above 0, {LEAST_NOISE:g} to {MOST_NOISE:g}"
                raise DvoError(f"is {str(value)[:60]}", field=f"inertial: noise.{name.name}", remedy=remedy)


NOISE_PRESETS: dict[str, ImuNoise] = {
    "euroc": ImuNoise(),
    "action": ImuNoise(1e-3, 1e-4, 1e-2, 5e-3, 2e-2, 0.1),
    "phone": ImuNoise(1.7e-3, 1.9e-4, 2e-2, 3e-2, 2e-2, 0.2),
}
"""Noise by the kind of the device; ``phone``, ten times that of EuRoC's sensor, is assumed where none is stated."""


@dataclass(frozen=True)
class InertialSamples:
    """Samples of an inertial measurement unit, in its own axes.

    Attributes:
        timestamps: ``(K,)`` float64 seconds, strictly increasing, on the clock of the frames.
        gyro: ``(K, 3)`` float64 angular rates, rad/s.
        accel: ``(K, 3)`` float64 specific forces, m/s^2 (gravity included).
        T_camera_imu: ``(7,)`` float64 ``tx ty tz qx qy qz qw``, inertial sensor to camera, or None if not calibrated.
        noise: of the sensor, or None if it is not stated.
        origin: what all samples of a recording come from, for messages, such as ``imu0/data.csv``.
        notes: repairs and guesses of the reader, a sentence each.

    What NumPy reads as numbers is converted.

    Raises:
        DvoError: not numbers, or shapes that do not match.
    """

    timestamps: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    T_camera_imu: np.ndarray | None = None
    noise: ImuNoise | None = None
    origin: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("timestamps", "gyro", "accel", "T_camera_imu"):
            value = getattr(self, name)
            if value is not None or name != "T_camera_imu":
                object.__setattr__(self, name, _numbers(value, name))
        if self.timestamps.ndim != 1 or not self.gyro.shape == self.accel.shape == (*self.timestamps.shape, 3):
            raise DvoError(
                f"times {self.timestamps.shape}, gyro {self.gyro.shape} and accel {self.accel.shape} do not match",
                field="inertial",
                remedy="give (K,), (K, 3) and (K, 3) arrays",
            )
        if self.T_camera_imu is not None and self.T_camera_imu.shape != (7,):
            raise DvoError(
                f"shape {self.T_camera_imu.shape}", field="inertial: T_camera_imu",
                remedy="give tx ty tz qx qy qz qw, inertial sensor to camera",
            )  # fmt: skip
        if not isinstance(self.noise, ImuNoise | None):
            remedy = "give dvo.data.inertial.ImuNoise(...), or None"
            raise DvoError(f"got {type(self.noise).__name__}", field="inertial: noise", remedy=remedy)

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def rate(self) -> float:
        """Samples a second, by the median of the intervals; NaN of fewer than two."""
        return 1.0 / float(np.median(np.diff(self.timestamps))) if len(self) > 1 else float("nan")

    def between(self, after: float, until: float) -> InertialSamples:
        """Samples with ``after < time <= until``.

        Args:
            after, until: seconds.
        """
        first, last = np.searchsorted(self.timestamps, [after, until], side="right")
        part = slice(int(first), int(last))
        return InertialSamples(self.timestamps[part], self.gyro[part], self.accel[part], self.T_camera_imu, self.noise)


def checked_samples(samples: object) -> InertialSamples:
    """Check samples that a caller gives.

    Args:
        samples: to check.

    Returns:
        The same object.

    Raises:
        DvoError: another type, times that do not increase, values that are not finite or out of bounds, or no pose.
    """
    if not isinstance(samples, InertialSamples):
        raise DvoError(
            f"expected InertialSamples, got {type(samples).__name__}", field="inertial",
            remedy="give dvo.data.inertial.InertialSamples(timestamps, gyro, accel, T_camera_imu), or None",
        )  # fmt: skip
    pose = samples.T_camera_imu
    if pose is not None and not (np.isfinite(pose).all() and abs(np.linalg.norm(pose[3:]) - 1) < 0.01):
        remedy = "give metres and a unit quaternion"
        raise DvoError(f"{pose} is not a pose", field="inertial: T_camera_imu", remedy=remedy)
    if pose is not None and np.linalg.norm(pose[:3]) > LONGEST_ARM:
        message = f"the sensor is {np.linalg.norm(pose[:3]):.4g} m from the camera"
        raise DvoError(message, field="inertial: T_camera_imu", remedy="give metres")
    for name in ("timestamps", "gyro", "accel") if len(samples) else ():
        rows = getattr(samples, name).reshape(len(samples), -1)
        wrong = ~(np.abs(rows) <= MAX_NUMBER).all(axis=1)  # also nan
        if wrong.any():
            at = int(wrong.argmax())
            message = f"is {rows[at].tolist()} at sample {at}: values are not finite, or no measurements"
            raise DvoError(message, field=f"inertial: {name}", remedy="leave out such samples")
    back = np.diff(samples.timestamps) <= 0
    if back.any():
        at = int(back.argmax())
        pair = " and ".join(f"{time:.6f}" for time in samples.timestamps[at : at + 2])
        message = f"times do not increase: {pair} s at samples {at} and {at + 1}"
        remedy = "sort samples by time, and leave out repeated ones"
        raise DvoError(message, field="inertial: timestamps", remedy=remedy)
    return samples


def _numbers(value: object, name: str) -> np.ndarray:
    """A float64 array; the value itself if it is one."""
    try:
        found = np.asarray(value)
        if found.dtype.kind not in "fiu":
            raise TypeError(f"{found.dtype} is no number")
        return found.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise DvoError(f"not numbers ({error})", field=f"inertial: {name}", remedy="give an array of floats") from error
