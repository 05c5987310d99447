"""KITTI odometry (Geiger et al., CVPR 2012): ``sequences/XX`` with ``image_N``, ``calib.txt`` and ``times.txt``;
``poses/XX.txt``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.kitti import pose_in_camera_0, projection_calibration, projection_rig, read_projections
from dvo.data.files.files import is_file, lookups
from dvo.data.files.stamps import choose_times, read_times
from dvo.data.images.images import has_images, list_images
from dvo.data.recording import ImageRecording, Reader, Recording, Request, rows_of_images
from dvo.data.sensors.sensors import SameName, Sensors
from dvo.data.trajectory import Trajectory, read_kitti_poses
from dvo.geometry.poses import compose_poses

CAMERAS = ("image_0", "image_2", "image_1", "image_3")
RIGHT_OF = {"image_0": "image_1", "image_2": "image_3"}
KITTI_FPS = 1 / 0.1037  # the laser scanner that triggers the cameras


def _split(path: Path) -> tuple[Path, Path] | None:
    """Sequence folder and image folder, for a path to either; None if this is no KITTI sequence."""
    if path.resolve().name in CAMERAS and has_images(path):
        sequence, images = path.resolve().parent, path
    else:
        folders = [path / name for name in CAMERAS if has_images(path / name)]
        if not folders:
            return None
        sequence, images = path, folders[0]
    calib = sequence / "calib.txt"
    return (sequence, images) if is_file(calib) and "P0:" in _beginning(calib) else None


def _beginning(file: Path) -> str:
    with lookups(file), file.open(encoding="utf-8", errors="replace") as text:
        return text.read(4096)


def matches(path: Path) -> bool:
    """True for a folder with ``image_N`` and a ``calib.txt`` of rows ``P0:`` to ``P3:``, or its ``image_N``.

    Args:
        path: existing file or folder.
    """
    return path.is_dir() and _split(path) is not None


def _poses_file(sequence: Path) -> Path | None:
    resolved = sequence.resolve()
    options = (resolved.parent.parent / "poses" / f"{resolved.name}.txt", resolved / "poses.txt")
    return next((option for option in options if option.is_file()), None)


def open_kitti(path: Path, request: Request) -> Recording:
    """Read a KITTI odometry sequence: the left grey camera, else the left colour one, or the ``image_N`` that is named.

    Intrinsics are those of the camera that is read. KITTI's poses are those of camera 0; for another camera they are
    moved by its baseline ``K^-1 P[:, 3]``. Frames of a left camera carry the right image where there is one.

    Args:
        path: ``sequences/XX`` or a folder of images in it.
        request: options of the user.

    Raises:
        DvoError: no images, or malformed calibration, times or poses.
    """
    found = _split(path)
    if found is None:
        raise DvoError("not a KITTI sequence", file=path, remedy="give the folder sequences/XX")
    sequence, folder = found
    warnings: list[str] = []
    images = list_images(folder)
    camera = f"P{folder.resolve().name[-1]}"
    projections = read_projections(sequence / "calib.txt")
    if camera not in projections:
        raise DvoError("no such row", file=sequence / "calib.txt", field=camera, remedy="use KITTI's calib.txt")
    projection = projections[camera]
    calibration = projection_calibration(projection, sequence / "calib.txt")
    times = _times(sequence, folder, images, request, warnings)

    groundtruth = None
    poses_file = _poses_file(sequence)
    if poses_file is not None:
        poses = read_kitti_poses(poses_file)
        rows = rows_of_images(images, len(poses))
        if rows is None:
            warnings.append(f"{poses_file} has {len(poses)} rows for {len(images)} images: not used as ground truth")
        else:
            groundtruth = Trajectory(times, compose_poses(poses[rows], pose_in_camera_0(projection)))
    name = sequence.resolve().name
    return ImageRecording(
        "kitti", path, images, times, calibration=calibration, groundtruth=groundtruth, warnings=warnings,
        name=f"kitti{name}" if name.isdigit() else name, sensors=_sensors(sequence, folder, projections),
    )  # fmt: skip


def _sensors(sequence: Path, folder: Path, projections: dict[str, np.ndarray]) -> Sensors:
    name = RIGHT_OF.get(folder.resolve().name)
    if name is None or not (sequence / name).is_dir() or f"P{name[-1]}" not in projections:
        return Sensors()
    left, right = projections[f"P{folder.resolve().name[-1]}"], projections[f"P{name[-1]}"]
    return Sensors(right=SameName(sequence / name), stereo=partial(projection_rig, left, right, sequence / "calib.txt"))


def _times(sequence: Path, folder: Path, images: list[Path], request: Request, warnings: list[str]) -> np.ndarray:
    listing = sequence / "times.txt"
    if request.times is None and listing.is_file():
        if request.fps is not None:
            warnings.append(f"--fps was not used: the times come from {listing}")
        times = read_times(listing, None)
        rows = rows_of_images(images, len(times))
        return times[rows] if rows is not None else read_times(listing, len(images))
    fps = request.fps
    if request.times is None and fps is None:
        fps = KITTI_FPS
        warnings.append(f"no times.txt: assuming KITTI's rate of {fps:.2f} frames a second")
    return choose_times(images, folder, times=request.times, fps=fps, warnings=warnings)


READER = Reader("kitti", matches, open_kitti)
