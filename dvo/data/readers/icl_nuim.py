"""ICL-NUIM (Handa et al., ICRA 2014): a folder of images, and ``livingRoomN.gt.freiburg`` or ``trajN.gt.freiburg``.

The poses lie in the folder itself, beside it, or in ``TrajectoryGT`` beside it. The images lie in the folder, or in its
``rgb`` (the packages in TUM's layout, whose depth is then in ``depth``).

Trap: rows look like TUM's, but their stamp counts images from 1.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration
from dvo.data.files.stamps import checked_rate, choose_times
from dvo.data.images.images import has_images
from dvo.data.readers.folder import camera_images
from dvo.data.readers.sequence import find_calibration
from dvo.data.recording import ImageRecording, Reader, Recording, Request
from dvo.data.sensors.sensors import SameName, Sensors
from dvo.data.trajectory import Trajectory, read_tum

FPS = 30.0
CALIBRATION = Calibration(481.2, 480.0, 319.5, 239.5, width=640, height=480)
DEPTH_SCALE = 5000.0


def _truth(path: Path) -> Path | None:
    """Poses that belong to a folder such as ``living_room_traj0_loop`` or ``traj2_frei_png``."""
    found = re.search(r"traj([0-3])", path.resolve().name)
    if not found:
        return None
    number = found.group(1)
    is_room = "living" in path.resolve().name
    names = [f"livingRoom{number}.gt.freiburg"] if is_room else [f"traj{number}.gt.freiburg"]
    folders = (path, path.resolve().parent, path.resolve().parent / "TrajectoryGT")
    return next((folder / name for folder in folders for name in names if (folder / name).is_file()), None)


def _images(path: Path) -> Path | None:
    return next((folder for folder in (path, path / "rgb") if has_images(folder)), None)


def matches(path: Path) -> bool:
    """True for a folder of images named after one of the eight trajectories, with the poses at one of the usual places.

    Args:
        path: existing file or folder.
    """
    return path.is_dir() and _truth(path) is not None and _images(path) is not None


def read_counted_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read poses whose stamps count images from 1.

    Args:
        path: ``*.gt.freiburg``.

    Returns:
        ``(N,)`` int indices of images from 0, and their ``(N, 7)`` float64 camera-to-world poses.

    Raises:
        DvoError: a malformed row, or a stamp that is no number of an image.
    """
    table = read_tum(path)
    numbers = np.rint(table.timestamps).astype(np.int64) - 1
    if (np.abs(table.timestamps - 1 - numbers) > 1e-6).any() or (numbers < 0).any() or (np.diff(numbers) <= 0).any():
        raise DvoError(
            "stamps do not count images from 1", file=path, field="timestamp", remedy="use the file of ICL-NUIM"
        )
    return numbers, table.poses_wc


def open_icl_nuim(path: Path, request: Request) -> Recording:
    """Read a trajectory of ICL-NUIM, 30 images a second.

    Args:
        path: folder of the images, or of ``rgb`` and ``depth``.
        request: options of the user.

    Raises:
        DvoError: no images, or malformed poses or times.
    """
    truth, folder = _truth(path), _images(path)
    if truth is None or folder is None:
        raise DvoError("not a sequence of ICL-NUIM", file=path, remedy="give a folder such as living_room_traj0_loop")
    warnings: list[str] = []
    images = camera_images(folder, warnings)
    nominal = np.arange(len(images)) / (checked_rate(request.fps) or FPS)
    times = choose_times(
        images, folder, times=request.times, fps=request.fps, warnings=warnings,
        fallback=lambda: None if request.fps else nominal,
    )  # fmt: skip
    numbers, poses = read_counted_poses(truth)
    inside = numbers < len(times)
    groundtruth = Trajectory(times[numbers[inside]], poses[inside]) if inside.any() else None
    sensors = Sensors(depth=SameName(path / "depth"), depth_scale=DEPTH_SCALE)
    return ImageRecording(
        "icl_nuim", path, images, times, calibration=find_calibration(path) or CALIBRATION, groundtruth=groundtruth,
        warnings=warnings, sensors=sensors,
    )  # fmt: skip


READER = Reader("icl_nuim", matches, open_icl_nuim)
