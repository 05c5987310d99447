"""Extrinsics: the pose of the camera on a vehicle or robot, and the trajectory of its base frame.

``T_base_camera`` takes coordinates of the camera (x right, y down, z forward) to those of the base frame, metres: its
translation is the centre of the camera in the base frame. Other conventions, such as Kalibr's ``T_cam_imu``, are its
inverse.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.core.errors import DvoError
from dvo.core.yaml_files import read_yaml
from dvo.data.files.files import MAX_NUMBER, parse_number, read_rows
from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import compose_poses, invert_poses, poses_from_matrices

KEYS = ("T_base_camera", "T_BS")
"""Names of the matrix in a YAML or JSON file; the second is EuRoC's, sensor to body."""

_TOLERANCE = 1e-3  # of the orthogonality of a rotation matrix, and of the length of a quaternion
_REMEDY = "give the 4x4 matrix T_base_camera row by row, or 'x y z qx qy qz qw' (metres, camera to base)"


def read_extrinsics(file: Path | str) -> np.ndarray:
    """Read the pose of the camera in the base frame.

    Args:
        file: YAML or JSON (by its suffix) with ``T_base_camera`` or ``T_BS``, a matrix in rows, in one list, or with
            its numbers under ``data``, or a pose of seven numbers; or a text file with the numbers alone.

    Returns:
        ``(7,)`` float64 ``T_base_camera``, ``tx ty tz qx qy qz qw``.

    Raises:
        DvoError: no such file; neither 16 nor 7 finite numbers; a matrix that is not rigid, or a quaternion that is not
            of length one.
    """
    path = Path(file)
    if path.suffix.lower() in (".yaml", ".yml", ".json"):
        values = _of_table(read_yaml(path, _REMEDY), path)
    else:
        values = _of_text(path)
    return pose_of_numbers(values, path)


def pose_of_numbers(values: Any, file: object | None = None) -> np.ndarray:
    """Pose of the numbers of a rigid transformation.

    Args:
        values: ``(4, 4)`` or ``(16,)`` matrix, or ``(7,)`` ``tx ty tz qx qy qz qw``, as an array or lists.
        file: for messages.

    Returns:
        ``(7,)`` float64 pose, its quaternion of length one.

    Raises:
        DvoError: no numbers; otherwise see :func:`read_extrinsics`.

    Example:
        >>> pose_of_numbers(np.eye(4)).tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    """
    try:
        numbers = np.array(values, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):  # text, rows of several lengths
        raise DvoError("no table of numbers", file=file, field="T_base_camera", remedy=_REMEDY) from None
    if len(numbers) not in (7, 16):
        raise DvoError(f"{len(numbers)} numbers", file=file, field="T_base_camera", remedy=_REMEDY)
    if not (np.abs(numbers) <= MAX_NUMBER).all():  # NaN fails too
        raise DvoError("a number that is not finite", file=file, field="T_base_camera", remedy=_REMEDY)
    if len(numbers) == 7:
        length = float(np.linalg.norm(numbers[3:]))
        if abs(length - 1) > _TOLERANCE:
            message = f"the quaternion has the length {length:.6g}, not 1"
            raise DvoError(message, file=file, field="T_base_camera", remedy=_REMEDY)
        return np.concatenate([numbers[:3], numbers[3:] / length])
    matrix = numbers.reshape(4, 4)
    rotation = matrix[:3, :3]
    problem = ""
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=_TOLERANCE):
        problem = "the upper left 3x3 block is no rotation: its rows are not orthonormal"
    elif np.linalg.det(rotation) < 0:
        problem = "the upper left 3x3 block mirrors: its determinant is -1"
    elif not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        problem = "the last row is not 0 0 0 1"
    if problem:
        raise DvoError(problem, file=file, field="T_base_camera", remedy=_REMEDY)
    left, _, right = np.linalg.svd(rotation)  # the nearest rotation: files round
    matrix = matrix.copy()
    matrix[:3, :3] = left @ right
    return poses_from_matrices(matrix)


@checked_arguments
def base_trajectory(trajectory: Trajectory, T_base_camera: np.ndarray) -> Trajectory:
    """Poses of the base frame in the base frame of the first row.

    With ``T_w_c(t)`` the given camera poses and ``T_b_c`` the extrinsics, row t is ``T_b0_b(t) = T_b_c T_w_c(0)^-1
    T_w_c(t) T_b_c^-1``; the first one is the identity. The translation of ``T_b_c`` must have the unit of the
    trajectory: for a monocular trajectory of unknown scale the result is a rigid motion of the base only up to the
    error of that scale on the lever arm.

    Args:
        trajectory: camera to world.
        T_base_camera: ``(7,)`` pose, or ``(4, 4)`` or ``(16,)`` matrix: camera to base.

    Returns:
        Trajectory of the same times, base to first base.

    Raises:
        DvoError: extrinsics that are no numbers, or not rigid. :func:`read_extrinsics` reads a file.

    Example:
        >>> turn = np.array([[0.0, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 1, 0, 0]])  # about the y axis of the camera
        >>> lever = np.array([0.0, 0, 1, 0, 0, 0, 1])  # the camera is one metre ahead of the base
        >>> trajectory = dvo.Trajectory(np.array([0.0, 0.1]), turn)
        >>> dvo.base_trajectory(trajectory, lever).positions[1].tolist()
        [0.0, 0.0, 2.0]
    """
    pose = pose_of_numbers(T_base_camera)
    if not len(trajectory):
        return trajectory
    poses = trajectory.poses_wc
    moved = compose_poses(compose_poses(pose, invert_poses(poses[0])), compose_poses(poses, invert_poses(pose)))
    return Trajectory(trajectory.timestamps, moved)


def _of_table(table: Any, file: Path) -> Any:
    value = table
    if isinstance(table, dict):
        key = next((key for key in KEYS if key in table), None)
        if key is None:
            found = ", ".join(str(name)[:40] for name in list(table)[:6]) or "nothing"
            message = f"neither {' nor '.join(KEYS)} in it, but {found}"
            raise DvoError(message, file=file, field="T_base_camera", remedy=_REMEDY)
        value = table[key]
    return value.get("data") if isinstance(value, dict) else value


def _of_text(file: Path) -> list[float]:
    numbers: list[float] = []
    for line, fields in read_rows(file, _REMEDY, "extrinsics"):
        try:
            numbers += [parse_number(text) for text in fields]
        except ValueError:
            raise DvoError("no numbers", file=file, field=f"line {line}", remedy=_REMEDY) from None
        if len(numbers) > 16:
            break
    return numbers
