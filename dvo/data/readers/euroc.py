"""EuRoC MAV (Burri et al., IJRR 2016), the ASL layout: ``cam0``, ``cam1``, ``imu0``, ``state_groundtruth_estimate0``
in ``mav0``.

Trap: the ground truth is the pose of the body (the inertial sensor) in the world, with the quaternion as ``w x y z``.
``T_BS`` in ``cam0/sensor.yaml`` takes camera coordinates to the body, so ``T_world_camera = T_world_body T_BS``.
TUM-VI has the same layout with Kalibr's ``T_cam_imu``, the inverse, in ``dso/camchain.yaml``.
"""

from __future__ import annotations

import math
import re
from array import array
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.yaml_files import read_text
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.calibration.documents import load_yaml
from dvo.data.calibration.euroc import read_extrinsics, read_rig
from dvo.data.calibration.read import read_calibration
from dvo.data.calibration.stereo import right_camera
from dvo.data.extrinsics import pose_of_numbers
from dvo.data.files.clock import NAMES, PARTS, unit_of_dates, unit_of_name
from dvo.data.files.files import (
    is_file,
    is_folder,
    parse_nanoseconds,
    parse_number,
    read_lines,
    read_rows,
)
from dvo.data.files.listing import listed_file
from dvo.data.files.stamps import choose_times, read_times
from dvo.data.inertial import InertialSamples
from dvo.data.inertial_files.imu_calibration import ImuCalibration, read_noise
from dvo.data.inertial_files.tables import read_inertial_table
from dvo.data.readers.folder import camera_images
from dvo.data.recording import ImageRecording, Reader, Recording, Request
from dvo.data.sensors.sensors import SameName, Sensors
from dvo.data.trajectory import Trajectory, interpolate, unit_quaternions
from dvo.geometry.poses import compose_poses, invert_poses

_CAMERA = re.compile(r"cam[0-9]+")
_WHOLE = 0.9  # share of whole numbers among measurements that are parts of decimal numbers
_LONGEST_STEP = 10.0  # seconds between rows whose times are dates


def _place(path: Path) -> tuple[Path, str] | None:
    """Folder ``mav0`` and name of the camera, for a path to the sequence, to ``mav0``, ``camN`` or ``camN/data``."""
    mav = next((folder for folder in (path / "mav0", path) if is_folder(folder / "cam0" / "data")), None)
    if mav is not None:
        return mav, "cam0"
    real = path.resolve()
    for camera, data in ((real, real / "data"), (real.parent, real)):
        is_camera = data.name == "data" and _CAMERA.fullmatch(camera.name) and is_folder(data)
        if is_camera and (is_file(camera / "sensor.yaml") or is_file(camera / "data.csv")):
            return camera.parent, camera.name
    return None


def matches(path: Path) -> bool:
    """True for a folder with ``mav0/cam0/data``, ``mav0`` itself, or ``camN`` or ``camN/data`` beside ``sensor.yaml``.

    Args:
        path: existing file or folder.
    """
    return path.is_dir() and _place(path) is not None


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
    """``(N,)`` int64 nanoseconds, ``(N, columns)`` float64 numbers after them, and the lines of the rows.

    Dates in another unit than nanoseconds, as some recorders write them, become nanoseconds.
    """
    times, values, lines, width = array("q"), array("d"), array("q"), 0
    for number, fields in read_rows(path, "use EuRoC's data.csv"):
        width = max(width, len(fields) - 1)
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
    table, numbers = np.array(values, dtype=np.float64).reshape(-1, columns), np.array(times, dtype=np.int64)
    if width > columns and table.any() and (table % 1 == 0).mean() > _WHOLE:
        message = f"{width} whole numbers behind the time: decimal commas, which part two numbers"
        raise DvoError(message, file=path, field="rows", remedy=f"write '{header}' with decimal points")
    return numbers * (PARTS["ns"] // PARTS[_unit(numbers) or "ns"]), table, lines.tolist()


def _unit(times: np.ndarray) -> str | None:
    """Unit in which times are dates; None for other ones, such as the first seconds of a clock in nanoseconds."""
    unit = unit_of_dates(times)
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return unit if unit is not None and step <= _LONGEST_STEP * PARTS[unit] else None


def read_inertial(path: Path, calibration: ImuCalibration | None = None) -> InertialSamples:
    """Read inertial samples.

    Args:
        path: ``imu0/data.csv``, rows ``ns, wx, wy, wz, ax, ay, az`` in rad/s and m/s^2.
        calibration: of the sensor, to go with the samples.

    Raises:
        DvoError: a malformed row, or times that do not increase.
    """
    nanoseconds, table, _ = _timed_rows(path, 6, "ns, wx, wy, wz, ax, ay, az")
    samples = InertialSamples(nanoseconds / 1e9, table[:, :3], table[:, 3:], origin="imu0/data.csv")
    return samples if calibration is None else calibration.applied(samples)


def _camchain(mav: Path) -> Path | None:
    """Kalibr's calibration of both cameras, where TUM-VI has it."""
    options = (mav.parent / "dso" / "camchain.yaml", mav / "camchain.yaml", mav.parent / "camchain.yaml")
    return next((option for option in options if is_file(option)), None)


def _kalibr_camera(mav: Path, camera: str) -> tuple[dict[str, Any], Path] | None:
    """Entries of a camera in Kalibr's camchain, and the file; None without them."""
    chain = _camchain(mav)
    data = None if chain is None else load_yaml(read_text(chain), chain)
    entry = data.get(camera) if isinstance(data, dict) else None
    return (entry, chain) if isinstance(entry, dict) and chain is not None else None


def _body_camera(mav: Path, camera: str) -> np.ndarray | None:
    """Pose of a camera on the body, by ``sensor.yaml`` or Kalibr's ``T_cam_imu``; None if neither states it."""
    found = read_extrinsics(mav / camera / "sensor.yaml")
    if found is not None or (kalibr := _kalibr_camera(mav, camera)) is None:
        return found
    entry, chain = kalibr
    if entry.get("T_cam_imu") is None:
        return None
    try:
        return invert_poses(pose_of_numbers(entry["T_cam_imu"], chain))
    except DvoError as error:
        remedy = "give a rigid 4x4 matrix, row by row"
        raise DvoError(error.message, file=chain, field=f"{camera}.T_cam_imu", remedy=remedy) from None


def _calibration(mav: Path, camera: str) -> Calibration | None:
    sensor, chain = mav / camera / "sensor.yaml", _camchain(mav)
    if is_file(sensor):
        return read_calibration(sensor)
    return read_calibration(chain) if chain is not None and camera == "cam0" else None


def _rig(mav: Path) -> StereoRig | None:
    found, calibration = read_rig(mav), _calibration(mav, "cam0")
    return right_camera(calibration, "cam0") if found is None and calibration is not None else found


def _inertial(mav: Path, camera: str, request: Request, *, rough: bool = False) -> InertialSamples:
    body_camera, body_imu = _body_camera(mav, camera), read_extrinsics(mav / "imu0" / "sensor.yaml")
    if body_imu is None and _camchain(mav) is not None:
        body_imu = np.array([0, 0, 0, 0, 0, 0, 1.0])
    T_camera_imu = None
    if body_camera is not None and body_imu is not None:
        T_camera_imu = compose_poses(invert_poses(body_camera), body_imu)
    stated = mav.parent / "dso" / "imu_config.yaml"  # of TUM-VI
    noise = read_noise(mav / "imu0" / "sensor.yaml") or read_noise(stated)
    given, offset = request.imu_calibration, None
    if (given is None or given.time_offset is None) and (kalibr := _kalibr_camera(mav, camera)) is not None:
        offset = kalibr[0].get("timeshift_cam_imu")
        if offset is not None and not (isinstance(offset, int | float) and math.isfinite(offset)):
            field = f"{camera}.timeshift_cam_imu"
            raise DvoError("no number", file=kalibr[1], field=field, remedy="give seconds, t_imu - t_cam")
    calibration, table = ImuCalibration(noise, T_camera_imu, offset), mav / "imu0" / "data.csv"
    return calibration.applied(read_inertial_table(table, rough=True)) if rough else read_inertial(table, calibration)


def _sensors(mav: Path, camera: str, request: Request) -> Sensors:
    """Right images and inertial samples, where there are files of them; nothing is read yet."""
    # times that the user named need not be on the clock of the inertial sensor
    has_inertial = (mav / "imu0" / "data.csv").is_file() and request.times is None
    inertial = partial(_inertial, mav, camera, request) if has_inertial else None
    if camera != "cam0" or not (mav / "cam1" / "data").is_dir():
        return Sensors(inertial=inertial)
    return Sensors(right=SameName(mav / "cam1" / "data"), stereo=partial(_rig, mav), inertial=inertial)


def _groundtruth(mav: Path, camera: str, timestamps: np.ndarray, warnings: list[str]) -> Trajectory | None:
    folders = (mav / name for name in ("state_groundtruth_estimate0", "mocap0"))
    folder = next((folder for folder in folders if is_file(folder / "data.csv")), None)
    if folder is None:
        return None
    body_camera = _body_camera(mav, camera)
    if body_camera is None:
        warnings.append(f"{camera}/sensor.yaml has no T_BS: ground truth of the body was not used for the camera")
        return None
    body_marker = read_extrinsics(folder / "sensor.yaml")  # the identity in EuRoC, not in every copy of the layout
    if body_marker is not None and folder.name != "mocap0":
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
    stated = None
    for number, line in read_lines(listing, "use EuRoC's data.csv"):
        fields = [field.strip() for field in line.split("#")[0].split(",")]
        if not fields[0]:
            stated = stated or unit_of_name(line.split(",")[0])
            continue
        try:
            time, name = parse_nanoseconds(fields[0]), fields[1]
        except (ValueError, IndexError):
            raise DvoError(
                "not 'ns,filename'", file=listing, field=f"line {number}", remedy="correct the row"
            ) from None
        rows.append((time, listed_file(listing, camera / "data", name, number)))
    rows.sort()
    unit = _unit(np.array([time for time, _ in rows], dtype=np.int64)) or stated or "ns"
    if unit != "ns":
        warnings.append(f"times of {camera.name}/data.csv are taken for {NAMES[unit]}")
    return [file for _, file in rows], np.array([time / float(PARTS[unit]) for time, _ in rows])


def open_euroc(path: Path, request: Request) -> Recording:
    """Read one camera of a sequence in EuRoC's layout, ``cam0`` unless another is named; also of TUM-VI, whose
    calibration is ``dso/camchain.yaml`` and whose ground truth is ``mocap0``. Ground truth is that of the camera, at
    the images' times.

    Frames of ``cam0`` carry the image of ``cam1`` of the same name (undistorted, not rectified), and frames the
    samples of ``imu0``.

    Args:
        path: folder that holds ``mav0``, ``mav0``, the folder of a camera in it, or its ``data``.
        request: options of the user.

    Raises:
        DvoError: no images, or a malformed file.
    """
    place = _place(path)
    if place is None:
        raise DvoError("not a EuRoC sequence", file=path, remedy="give the folder that holds mav0")
    mav, camera = place
    warnings: list[str] = []
    images, listed = _images(mav / camera, warnings)
    if listed is None:
        times = choose_times(images, mav / camera / "data", times=request.times, fps=request.fps, warnings=warnings)
    else:
        times = listed if request.times is None else read_times(request.times, len(images), warnings)
        if request.fps is not None:
            warnings.append(f"--fps was not used: the times come from {camera}/data.csv")
    if request.times is not None and is_file(mav / "imu0" / "data.csv"):
        warnings.append("inertial samples of imu0 are not used: the times of --times need not be on their clock")
    groundtruth = _groundtruth(mav, camera, times, warnings)
    name = mav.resolve().parent.name if mav.resolve().name == "mav0" else None
    if path.resolve().name == "data" and name is None:
        name = mav.resolve().name
    return ImageRecording(
        "euroc", path, images, times, calibration=_calibration(mav, camera), groundtruth=groundtruth, warnings=warnings,
        name=name, sensors=_sensors(mav, camera, request),
    )  # fmt: skip


READER = Reader("euroc", matches, open_euroc)
