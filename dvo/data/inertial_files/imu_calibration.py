"""Calibration of an inertial sensor: Kalibr's ``imu.yaml`` and ``camchain-imucam.yaml``, EuRoC's ``sensor.yaml``, or a
plain YAML file."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.yaml_files import read_text
from dvo.data.calibration.documents import load_yaml
from dvo.data.extrinsics import pose_of_numbers
from dvo.data.files.files import is_file
from dvo.data.inertial import LEAST_NOISE, LONGEST_ARM, NOISE_PRESETS, ImuNoise, InertialSamples
from dvo.geometry.poses import compose_poses, invert_poses

NOISE_FACTOR = 1.0
"""Factor of stated densities where ``noise_factor`` is not given. The values of published data sets and of our presets
hold in practice; those of a data sheet or of an Allan deviation leave out vibration, temperature, scale and alignment,
and authors multiply them by 10 to 100: state ``noise_factor: 10`` for them."""

_REMEDY = (
    "give Kalibr's imu.yaml or camchain-imucam.yaml, EuRoC's sensor.yaml, or a YAML file with noise or preset, "
    f"T_camera_imu, time_offset, noise_factor; or the name of a preset: {', '.join(NOISE_PRESETS)}"
)
_DENSITIES = {
    "gyroscope_noise_density": "gyro",
    "gyroscope_random_walk": "gyro_walk",
    "accelerometer_noise_density": "accel",
    "accelerometer_random_walk": "accel_walk",
}
"""Names of Kalibr and of EuRoC's ``sensor.yaml``; units rad/s/sqrt(Hz), rad/s^2/sqrt(Hz), m/s^2/sqrt(Hz) and
m/s^3/sqrt(Hz)."""
_LARGEST = 1e30  # of a number
_OWN = {field.name for field in fields(ImuNoise)}
_OTHER = re.compile(  # entries of the same files that say nothing of the inertial sensor
    r"^(rostopic|update_rate|rate_hz|sensor_type|comment|cam_overlaps|camera_model|distortion_\w+|intrinsics|resolution|"
    r"T_cn_cnm1|line_delay|frequency)$"
)
_LOOKS = re.compile(
    r"^[tpqr]_|_[tqr]_|^t[a-z]{1,2}$|^t_?(cb|bc|ic|ci)[0-9]?$|^dt$|imu|gyr|acc|noise|walk|densit|bias|offset|shift|delay|latenc|"
    r"lag(_|$)|factor|scale|misalign|gravity|extrinsic|preset|rot|trans|lever|pose|sigma|var|std|^[mac]$|quat",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class ImuCalibration:
    """What is known of an inertial sensor besides its samples; None for what is not stated.

    Attributes:
        noise: the stated densities times ``noise_factor``.
        T_camera_imu: ``(7,)`` float64 ``tx ty tz qx qy qz qw``, inertial sensor to camera (Kalibr's ``T_cam_imu``).
        time_offset: seconds by which the clock of the sensor is ahead, ``t_imu = t_cam + time_offset``.
    """

    noise: ImuNoise | None = None
    T_camera_imu: np.ndarray | None = None
    time_offset: float | None = None

    def over(self, other: ImuCalibration) -> ImuCalibration:
        """This calibration, completed by another one where it states nothing.

        Args:
            other: of the same sensor.
        """
        return ImuCalibration(
            self.noise if self.noise is not None else other.noise,
            self.T_camera_imu if self.T_camera_imu is not None else other.T_camera_imu,
            self.time_offset if self.time_offset is not None else other.time_offset,
        )

    def applied(self, samples: InertialSamples) -> InertialSamples:
        """Samples with this calibration, at times of the camera; what it does not state stays.

        Args:
            samples: at times of the inertial sensor.
        """
        return replace(
            samples,
            timestamps=samples.timestamps - (self.time_offset or 0.0),
            T_camera_imu=samples.T_camera_imu if self.T_camera_imu is None else self.T_camera_imu,
            noise=samples.noise if self.noise is None else self.noise,
        )


def read_imu_calibration(given: str | Path | Sequence[str | Path]) -> ImuCalibration:
    """Read the calibration of an inertial sensor, of one file or of several that complete each other.

    Args:
        given: file, ``FILE:N`` for camera N of a camchain (the first by default), or the name of one of
            :data:`dvo.data.inertial.NOISE_PRESETS`; or several of them. EuRoC's ``sensor.yaml`` of the camera and that
            of the inertial sensor place both on one body (``T_BS``).

    Raises:
        DvoError: nothing of that name; a file that states nothing of an inertial sensor; numbers that cannot be; an
            entry that looks like calibration and was not used; two files that state the same.
    """
    found, files = ImuCalibration(), [str(one) for one in ([given] if isinstance(given, str | Path) else given)]
    bodies: dict[str, tuple[str, np.ndarray]] = {}
    for one in files:
        new, body = _read(one)
        if body is not None and body[0] in bodies:
            raise DvoError("is stated twice", file=one, field="T_BS", remedy="give one camera, and one inertial sensor")
        bodies |= {} if body is None else {body[0]: (one, body[1])}
        for name in ("noise", "T_camera_imu", "time_offset"):
            if getattr(new, name) is not None and getattr(found, name) is not None:
                raise DvoError("is stated twice", file=one, field=name, remedy="leave out one of the files")
        found = new.over(found)
    return _on_one_body(bodies, found)


def _on_one_body(bodies: dict[str, tuple[str, np.ndarray]], found: ImuCalibration) -> ImuCalibration:
    """A calibration with what the poses of both sensors on one body tell."""
    camera, sensor = bodies.get("camera"), bodies.get("imu")
    if camera is None:
        if sensor is not None and found.noise is None and found.T_camera_imu is None and found.time_offset is None:
            raise DvoError("states nothing of an inertial sensor", file=sensor[0], remedy=_REMEDY)
        is_body = sensor is None or np.allclose(sensor[1], [0, 0, 0, 0, 0, 0, 1], atol=1e-9)
        if is_body or found.T_camera_imu is not None:
            return found
        assert sensor is not None
        message, file = "places the sensor on a body, whose pose in the camera is not stated", sensor[0]
        remedy = "give sensor.yaml of the camera too, or T_camera_imu in a YAML file"
        raise DvoError(message, file=file, field="T_BS", remedy=remedy)
    if sensor is None:
        message = "places the camera on a body, on which the inertial sensor has no place"
        raise DvoError(message, file=camera[0], field="T_BS", remedy="give sensor.yaml of the inertial sensor too")
    if found.T_camera_imu is not None:
        raise DvoError("is stated twice", file=camera[0], field="T_camera_imu", remedy="leave out one of the files")
    pose = compose_poses(invert_poses(camera[1]), sensor[1])
    _check_arm(pose, camera[0], "T_BS")
    return replace(found, T_camera_imu=pose)


def _check_arm(pose: np.ndarray, file: str | Path, field: str) -> None:
    if np.linalg.norm(pose[:3]) > LONGEST_ARM:
        message = f"the sensor is {np.linalg.norm(pose[:3]):.4g} m from the camera"
        raise DvoError(message, file=file, field=field, remedy="give metres")


def _read(given: str) -> tuple[ImuCalibration, tuple[str, np.ndarray] | None]:
    """What a file states; and a sensor, ``camera`` or ``imu``, with its pose on a body."""
    path, camera = Path(given), None
    if not is_file(path) and given in NOISE_PRESETS:
        return ImuCalibration(NOISE_PRESETS[given]), None
    head, _, number = given.rpartition(":")
    if not is_file(path) and head and number.isdigit():
        path, camera = Path(head), f"cam{int(number)}"
    data = load_yaml(read_text(path, _REMEDY), path)
    if not isinstance(data, dict):
        raise DvoError("no mapping in it", file=path, remedy=_REMEDY)
    entries = _Entries(_flat(data, camera, path), path)
    found, on_body = _of_entries(entries), entries.pose("T_BS")
    entries.check_used()
    if found.T_camera_imu is not None:
        _check_arm(found.T_camera_imu, path, "T_camera_imu")
    kind = "camera" if entries.values.get("sensor_type", "") == "camera" or "camera_model" in entries.values else "imu"
    body = None if on_body is None else (kind, on_body)
    if found.noise is None and found.T_camera_imu is None and found.time_offset is None and body is None:
        raise DvoError("states nothing of an inertial sensor", file=path, remedy=_REMEDY)
    return found, body


def _flat(data: dict[Any, Any], camera: str | None, path: Path) -> dict[str, Any]:
    """Entries of one sensor: those at the top, and those of ``imu0`` or of a camera of Kalibr."""
    groups = {str(key): value for key, value in data.items() if re.fullmatch(r"(cam|imu)[0-9]+", str(key))}
    rest = {str(key): value for key, value in data.items() if str(key) not in groups}
    cameras = {key: value for key, value in groups.items() if key.startswith("cam")}
    imus = [value for key, value in groups.items() if key.startswith("imu")]
    chosen = camera or next(iter(sorted(cameras)), None)
    if camera is not None and camera not in cameras:
        there = ", ".join(sorted(cameras)) or "none"
        raise DvoError(f"no {camera} in it, but {there}", file=path, remedy="name a camera of the file, FILE:0")
    if len(imus) > 1:
        raise DvoError("several inertial sensors in it", file=path, remedy="give a file of one")
    for part in (part for part in imus if isinstance(part, dict)):
        if not _says_nothing(part.get("time_offset")):  # Kalibr's, to the first of several sensors
            message = "of a sensor in imu0 is that to another sensor, not to the camera"
            remedy = "give timeshift_cam_imu, or time_offset outside of imu0: t_imu = t_cam + time_offset"
            raise DvoError(message, file=path, field="time_offset", remedy=remedy)
        rest |= {str(key): value for key, value in part.items() if key != "time_offset"}
    entries = cameras.get(chosen) if chosen else None
    if isinstance(entries, dict):
        rest |= {str(key): value for key, value in entries.items()}
    return rest


class _Entries:
    """Entries of a file, each marked when it is used."""

    def __init__(self, values: dict[str, Any], path: Path) -> None:
        self.values, self.path, self.used = values, path, set[str]()

    def take(self, *names: str) -> Any:
        """Value of the one entry of these names that is there; None for none."""
        there = [name for name in names if self.values.get(name) is not None]
        self.used |= {name for name in names if name in self.values}
        if len(there) > 1:
            raise DvoError(f"and {there[1]} state the same", file=self.path, field=there[0], remedy="leave out one")
        return self.values[there[0]] if there else None

    def number(self, name: str, low: float) -> float | None:
        """Number of at least ``low``; None for none."""
        value = self.take(name)
        return None if value is None else _number(value, name, low, self.path)

    def pose(self, name: str) -> np.ndarray | None:
        """Rigid transformation of an entry; None for none."""
        value = self.take(name)
        if value is None:
            return None
        try:
            return pose_of_numbers(value.get("data") if isinstance(value, dict) else value, self.path)
        except DvoError as error:
            remedy = "give a rigid 4x4 matrix row by row, or 'x y z qx qy qz qw'"
            raise DvoError(error.message, file=self.path, field=name, remedy=remedy) from None

    def check_used(self) -> None:
        """Refuse entries that look like calibration and were not used."""
        for name, value in self.values.items():
            found = None if name in self.used else _unused(name, value)
            if found is not None:
                raise DvoError("is not used, though it looks like calibration", file=self.path, field=found[:80],
                               remedy=f"remove the entry, or {_REMEDY}")  # fmt: skip


def _unused(name: str, value: Any) -> str | None:
    """Name of an entry, or of one in a mapping or list, that looks like calibration; None for none."""
    if _OTHER.match(name) or _says_nothing(value):
        return None
    if _LOOKS.search(name):
        return name
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return next((f"{name}.{below}" for key, part in inner if isinstance(part, dict | list) or isinstance(key, str)
                 if (below := _unused(str(key), part)) is not None), None)  # fmt: skip


def _says_nothing(value: Any) -> bool:
    """True for an empty value, for zeros and for the identity, as for the misalignment of a sensor that has none."""
    try:
        numbers = np.array(value.get("data") if isinstance(value, dict) else value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return value is None or value is False or value == ""
    is_square = numbers.ndim == 2 and numbers.shape[0] == numbers.shape[1]
    return value is None or not numbers.any() or (is_square and np.array_equal(numbers, np.eye(len(numbers))))


def _number(value: Any, name: str, low: float, path: Path) -> float:
    if isinstance(value, str):  # YAML takes 1e-3 for a text
        with contextlib.suppress(ValueError):
            value = float(value)
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _LARGEST
    if not is_number or value < low:
        what = "a number" if low == -math.inf else f"a number above 0, at least {low:g}"
        raise DvoError(f"is {str(value)[:60]}", file=path, field=name, remedy=f"give {what}")
    return float(value)


def _of_entries(entries: _Entries) -> ImuCalibration:
    noise = _noise(entries)
    factor = entries.number("noise_factor", 1e-6)
    if factor is not None and noise is None:
        remedy = "state noise or preset too"
        raise DvoError("there is no noise that it multiplies", file=entries.path, field="noise_factor", remedy=remedy)
    if noise is not None:
        stated, times = noise, NOISE_FACTOR if factor is None else factor
        noise = _in_file(entries.path, lambda: scaled(stated, times))
    offset = entries.take("time_offset", "timeshift_cam_imu")
    if offset is not None:
        name = "time_offset" if "time_offset" in entries.values else "timeshift_cam_imu"
        offset = _number(offset, name, -math.inf, entries.path)
    return ImuCalibration(noise, _extrinsics(entries), offset)


def _extrinsics(entries: _Entries) -> np.ndarray | None:
    """``T_camera_imu`` of an entry of that meaning."""
    found = [(name, entries.pose(name)) for name in ("T_camera_imu", "T_cam_imu", "T_imu_cam", "T_imu_camera")]
    stated = [(name, pose) for name, pose in found if pose is not None]
    rest = entries.pose("T_i_b")  # Kalibr's, of the sensors of several in the first one
    if rest is not None and not np.allclose(rest, [0, 0, 0, 0, 0, 0, 1], atol=1e-9):
        raise DvoError("is not the identity", file=entries.path, field="T_i_b", remedy="give the file of one sensor")
    if len(stated) > 1:
        pair = [invert_poses(pose) if name.startswith("T_imu") else pose for name, pose in stated]
        off = compose_poses(pair[0], invert_poses(pair[1]))
        if not np.allclose(np.abs(off), [0, 0, 0, 0, 0, 0, 1], atol=1e-4):
            message = f"and {stated[1][0]} differ"
            raise DvoError(message, file=entries.path, field=stated[0][0], remedy="leave out one")
    if not stated:
        return None
    name, pose = stated[0]
    return invert_poses(pose) if name.startswith("T_imu") else pose


def _noise(entries: _Entries) -> ImuNoise | None:
    stated: dict[str, float] = {}
    for name, own in _DENSITIES.items():
        value = entries.number(name, LEAST_NOISE)
        if value is not None:
            stated[own] = value
    table = entries.take("noise")
    for name, value in _table(table, entries.path):
        stated[name] = _number(value, f"noise.{name}", LEAST_NOISE, entries.path)
    preset = entries.take("preset")
    if preset is not None and (not isinstance(preset, str) or preset not in NOISE_PRESETS):
        remedy = f"give one of {', '.join(NOISE_PRESETS)}"
        raise DvoError(f"no preset {str(preset)[:40]}", file=entries.path, field="preset", remedy=remedy)
    if preset is None and not stated:
        return None
    missing = [name for name in ("gyro", "gyro_walk", "accel", "accel_walk") if name not in stated]
    if preset is None and missing:
        remedy = "state all four densities, or a preset for the others"
        raise DvoError(f"{', '.join(missing)} of the noise is missing", file=entries.path, field="noise", remedy=remedy)
    base = NOISE_PRESETS[preset] if preset is not None else NOISE_PRESETS["phone"]  # initial biases are rarely stated
    return _in_file(entries.path, lambda: replace(base, **stated))


def _in_file(path: Path, made: Callable[[], ImuNoise]) -> ImuNoise:
    """The noise, or an error that names the file."""
    try:
        return made()
    except DvoError as error:
        field = str(error.field).removeprefix("inertial: ")
        raise DvoError(error.message, file=path, field=field, remedy=error.remedy) from None


def _table(table: Any, path: Path) -> Iterator[tuple[str, Any]]:
    if table is None:
        return
    if not isinstance(table, dict):
        raise DvoError("no mapping", file=path, field="noise", remedy=f"give {', '.join(sorted(_OWN))}")
    for name, value in table.items():
        if name not in _OWN:
            remedy = f"the names are {', '.join(sorted(_OWN))}"
            raise DvoError("no name of noise", file=path, field=f"noise.{str(name)[:40]}", remedy=remedy)
        yield str(name), value


def scaled(noise: ImuNoise, factor: float) -> ImuNoise:
    """Noise with all densities multiplied; the deviations of the initial biases stay.

    Args:
        noise: as stated.
        factor: of the densities.
    """
    return replace(
        noise,
        gyro=noise.gyro * factor,
        gyro_walk=noise.gyro_walk * factor,
        accel=noise.accel * factor,
        accel_walk=noise.accel_walk * factor,
    )


def read_noise(file: Path) -> ImuNoise | None:
    """Noise that a file of a data set states, without the rest of it.

    Args:
        file: EuRoC's ``sensor.yaml`` or Kalibr's ``imu.yaml``.

    Returns:
        None without the file, or if it states no densities.

    Raises:
        DvoError: densities that cannot be.
    """
    data = load_yaml(read_text(file, _REMEDY), file) if is_file(file) else None
    return _noise(_Entries(_flat(data, None, file), file)) if isinstance(data, dict) else None
