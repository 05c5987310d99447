"""TartanAir v1 (Wang et al., IROS 2020) and v2: ``image_left`` with ``pose_left.txt``, ``image_lcam_front`` with
``pose_lcam_front.txt``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvo.data.calibration import Calibration
from dvo.data.images import has_images, list_images
from dvo.data.recording import ImageRecording, Reader, Recording, Request, rows_of_images
from dvo.data.sequence import find_calibration
from dvo.data.stamps import read_times
from dvo.data.trajectory import Trajectory
from dvo.errors import DvoError
from dvo.geometry.poses import ned_to_camera

NOMINAL_FPS = 10.0  # the simulator has no clock of its own; v2's inertial data take images at 10 Hz
LAYOUTS = {
    "image_left": ("pose_left.txt", Calibration(320.0, 320.0, 320.0, 240.0, width=640, height=480)),
    "image_lcam_front": ("pose_lcam_front.txt", Calibration(320.0, 320.0, 320.0, 320.0, width=640, height=640)),
}


def _layout(path: Path) -> str | None:
    for folder, (poses, _) in LAYOUTS.items():
        if has_images(path / folder) and (folder != "image_left" or (path / poses).is_file()):
            return folder
    return None


def matches(path: Path) -> bool:
    """A folder with ``image_lcam_front``, or with ``image_left`` and ``pose_left.txt``."""
    return path.is_dir() and _layout(path) is not None


def read_ned_poses(path: Path) -> np.ndarray:
    """Rows ``tx ty tz qx qy qz qw`` of NED camera-to-world poses, as ``(N, 7)`` with camera x right, y down, z forward.

    Raises:
        DvoError: a row that is not 7 finite numbers, or a quaternion of no length.
    """
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        fields = line.split("#")[0].replace(",", " ").split()
        if not fields:
            continue
        try:
            row = np.array([float(field) for field in fields])
        except ValueError:
            row = np.zeros(0)
        if row.shape != (7,) or not np.isfinite(row).all() or np.linalg.norm(row[3:]) < 1e-6:
            raise DvoError("not 'tx ty tz qx qy qz qw'", file=path, field=f"line {number}", remedy="mend the row")
        rows.append(row)
    return ned_to_camera(np.array(rows)) if rows else np.zeros((0, 7))


def open_tartanair(path: Path, request: Request) -> Recording:
    """Read a TartanAir trajectory folder (``P001``), left front camera.

    Raises:
        DvoError: no images, or malformed poses or times.
    """
    folder = _layout(path)
    if folder is None:
        raise DvoError("not a TartanAir trajectory", file=path, remedy="give the folder that holds image_left")
    poses_name, nominal = LAYOUTS[folder]
    warnings: list[str] = []
    images = list_images(path / folder)
    times = _times(path, images, request, warnings)
    groundtruth = None
    if (path / poses_name).is_file():
        poses = read_ned_poses(path / poses_name)
        rows = rows_of_images(images, len(poses))
        if rows is None:
            warnings.append(f"{poses_name} has {len(poses)} rows for {len(images)} images: not used as ground truth")
        else:
            groundtruth = Trajectory(times, poses[rows])
    calibration = find_calibration(path) or nominal
    return ImageRecording(
        "tartanair", path, images, times, calibration=calibration, groundtruth=groundtruth, warnings=warnings
    )


def _times(path: Path, images: list[Path], request: Request, warnings: list[str]) -> np.ndarray:
    if request.times is not None:
        return read_times(request.times, len(images))
    clock = path / "imu" / "cam_time.txt"
    if clock.is_file():
        found = read_times(clock, None)
        rows = rows_of_images(images, len(found))
        if rows is not None:
            return found[rows]
    if request.fps is None:
        warnings.append(f"TartanAir has no times: assuming {NOMINAL_FPS:g} frames a second (or give --times or --fps)")
    elif not (np.isfinite(request.fps) and request.fps > 0):
        raise DvoError(f"{request.fps:g} frames a second", field="fps", remedy="give a positive rate")
    return np.arange(len(images)) / (request.fps or NOMINAL_FPS)


READER = Reader("tartanair", matches, open_tartanair)
