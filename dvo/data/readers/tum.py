"""TUM RGB-D (Sturm et al., IROS 2012): ``rgb.txt`` or ``rgb/``, ``groundtruth.txt``, ``depth.txt`` or ``depth/``."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, rectified
from dvo.data.files.files import is_file
from dvo.data.files.listing import associated_columns, listed_files
from dvo.data.files.stamps import choose_times, read_times, times_from_names
from dvo.data.images.images import has_images, list_images
from dvo.data.readers.folder import camera_images
from dvo.data.readers.sequence import find_calibration
from dvo.data.recording import ImageRecording, Reader, Recording, Request
from dvo.data.sensors.sensors import Listed, NearestInTime, SameName, Sensors
from dvo.data.trajectory import Trajectory, interpolate, read_tum

# The colour cameras as published with the benchmark (file_formats page); freiburg3 is delivered undistorted.
DEPTH_SCALE = 5000.0  # units of a metre
RIGHT = "right"  # folder of right images, which the benchmark has not, where the calibration states a baseline
CALIBRATIONS = {
    "1": Calibration(517.3, 516.5, 318.6, 255.3, "radtan", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633), 640, 480),
    "2": Calibration(520.9, 521.0, 325.1, 249.7, "radtan", (0.2312, -0.7849, -0.0033, -0.0001, 0.9172), 640, 480),
    "3": Calibration(535.4, 539.2, 320.1, 247.6, "none", (), 640, 480),
}


ASSOCIATIONS = ("associations.txt", "associate.txt", "association.txt", "associated.txt", "assoc.txt")


def _associations(path: Path) -> Path | None:
    """List of colour and depth images that belong to each other, rows ``time file time file``."""
    return next((path / name for name in ASSOCIATIONS if is_file(path / name)), None)


def matches(path: Path) -> bool:
    """True for a folder with ``rgb.txt``, with a list of associated images, or with ``rgb/`` and ``groundtruth.txt``.

    Args:
        path: existing file or folder.
    """
    if _associations(path) is not None:
        return True
    return (path / "rgb.txt").is_file() or ((path / "groundtruth.txt").is_file() and has_images(path / "rgb"))


def default_calibration(name: str) -> Calibration | None:
    """Published calibration of a sequence, or None for a name of another form.

    Args:
        name: of the folder, such as ``rgbd_dataset_freiburg1_xyz`` or ``fr1_xyz``.
    """
    found = re.search(r"(?:freiburg|(?<![a-z])fr)([123])(?!\d)", name.lower())
    return CALIBRATIONS[found.group(1)] if found else None


def _groundtruth(path: Path, timestamps: np.ndarray, warnings: list[str]) -> Trajectory | None:
    if (path / "groundtruth_tum.txt").is_file():  # already at the times of the images
        return read_tum(path / "groundtruth_tum.txt")
    if not (path / "groundtruth.txt").is_file():
        return None
    found = interpolate(read_tum(path / "groundtruth.txt"), timestamps)
    if len(found) < len(timestamps):
        warnings.append(f"ground truth covers {len(found)} of {len(timestamps)} images")
    return found if len(found) else None


def open_tum(path: Path, request: Request) -> Recording:
    """Read a TUM RGB-D sequence.

    ``calib.txt`` in the folder wins over the published calibration. The motion capture runs at 100 Hz on a clock of its
    own: ground truth is interpolated to the times of the images, those without neighbours within 0.1 s get none.
    Depth is registered to the colour images; a frame gets the depth image with the nearest stamp within 0.02 s.

    Args:
        path: folder of the sequence.
        request: options of the user.

    Raises:
        DvoError: no images, or a malformed file.
    """
    warnings: list[str] = []
    listing, pairs = path / "rgb.txt", _associations(path)
    stamps: np.ndarray | None
    depth: Listed | None = None
    if not listing.is_file() and pairs is not None:
        images, times, depth = _associated(pairs, request, warnings)
        stamps = None
    elif listing.is_file():
        images, times = listed_files(listing)
        stamps = times
        if request.times is not None:
            times = read_times(request.times, len(images))
        elif request.fps is not None:
            warnings.append(f"--fps was not used: the times come from {listing}")
    else:
        images = camera_images(path / "rgb", warnings)
        times = choose_times(images, path / "rgb", times=request.times, fps=request.fps, warnings=warnings)
        stamps = times_from_names(images)
    calibration = find_calibration(path) or default_calibration(f"{path.name} {path.resolve().name}")
    groundtruth = _groundtruth(path, times, warnings)
    return ImageRecording(
        "tum", path, images, times, calibration=calibration, groundtruth=groundtruth, warnings=warnings,
        sensors=_sensors(path, images, stamps, request.calibration or calibration, depth),
    )  # fmt: skip


def _associated(listing: Path, request: Request, warnings: list[str]) -> tuple[list[Path], np.ndarray, Listed | None]:
    """Colour images and times of a list of associated images, and the depth images that belong to them."""
    columns = associated_columns(listing)
    if "rgb" not in columns:
        remedy = "use rows 'time file time file', as TUM's associate.py writes them"
        raise DvoError("no colour images in it", file=listing, remedy=remedy)
    images, times = listed_files(listing, "images", column=columns["rgb"])
    depth = None
    if "depth" in columns:
        others, _ = listed_files(listing, "depth images", column=columns["depth"])
        if len(others) == len(images):
            depth = Listed(dict(zip(images, others, strict=True)))
    counts = len(times) > 1 and (times % 1 == 0).all() and float(np.median(np.diff(times))) == 1.0
    if request.times is not None or counts:  # rows of ICL-NUIM count the images
        folder = images[0].parent if images else listing.parent
        times = choose_times(images, folder, times=request.times, fps=request.fps, warnings=warnings)
    elif request.fps is not None:
        warnings.append(f"--fps was not used: the times come from {listing}")
    return images, times, depth


def _sensors(
    path: Path,
    images: list[Path],
    stamps: np.ndarray | None,
    calibration: Calibration | None,
    associated: Listed | None = None,
) -> Sensors:
    right, rig = None, None
    if calibration is not None and calibration.baseline and (path / RIGHT).is_dir():
        right, rig = SameName(path / RIGHT), rectified(calibration, calibration.baseline)
    if associated is not None:
        scale = (calibration.depth_scale if calibration else None) or DEPTH_SCALE
        return Sensors(depth=associated, depth_scale=scale, right=right, stereo=rig)
    if stamps is None or not ((path / "depth.txt").is_file() or (path / "depth").is_dir()):
        return Sensors(right=right, stereo=rig)
    times = dict(zip(images, stamps.tolist(), strict=True))
    scale = (calibration.depth_scale if calibration else None) or DEPTH_SCALE
    depth = NearestInTime(times, partial(_depth_images, path))
    return Sensors(depth=depth, depth_scale=scale, right=right, stereo=rig)


def _depth_images(path: Path) -> tuple[list[Path], np.ndarray]:
    """Files and times of ``depth.txt``, else of ``depth/`` if its names are stamps."""
    if (path / "depth.txt").is_file():
        return listed_files(path / "depth.txt", "depth images")
    images = list_images(path / "depth")
    stamps = times_from_names(images)
    return (images, stamps) if stamps is not None else ([], np.zeros(0))


READER = Reader("tum", matches, open_tum)
