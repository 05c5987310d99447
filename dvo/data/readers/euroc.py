"""EuRoC MAV (Burri et al., IJRR 2016), the ASL layout: ``cam0``, ``cam1``, ``imu0``, ``state_groundtruth_estimate0``
in ``mav0``.

Trap: the ground truth is the pose of the body (the inertial sensor) in the world, with the quaternion as ``w x y z``.
``T_BS`` in ``cam0/sensor.yaml`` takes camera coordinates to the body, so ``T_world_camera = T_world_body T_BS``.
"""

from __future__ import annotations

from array import array
from functools import partial
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration
from dvo.data.calibration.euroc import read_extrinsics, read_rig
from dvo.data.calibration.read import read_calibration
from dvo.data.files.files import (
    parse_nanoseconds,
    parse_number,
    read_lines,
    read_rows,
)
from dvo.data.files.listing import listed_file
from dvo.data.files.stamps import choose_times, read_times
from dvo.data.frame import InertialSamples
from dvo.data.readers.folder import camera_images
from dvo.data.recording import ImageRecording, Reader, Recording, Request
from dvo.data.sensors.sensors import SameName, Sensors
from dvo.data.trajectory import Trajectory, interpolate, unit_quaternions
from dvo.geometry.poses import compose_poses, invert_poses


def _mav(path: Path) -> Path | None:
    return next((folder for folder in (path / "mav0", path) if (folder / "cam0" / "data").is_dir()), None)


def matches(path: Path) -> bool:
    """True for a folder with ``mav0/cam0/data``, or ``mav0`` itself.

    Args:
        path: existing file or folder.
    """
    return _mav(path) is not None


def read_state_groundtruth(path: Path) -> Trajectory:
    """Read body-to-world poses.

    Args:
        path: ``state_groundtruth_estimate0/data.csv``, rows ``ns, x, y, z, qw, qx, qy, qz, ...``.

    Raises:
        DvoError: a malformed row, times that do not increase, or no rows.
    """
    nanoseconds, table, lines = _timed_rows(path, 7, "ns, x, y, z, qw, qx, qy, qz")
    if not lines:
        raise DvoError("no poses in it", file=path, remedy="use EuRoC's data.csv")
    table[:, 3:] = unit_quaternions(table[:, 3:], path, lines)
    return Trajectory(nanoseconds / 1e9, table[:, [0, 1, 2, 4, 5, 6, 3]])


def _timed_rows(path: Path, columns: int, header: str) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """``(N,)`` int64 nanoseconds, ``(N, columns)`` float64 numbers after them, and the lines of the rows."""
    times, values, lines = array("q"), array("d"), array("q")
    for number, fields in read_rows(path, "use EuRoC's data.csv"):
        try:
            time, row = parse_nanoseconds(fields[0]), [parse_number(field) for field in fields[1 : columns + 1]]
        except ValueError:
            time, row = 0, []
        if len(row) != columns or (times and time <= times[-1]):
            raise DvoError(
                f"not '{header}' with increasing times", file=path, field=f"line {number}", remedy="correct the row"
            )
        times.append(time)
        values.extend(row)
        lines.append(number)
    table = np.array(values, dtype=np.float64).reshape(-1, columns)
    return np.array(times, dtype=np.int64), table, lines.tolist()


def read_inertial(path: Path, T_camera_imu: np.ndarray | None = None) -> InertialSamples:
    """Read inertial samples.

    Args:
        path: ``imu0/data.csv``, rows ``ns, wx, wy, wz, ax, ay, az`` in rad/s and m/s^2.
        T_camera_imu: ``(7,)`` pose of the inertial sensor in the camera's coordinates, to go with the samples.

    Raises:
        DvoError: a malformed row, or times that do not increase.
    """
    nanoseconds, table, _ = _timed_rows(path, 6, "ns, wx, wy, wz, ax, ay, az")
    return InertialSamples(nanoseconds / 1e9, table[:, :3], table[:, 3:], T_camera_imu)


def _inertial(mav: Path) -> InertialSamples:
    body_camera, body_imu = (read_extrinsics(mav / name / "sensor.yaml") for name in ("cam0", "imu0"))
    T_camera_imu = None
    if body_camera is not None and body_imu is not None:
        T_camera_imu = compose_poses(invert_poses(body_camera), body_imu)
    return read_inertial(mav / "imu0" / "data.csv", T_camera_imu)


def _sensors(mav: Path, request: Request) -> Sensors:
    """Right images and inertial samples, where there are files of them; nothing is read yet."""
    # times that the user named need not be on the clock of the inertial sensor
    has_inertial = (mav / "imu0" / "data.csv").is_file() and request.times is None
    inertial = partial(_inertial, mav) if has_inertial else None
    if not (mav / "cam1" / "data").is_dir():
        return Sensors(inertial=inertial)
    return Sensors(right=SameName(mav / "cam1" / "data"), stereo=partial(read_rig, mav), inertial=inertial)


def _groundtruth(mav: Path, timestamps: np.ndarray, warnings: list[str]) -> Trajectory | None:
    folder = mav / "state_groundtruth_estimate0"
    if not (folder / "data.csv").is_file():
        return None
    body_camera = read_extrinsics(mav / "cam0" / "sensor.yaml")
    if body_camera is None:
        warnings.append("cam0/sensor.yaml has no T_BS: ground truth of the body was not used for the camera")
        return None
    body_marker = read_extrinsics(folder / "sensor.yaml")  # the identity in EuRoC, not in every copy of the layout
    if body_marker is not None:
        body_camera = compose_poses(invert_poses(body_marker), body_camera)
    bodies = interpolate(read_state_groundtruth(folder / "data.csv"), timestamps)
    if len(bodies) < len(timestamps):
        warnings.append(f"ground truth covers {len(bodies)} of {len(timestamps)} images")
    if len(bodies) == 0:
        return None
    return Trajectory(bodies.timestamps, compose_poses(bodies.poses_wc, body_camera))


def _images(camera: Path, warnings: list[str]) -> tuple[list[Path], np.ndarray | None]:
    """Files and times of ``cam0/data.csv``, or of the names if there is none."""
    listing = camera / "data.csv"
    if not listing.is_file():
        return camera_images(camera / "data", warnings), None
    rows = []
    for number, line in read_lines(listing, "use EuRoC's data.csv"):
        fields = [field.strip() for field in line.split("#")[0].split(",")]
        if not fields[0]:
            continue
        try:
            time, name = parse_nanoseconds(fields[0]), fields[1]
        except (ValueError, IndexError):
            raise DvoError(
                "not 'ns,filename'", file=listing, field=f"line {number}", remedy="correct the row"
            ) from None
        rows.append((time, listed_file(listing, camera / "data", name, number)))
    rows.sort()
    return [file for _, file in rows], np.array([time / 1e9 for time, _ in rows])


def open_euroc(path: Path, request: Request) -> Recording:
    """Read the left camera of a sequence in EuRoC's layout; ground truth is that of the camera, at the images' times.

    Frames carry the image of ``cam1`` of the same name (undistorted, not rectified) and the samples of ``imu0``.

    Args:
        path: folder that holds ``mav0``, or ``mav0``.
        request: options of the user.

    Raises:
        DvoError: no images, or a malformed file.
    """
    mav = _mav(path)
    if mav is None:
        raise DvoError("not a EuRoC sequence", file=path, remedy="give the folder that holds mav0")
    warnings: list[str] = []
    images, listed = _images(mav / "cam0", warnings)
    if listed is None:
        times = choose_times(images, mav / "cam0" / "data", times=request.times, fps=request.fps, warnings=warnings)
    else:
        times = listed if request.times is None else read_times(request.times, len(images))
        if request.fps is not None:
            warnings.append("--fps was not used: the times come from cam0/data.csv")
    sensor = mav / "cam0" / "sensor.yaml"
    calibration: Calibration | None = read_calibration(sensor) if sensor.is_file() else None
    groundtruth = _groundtruth(mav, times, warnings)
    name = mav.resolve().parent.name if mav.resolve().name == "mav0" else None
    return ImageRecording(
        "euroc", path, images, times, calibration=calibration, groundtruth=groundtruth, warnings=warnings, name=name,
        sensors=_sensors(mav, request),
    )  # fmt: skip


READER = Reader("euroc", matches, open_euroc)
