"""KITTI odometry (Geiger et al., CVPR 2012): ``sequences/XX`` with ``image_N``, ``calib.txt`` and ``times.txt``;
``poses/XX.txt``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration
from dvo.data.files.files import is_file, lookups, parse_number, read_lines
from dvo.data.files.stamps import choose_times, read_times
from dvo.data.images.images import has_images, list_images
from dvo.data.recording import ImageRecording, Reader, Recording, Request, rows_of_images
from dvo.data.sensors.sensors import SameName, Sensors, StereoRig
from dvo.data.trajectory import Trajectory, read_kitti_poses
from dvo.geometry.poses import compose_poses

CAMERAS = ("image_0", "image_2", "image_1", "image_3")
RIGHT_OF = {"image_0": "image_1", "image_2": "image_3"}
KITTI_FPS = 1 / 0.1037  # the laser scanner that triggers the cameras


def read_projections(path: Path) -> dict[str, np.ndarray]:
    """Read the projections of the four rectified cameras.

    Args:
        path: KITTI's ``calib.txt``.

    Returns:
        Name ``P0`` to ``P3``, those that are there, to a ``(3, 4)`` float64 matrix ``K [I | t]``.

    Raises:
        DvoError: such a row without 12 finite numbers, or whose matrix K is singular or not that of a pinhole camera.
    """
    found: dict[str, np.ndarray] = {}
    for _, line in read_lines(path, "use KITTI's calib.txt"):
        name, colon, rest = line.partition(":")
        name = name.strip()
        if not colon or name not in ("P0", "P1", "P2", "P3"):
            continue
        try:
            matrix = np.array([parse_number(value) for value in rest.split()]).reshape(3, 4)
        except ValueError:
            raise DvoError("not 12 numbers", file=path, field=name, remedy="use KITTI's calib.txt") from None
        K = matrix[:, :3]
        if min(K[0, 0], K[1, 1]) < 1e-3 or (K[[1, 2, 2], [0, 0, 1]] != 0).any() or K[2, 2] != 1:
            raise DvoError("not the projection of a camera", file=path, field=name, remedy="use KITTI's calib.txt")
        found[name] = matrix
    return found


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
            groundtruth = Trajectory(times, compose_poses(poses[rows], _pose_in_camera_0(projection)))
    name = sequence.resolve().name
    return ImageRecording(
        "kitti", path, images, times, calibration=calibration, groundtruth=groundtruth, warnings=warnings,
        name=f"kitti{name}" if name.isdigit() else name, sensors=_sensors(sequence, folder, projections),
    )  # fmt: skip


def projection_calibration(projection: np.ndarray, file: Path) -> Calibration:
    """Calibration of a rectified camera.

    Args:
        projection: ``(3, 4)``, see :func:`read_projections`.
        file: that it comes from.
    """
    fx, fy, cx, cy = (float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Calibration(fx, fy, cx, cy, file=file)


def _pose_in_camera_0(projection: np.ndarray) -> np.ndarray:
    """``(7,)`` pose of a camera in the coordinates of camera 0; the rectified cameras are parallel."""
    pose = np.array([0, 0, 0, 0, 0, 0, 1.0])
    pose[:3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    return pose


def _sensors(sequence: Path, folder: Path, projections: dict[str, np.ndarray]) -> Sensors:
    name = RIGHT_OF.get(folder.resolve().name)
    if name is None or not (sequence / name).is_dir() or f"P{name[-1]}" not in projections:
        return Sensors()
    left, right = projections[f"P{folder.resolve().name[-1]}"], projections[f"P{name[-1]}"]
    return Sensors(right=SameName(sequence / name), stereo=partial(projection_rig, left, right, sequence / "calib.txt"))


def projection_rig(left: np.ndarray, right: np.ndarray, file: Path) -> StereoRig:
    """Right camera of two rectified cameras, which are parallel.

    Args:
        left, right: ``(3, 4)`` projections, see :func:`read_projections`.
        file: that they come from.
    """
    T_left_right = _pose_in_camera_0(right)
    T_left_right[:3] -= _pose_in_camera_0(left)[:3]
    return StereoRig(projection_calibration(right, file), T_left_right)


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
