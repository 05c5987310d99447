"""Trajectories and their TUM files (camera-to-world, seconds)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvo.errors import DvoError
from dvo.geometry.poses import pose_matrices, poses_from_matrices, slerp

TUM_HEADER = "# timestamp tx ty tz qx qy qz qw (camera to world)\n"


@dataclass(frozen=True)
class Trajectory:
    """Timed camera-to-world poses.

    Attributes:
        timestamps: ``(N,)`` float64 seconds.
        poses_wc: ``(N, 7)`` float64 ``tx ty tz qx qy qz qw``, camera to world.

    Raises:
        ValueError: shapes that do not match.

    Example:
        >>> import numpy as np
        >>> poses = np.array([[0, 0, 0, 0, 0, 0, 1.0], [0, 0, 2, 0, 0, 0, 1]])
        >>> trajectory = Trajectory(np.array([0.0, 0.5]), poses)
        >>> len(trajectory), trajectory.path_length
        (2, 2.0)
    """

    timestamps: np.ndarray
    poses_wc: np.ndarray

    def __post_init__(self) -> None:
        if self.timestamps.ndim != 1 or self.poses_wc.shape != (len(self.timestamps), 7):
            raise ValueError(f"timestamps {self.timestamps.shape} and poses {self.poses_wc.shape} do not match")

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def positions(self) -> np.ndarray:
        """``(N, 3)`` camera centres in the world."""
        return self.poses_wc[:, :3]

    @property
    def path_length(self) -> float:
        """Sum of the distances between consecutive camera centres, in the unit of the positions."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write a trajectory in TUM's format: rows ``timestamp tx ty tz qx qy qz qw``, nine decimals.

    Args:
        path: file to write.
        trajectory: camera-to-world poses.
    """
    rows = np.column_stack([trajectory.timestamps, trajectory.poses_wc])
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.write(TUM_HEADER)
        file.writelines(tum_row(row) for row in rows)


def tum_row(values: Iterable[float]) -> str:
    """Row of a TUM file.

    Args:
        values: timestamp in seconds and camera-to-world pose, ``timestamp tx ty tz qx qy qz qw``.

    Returns:
        The values with nine decimals, and the end of the line.

    Example:
        >>> tum_row([0.5, 1, 2, 3, 0, 0, 0, 1])[:23]
        '0.500000000 1.000000000'
    """
    return " ".join(f"{value:.9f}" for value in values) + "\n"


def read_tum(path: Path | str) -> Trajectory:
    """Read a trajectory in TUM's format: rows ``timestamp tx ty tz qx qy qz qw``, ``#`` comments.

    Args:
        path: the file; blanks or commas between the numbers.

    Returns:
        Camera-to-world poses in the order of the rows, quaternions normalised.

    Raises:
        DvoError: missing file, no rows, a row without 8 finite numbers, or a quaternion of zero length.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\\n0.5 1 2 3 0 0 0 1\\n")
        >>> read_tum("groundtruth.txt").poses_wc
        array([[1., 2., 3., 0., 0., 0., 1.]])
    """
    path = Path(path)
    if not path.is_file():
        raise DvoError("no such file", file=path, remedy="give a TUM trajectory file")
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            row = [float(value) for value in fields]
        except ValueError:
            row = []
        if len(row) != 8 or not np.isfinite(row).all():
            raise DvoError(
                "not a TUM row", file=path, field=f"line {number}", remedy="use 'timestamp tx ty tz qx qy qz qw'"
            )
        rows.append(row)
    if not rows:
        raise DvoError("no poses in it", file=path, remedy="give a TUM trajectory file")
    table = np.array(rows, dtype=np.float64)
    norms = np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
    if (norms < 1e-6).any():
        raise DvoError("a quaternion has no length", file=path, field="qx qy qz qw", remedy="correct the row")
    table[:, 4:] /= norms
    return Trajectory(table[:, 0].copy(), table[:, 1:].copy())


def interpolate(trajectory: Trajectory, timestamps: np.ndarray, max_gap: float = 0.1) -> Trajectory:
    """Interpolate a trajectory at other times: positions linearly, rotations by slerp between the neighbouring poses.

    Args:
        trajectory: poses in increasing order of time.
        timestamps: ``(M,)`` seconds.
        max_gap: seconds; a time whose neighbours lie further apart than this, or that lies outside, gets no row.
            A time that coincides with a pose (to a microsecond) always gets one.

    Returns:
        At most M rows, at exactly the given times.
    """
    times, wanted = trajectory.timestamps, np.asarray(timestamps, dtype=np.float64)
    if len(times) == 0 or len(wanted) == 0:
        return Trajectory(np.zeros(0), np.zeros((0, 7)))
    right = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    left = np.clip(right - 1, 0, None)
    nearest = np.where(np.abs(times[left] - wanted) <= np.abs(times[right] - wanted), left, right)
    exact = np.abs(times[nearest] - wanted) <= 1e-6
    inside = (times[left] <= wanted) & (wanted <= times[right]) & (times[right] - times[left] <= max_gap)
    left, right = np.where(exact, nearest, left), np.where(exact, nearest, right)
    keep = exact | inside
    left, right, wanted = left[keep], right[keep], wanted[keep]
    span = times[right] - times[left]
    weight = np.where(span > 0, (wanted - times[left]) / np.where(span > 0, span, 1.0), 0.0)
    a, b = trajectory.poses_wc[left], trajectory.poses_wc[right]
    positions = a[:, :3] + weight[:, None] * (b[:, :3] - a[:, :3])
    return Trajectory(wanted, np.concatenate([positions, slerp(a[:, 3:], b[:, 3:], weight)], axis=1))


def read_kitti_poses(path: Path | str) -> np.ndarray:
    """Read a KITTI pose file: a row-major 3x4 camera-to-world matrix a line.

    Args:
        path: the file.

    Returns:
        ``(N, 7)`` float64 poses, camera to world. The file holds no times.

    Raises:
        DvoError: missing file, no rows, or a row that is not 12 finite numbers.
    """
    path = Path(path)
    if not path.is_file():
        raise DvoError("no such file", file=path, remedy="give a KITTI pose file")
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            row = [float(value) for value in fields]
        except ValueError:
            row = []
        if len(row) != 12 or not np.isfinite(row).all():
            raise DvoError("not a KITTI row", file=path, field=f"line {number}", remedy="use 12 numbers, a 3x4 matrix")
        rows.append(row)
    if not rows:
        raise DvoError("no poses in it", file=path, remedy="give a KITTI pose file")
    return poses_from_matrices(np.array(rows).reshape(-1, 3, 4))


def write_kitti_poses(path: Path | str, poses_wc: np.ndarray) -> None:
    """Write poses in KITTI's format: a row-major 3x4 matrix a line; the format holds no times.

    Args:
        path: file to write.
        poses_wc: ``(N, 7)`` camera to world.
    """
    rows = pose_matrices(poses_wc)[:, :3].reshape(len(poses_wc), 12)
    with open(path, "w", encoding="utf-8") as file:
        for row in rows:
            file.write(" ".join(f"{value:.9e}" for value in row) + "\n")
