"""Calibration of KITTI's rectified cameras: the rows ``P0:`` to ``P3:`` of ``calib.txt``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.files.files import parse_number, read_lines


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


def kitti_calibration(path: Path) -> Calibration:
    """Calibration of the rectified cameras of KITTI, if all have the same intrinsics, as in the odometry data set.

    Args:
        path: KITTI's ``calib.txt``, of rows ``P0:`` to ``P3:``, or some of them.

    Raises:
        DvoError: cameras of different intrinsics, or a malformed row.
    """
    rows = list(read_projections(path).values())
    if not rows or any((row[:, :3] != rows[0][:, :3]).any() for row in rows):
        raise DvoError(
            "this is KITTI's calibration of several cameras",
            file=path,
            remedy="open the KITTI sequence folder itself, or write the fx fy cx cy of one camera into a file",
        )
    return projection_calibration(rows[0], path)


def projection_calibration(projection: np.ndarray, file: Path) -> Calibration:
    """Calibration of a rectified camera.

    Args:
        projection: ``(3, 4)``, see :func:`read_projections`.
        file: that it comes from.
    """
    fx, fy, cx, cy = (float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Calibration(fx, fy, cx, cy, file=file)


def pose_in_camera_0(projection: np.ndarray) -> np.ndarray:
    """Pose of a camera in the coordinates of camera 0; the rectified cameras are parallel.

    Args:
        projection: ``(3, 4)``, see :func:`read_projections`.

    Returns:
        ``(7,)`` metres.
    """
    pose = np.array([0, 0, 0, 0, 0, 0, 1.0])
    pose[:3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    return pose


def projection_rig(left: np.ndarray, right: np.ndarray, file: Path) -> StereoRig:
    """Right camera of two rectified cameras, which are parallel.

    Args:
        left, right: ``(3, 4)`` projections, see :func:`read_projections`.
        file: that they come from.
    """
    T_left_right = pose_in_camera_0(right)
    T_left_right[:3] -= pose_in_camera_0(left)[:3]
    return StereoRig(projection_calibration(right, file), T_left_right)
