"""KITTI raw data (Geiger et al., IJRR 2013): ``DATE_drive_NNNN_sync`` with ``image_0N/data`` and
``image_0N/timestamps.txt``; ``calib_cam_to_cam.txt`` in the folder of the day.

The images of a ``sync`` drive are rectified and have ``P_rect_0N``; those of an ``extract`` drive are not, and are read
with ``K_0N`` and ``D_0N``.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.calibration.kitti import projection_calibration, projection_rig
from dvo.data.files.files import is_file, parse_number, read_lines, read_rows
from dvo.data.files.stamps import choose_times, read_times
from dvo.data.images.images import has_images, list_images
from dvo.data.positions import Positions
from dvo.data.recording import ImageRecording, Reader, Recording, Request
from dvo.data.sensors.sensors import SameName, Sensors

_CAMERA = re.compile(r"image_0([0-3])")
_RIGHT = {"0": "1", "2": "3"}
_FILE = "calib_cam_to_cam.txt"


def _place(path: Path) -> tuple[Path, str] | None:
    """Folder of the drive and number of the camera, for a path to the drive, to ``image_0N`` or its ``data``."""
    real = path.resolve()
    for number in "0213":
        if has_images(real / f"image_0{number}" / "data"):
            return real, number
    for camera in (real, real.parent):
        found = _CAMERA.fullmatch(camera.name)
        if found and has_images(camera / "data") and (real == camera or real.name == "data"):
            return camera.parent, found[1]
    return None


def matches(path: Path) -> bool:
    """True for a folder with ``image_0N/data``, for ``image_0N`` in it, and its ``data``.

    Args:
        path: existing file or folder.
    """
    return path.is_dir() and _place(path) is not None


def _read(file: Path) -> dict[str, np.ndarray]:
    """Rows of numbers of ``calib_cam_to_cam.txt`` by name."""
    found = {}
    for _, line in read_lines(file, "use KITTI's calib_cam_to_cam.txt"):
        name, colon, rest = line.partition(":")
        try:
            found[name.strip()] = np.array([parse_number(value) for value in rest.split()])
        except ValueError:  # the date
            continue
    return found


def _row(rows: dict[str, np.ndarray], name: str, count: int, file: Path) -> np.ndarray:
    row = rows.get(name)
    if row is None or len(row) != count or (count >= 9 and not (row[0] > 0 and row[5 if count == 12 else 4] > 0)):
        raise DvoError(f"not {count} numbers of a camera", file=file, field=name, remedy=f"use KITTI's {_FILE}")
    return row


def _calibration(file: Path, number: str, is_rectified: bool) -> Calibration:
    rows = _read(file)
    if is_rectified:
        return projection_calibration(_row(rows, f"P_rect_0{number}", 12, file).reshape(3, 4), file)
    K, D = _row(rows, f"K_0{number}", 9, file), _row(rows, f"D_0{number}", 5, file)
    width, height = _row(rows, f"S_0{number}", 2, file)
    values = (float(K[0]), float(K[4]), float(K[2]), float(K[5]))
    return Calibration(*values, "radtan", tuple(D.tolist()), int(width), int(height), file=file)


def _rig(file: Path, left: str, right: str) -> StereoRig:
    rows = _read(file)
    pair = [_row(rows, f"P_rect_0{number}", 12, file).reshape(3, 4) for number in (left, right)]
    return projection_rig(pair[0], pair[1], file)


def open_kitti_raw(path: Path, request: Request) -> Recording:
    """Read a drive: the left grey camera, else the left colour one, or the one that is named.

    Args:
        path: folder of the drive, ``image_0N`` in it, or its ``data``.
        request: options of the user.

    Raises:
        DvoError: no images, or malformed calibration or times.
    """
    place = _place(path)
    if place is None:
        raise DvoError("not a drive of KITTI's raw data", file=path, remedy="give the folder that holds image_00")
    drive, number = place
    folder = drive / f"image_0{number}" / "data"
    warnings: list[str] = []
    images = list_images(folder)
    times = choose_times(images, folder, times=request.times, fps=request.fps, warnings=warnings)
    warnings = [warning for warning in warnings if "taken for dates" not in warning]
    file = next((place / _FILE for place in (drive, drive.parent) if is_file(place / _FILE)), None)
    is_rectified = "extract" not in drive.name
    calibration, sensors = None, Sensors()
    if file is not None:
        calibration = _calibration(file, number, is_rectified)
        right = drive / f"image_0{_RIGHT.get(number)}" / "data"
        if is_rectified and number in _RIGHT and has_images(right):
            sensors = Sensors(right=SameName(right), stereo=partial(_rig, file, number, _RIGHT[number]))
    if (drive / "oxts").is_dir():
        warnings.append("oxts has inertial samples of the car at the rate of the images; they are not used")
    if is_file(drive / "oxts" / "timestamps.txt") and (drive / "oxts" / "data").is_dir():
        sensors = replace(sensors, positions=partial(read_oxts, drive / "oxts"))
    return ImageRecording(
        "kitti_raw", path, images, times, calibration=calibration, warnings=warnings, name=drive.name, sensors=sensors
    )


_FIELDS = 30  # of a row of oxts
_MODES = ("none", "search", "doppler", "standard", "differential", "RTK float", "RTK integer")  # of OXTS receivers
_FIRST_FIX = 3


def read_oxts(folder: Path) -> Positions:
    """Read the positions of the car: latitude, longitude, altitude, and of the 30 numbers of a row also the accuracy of
    the position (24th, metres) and the mode of the receiver (28th).

    Args:
        folder: ``oxts`` with ``data/*.txt`` and ``timestamps.txt``.

    Raises:
        DvoError: a file without 30 numbers, or another number of times.
    """
    files = sorted((folder / "data").glob("*.txt"))
    times = read_times(folder / "timestamps.txt", len(files))
    table = np.zeros((len(files), _FIELDS))
    for k, file in enumerate(files):
        fields = next((row for _, row in read_rows(file, "use KITTI's oxts")), [])
        try:
            values = [parse_number(field) for field in fields]
        except ValueError:
            values = []
        if len(values) != _FIELDS:
            raise DvoError(f"not {_FIELDS} numbers", file=file, field="oxts", remedy="use KITTI's oxts")
        table[k] = values
    modes = table[:, 27].astype(int)
    fix = tuple(_MODES[mode] if 0 <= mode < len(_MODES) else str(mode) for mode in modes.tolist())
    has_fix = modes >= _FIRST_FIX
    return Positions(times, table[:, :2], table[:, 2], has_fix, fix, table[:, 23], "m", "oxts")


READER = Reader("kitti_raw", matches, open_kitti_raw)
