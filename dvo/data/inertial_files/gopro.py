"""Inertial samples and positions of a GoPro video, turned into the axes of its images.

GoPro names the axes of the camera, seen in the direction of view, X left, Y back and Z up (verified on a video of a
HERO5: rotations of the images against those of the gyroscope, gravity against the horizon). With x right, y down, z
forward of the images, ``(x, y, z) = (-X, -Z, -Y)``. The order of the numbers of a sample is stated by ``ORIN``, a small
letter for a negative axis; where it is not stated, it is that of the model (HERO5: Z X Y, Fusion: -Y X Z, HERO6 and
HERO7 Black: Y -X Z), and ``MTRX`` turns the numbers into Z X Y. The pose of other models in the camera is not known.

Times begin with the video and run by the clock of the camera (``STMP`` in microseconds or ``TICK`` in milliseconds),
relative to the exposures of frames where both are stated in microseconds. On a HERO5 the clock of the payloads differs
from it by 0.2 percent, and ``t_imu = t_cam - 0.032 s`` (cross-correlation): a constant offset is left to calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.inertial import NOISE_PRESETS, InertialSamples
from dvo.data.inertial_files.gpmf import Element, Payload, read_payloads, settings_of
from dvo.data.inertial_files.tidy import check_gravity, joined
from dvo.data.positions import Positions
from dvo.geometry.poses import poses_from_matrices

CAMERA_AXES = {"X": (-1.0, 0.0, 0.0), "Y": (0.0, 0.0, -1.0), "Z": (0.0, -1.0, 0.0)}
"""Axes of GoPro in those of the images."""

_USUAL = "ZXY"
_ORDERS = (("HERO5", _USUAL), ("FUSION", "yXZ"), ("HERO6", "YxZ"), ("HERO7BLACK", "YxZ"))  # where ORIN is not stated
_UNEVEN = 0.01  # seconds: samples that are off an even clock by more are placed payload by payload
_NO_STABILISATION = ("", "N", "N/A", "OFF", "NO")


@dataclass
class _Stream:
    """One stream of the camera in all payloads."""

    values: list[np.ndarray] = field(default_factory=list)
    stamps: list[float | None] = field(default_factory=list)  # seconds of the camera's clock
    starts: list[float] = field(default_factory=list)  # seconds in the video
    durations: list[float] = field(default_factory=list)
    is_fine: bool = True  # stamps in microseconds
    axes: np.ndarray | None = None  # (3, 3) numbers of a sample to axes of the images
    is_oriented: bool = True  # the axes are known


def read_gopro(file: Path, turned: int = 0, *, rough: bool = False) -> InertialSamples:
    """Inertial samples in the axes of the images, at times of the video.

    Args:
        file: video with telemetry.
        turned: degrees clockwise by which frames are turned to stand upright.
        rough: as they stand, for a check: neither sorted nor refused.

    Returns:
        The samples; ``T_camera_imu`` is the turn of the frames, without a lever arm, ``noise`` that of action cameras.

    Raises:
        DvoError: no telemetry, damaged telemetry, or one without gyroscope and accelerometer.
    """
    streams = _streams(str(file), file.stat().st_mtime_ns)
    for key, noun in (("GYRO", "gyroscope"), ("ACCL", "accelerometer")):
        if key not in streams or streams[key].axes is None:
            remedy = "give another file with --imu, or --imu none"
            raise DvoError(f"the telemetry has no {noun}", file=file, field="imu", remedy=remedy)
    base = _base(streams)
    (gyro_times, gyro), (accel_times, accel) = (_timed(streams[key], base) for key in ("GYRO", "ACCL"))
    samples = joined(gyro_times, gyro, accel_times, accel, file, f"telemetry of {file.name}", rough=rough)
    if not rough:
        check_gravity(samples, file, "give another file with --imu, or --imu none")
    T = np.eye(4)
    angle = np.radians(turned)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    known, notes = all(streams[key].is_oriented for key in ("GYRO", "ACCL")), samples.notes
    notes += () if known else (f"{samples.origin}: the axes of the sensors of this camera are not known",)
    return InertialSamples(
        samples.timestamps, samples.gyro, samples.accel, poses_from_matrices(T) if known else None,
        NOISE_PRESETS["action"], samples.origin, notes,
    )  # fmt: skip


def gopro_notes(file: Path) -> list[str]:
    """What the telemetry states of camera and lens that a person should know.

    Args:
        file: video with telemetry.
    """
    settings = settings_of(file)
    if not settings:
        return []
    model = settings.get("MINF", "GoPro")
    names = (("VFOV", "field of view"), ("ZFOV", "diagonal angle of view, degrees"), ("SROT", "readout, ms"))
    known = [f"{label} {settings[key]}" for key, label in names if key in settings]
    notes = [f"{model}: {', '.join(known)}"] if known else []
    stabilised = settings.get("EISE", settings.get("EISA", ""))
    if stabilised.upper() not in _NO_STABILISATION:
        how = settings.get("EISA", stabilised)
        notes.append(f"{model}: the video is stabilised ({how}), so that the images do not move as the sensors did")
    return notes


def read_gopro_positions(file: Path) -> Positions | None:
    """Positions of the satellite receiver of the camera.

    Args:
        file: video with telemetry.

    Returns:
        None if the telemetry has none.

    Raises:
        DvoError: no telemetry, or damaged telemetry.
    """
    payloads = read_payloads(file)
    rows: list[np.ndarray] = []
    fix: list[str] = []
    for payload in payloads:
        for stream in _camera_streams(payload):
            parts = {element.key: element for element in stream.children()}
            key = next((name for name in ("GPS9", "GPS5") if name in parts), None)
            if key is None:
                continue
            values = _scaled(parts[key], parts) if key == "GPS5" else _gps9(parts[key], parts)
            count = len(values)
            if not count or values.shape[1] < 3:
                continue
            if key == "GPS5":
                quality, dop = _first(parts, "GPSF", 0.0), _first(parts, "GPSP", np.nan) / 100
                states, precision = [int(quality)] * count, np.full(count, dop)
            else:
                states, precision = values[:, 8].astype(int).tolist(), values[:, 7]
            times = payload.start + payload.duration * np.arange(count) / count
            rows.append(np.column_stack([times, values[:, :3], precision]))
            fix += [{0: "none", 2: "2D", 3: "3D"}.get(state, str(state)) for state in states]
    if not rows:
        return None
    table = np.concatenate(rows)
    has_fix = np.array([state != "none" for state in fix])
    return Positions(
        table[:, 0], table[:, 1:3], table[:, 3], has_fix, tuple(fix), table[:, 4], "DOP", f"telemetry of {file.name}"
    )


def _first(parts: dict[str, Element], key: str, other: float) -> float:
    numbers = parts[key].numbers() if key in parts else np.zeros(0)
    return float(numbers.flat[0]) if numbers.size else other


def _gps9(element: Element, parts: dict[str, Element]) -> np.ndarray:
    """Latitude, longitude, altitude, two speeds, days, seconds, dilution and fix: seven integers of four bytes and two
    of two."""
    if element.size != 32:
        return np.zeros((0, 9))
    raw = np.frombuffer(element.data, np.dtype([("long", ">i4", 7), ("short", ">u2", 2)]))
    values = np.column_stack([raw["long"], raw["short"]]).astype(np.float64)
    scale = parts["SCAL"].numbers().ravel() if "SCAL" in parts else np.ones(1)
    return values / scale if len(scale) in (1, 9) and scale.all() else np.zeros((0, 9))


def _camera_streams(payload: Payload) -> list[Element]:
    """Streams of the camera itself: the device that has a gyroscope, else the first."""
    devices = [[child for child in device.children() if child.key == "STRM"] for device in payload.elements
               if device.key == "DEVC"]  # fmt: skip
    own = [streams for streams in devices if any(c.key == "GYRO" for stream in streams for c in stream.children())]
    return (own or devices or [[]])[0]


@lru_cache(maxsize=2)
def _streams(name: str, changed: int) -> dict[str, _Stream]:
    """Streams of gyroscope, accelerometer and exposures; the time of change makes an edited file another one."""
    found: dict[str, _Stream] = {}
    file = Path(name)
    model = settings_of(file).get("MINF", "")
    try:
        for payload in read_payloads(file):
            device = next((c.text() for d in payload.elements for c in d.children() if c.key == "DVNM"), "")
            for element in _camera_streams(payload):
                _add(found, payload, element, model or device)
    except ValueError as error:
        message = f"the telemetry is damaged ({' '.join(str(error).split())[:100]})"
        raise DvoError(message, file=file, field="imu", remedy="copy the file again, or --imu none") from None
    return found


def _add(found: dict[str, _Stream], payload: Payload, element: Element, model: str) -> None:
    parts = {part.key: part for part in element.children()}
    key = next((name for name in ("GYRO", "ACCL", "SHUT") if name in parts), None)
    if key is None:
        return
    values = _scaled(parts[key], parts)
    if key != "SHUT" and (values.ndim != 2 or values.shape[1] != 3):
        raise ValueError(f"{key} has {values.shape[1]} numbers a sample")
    stream = found.setdefault(key, _Stream())
    stream.values.append(values)
    stream.starts.append(payload.start)
    stream.durations.append(payload.duration)
    stamp = _first(parts, "STMP", np.nan) / 1e6
    if not np.isfinite(stamp):
        stream.is_fine = False
        stamp = _first(parts, "TICK", np.nan) / 1e3
    stream.stamps.append(stamp if np.isfinite(stamp) else None)
    if key != "SHUT" and stream.axes is None:
        stream.axes, stream.is_oriented = _axes(parts, model)


def _axes(parts: dict[str, Element], model: str) -> tuple[np.ndarray, bool]:
    """``(3, 3)`` numbers of a sample to axes of the images, and whether they are known."""
    order = parts["ORIN"].text() if "ORIN" in parts else ""
    matrix = parts["MTRX"].numbers() if "MTRX" in parts else np.zeros(0)
    name = model.upper().replace(" ", "")
    if order:
        return _of_letters(order, "ORIN"), True
    if matrix.size == 9:
        turn = matrix.reshape(3, 3)
        if not np.allclose(turn @ turn.T, np.eye(3), atol=0.05):
            raise ValueError("MTRX is no rotation")
        return _of_letters(parts["ORIO"].text() if "ORIO" in parts else _USUAL, "ORIO") @ turn, True
    order = _USUAL if name in ("", "CAMERA") else next((axes for part, axes in _ORDERS if part in name), "")
    return _of_letters(order or _USUAL, "ORIN"), bool(order)


def _of_letters(order: str, key: str) -> np.ndarray:
    """``(3, 3)`` numbers in an order of GoPro's axes to axes of the images; a small letter is a negative axis."""
    if sorted(order.upper()) != ["X", "Y", "Z"]:
        raise ValueError(f"{key} {order[:10]!r} is no order of axes")
    return np.stack([np.array(CAMERA_AXES[c.upper()]) * (1 if c.isupper() else -1) for c in order], axis=1)


def _scaled(element: Element, parts: dict[str, Element]) -> np.ndarray:
    values = element.numbers()
    scale = parts["SCAL"].numbers().ravel() if "SCAL" in parts else np.ones(1)
    if len(scale) not in (1, values.shape[1]) or not scale.all():
        raise ValueError(f"SCAL of {element.key} does not fit")
    return values / scale


def _base(streams: dict[str, _Stream]) -> float | None:
    """Time of the first frame on the camera's clock, where it is stated in microseconds, as of HERO8 and later."""
    shutter = streams.get("SHUT")
    fine = shutter is not None and shutter.is_fine and all(s.is_fine for s in streams.values())
    return shutter.stamps[0] if shutter is not None and fine and shutter.stamps else None


def _timed(stream: _Stream, base: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Times ``(K,)`` and samples ``(K, 3)`` in the axes of the images."""
    assert stream.axes is not None
    counts = np.array([len(values) for values in stream.values])
    firsts = np.append(0, np.cumsum(counts))[:-1]
    has_clock = all(stamp is not None for stamp in stream.stamps)
    starts = np.array([s or 0.0 for s in stream.stamps] if has_clock else stream.starts, dtype=np.float64)
    zero = base if base is not None and has_clock else float(starts[0]) if len(starts) else 0.0
    total, index = int(counts.sum()), np.arange(int(counts.sum()))
    samples = np.concatenate(stream.values) @ stream.axes.T if total else np.zeros((0, 3))
    if len(starts) < 3:
        last = stream.starts[-1] + stream.durations[-1] - stream.starts[0] if len(starts) else 0.0
        return starts[:1] - zero + index * (last / max(total, 1)), samples
    slope, start = np.polyfit(firsts, starts, 1)
    line = start + slope * index
    if np.abs(line[firsts] - starts).max() <= _UNEVEN if firsts.max() < total else False:
        return line - (zero if base is not None else start), samples
    tail = starts[-1] + counts[-1] * slope
    return np.interp(index, np.append(firsts, total), np.append(starts, tail)) - zero, samples
