"""Trajectories and their TUM files (camera-to-world, seconds)."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.files import parse_number, read_rows
from dvo.data.files.output import replaced, write_text
from dvo.data.files.pose_table import read_pose_table
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
        >>> poses = np.array([[0, 0, 0, 0, 0, 0, 1.0], [0, 0, 2, 0, 0, 0, 1]])
        >>> trajectory = dvo.Trajectory(np.array([0.0, 0.5]), poses)
        >>> len(trajectory), trajectory.path_length
        (2, 2.0)
    """

    timestamps: np.ndarray
    poses_wc: np.ndarray

    def __post_init__(self) -> None:
        if self.timestamps.ndim != 1 or self.poses_wc.shape != (len(self.timestamps), 7):
            raise ValueError(f"timestamps {self.timestamps.shape} and poses {self.poses_wc.shape} do not match")

    def __repr__(self) -> str:
        span = f", {self.timestamps[0]:.3f} to {self.timestamps[-1]:.3f} s" if len(self) else ""
        return f"Trajectory({len(self)} poses{span})"

    def __len__(self) -> int:
        return len(self.timestamps)

    def increasing(self) -> Trajectory:
        """Rows that are later than all rows before them; all of them, if the times increase."""
        times = self.timestamps
        later = np.ones(len(times), dtype=bool)
        later[1:] = times[1:] > np.maximum.accumulate(times)[:-1]
        return self if later.all() else Trajectory(times[later], self.poses_wc[later])

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
    write_text(path, tum_text(trajectory))


def tum_text(trajectory: Trajectory) -> str:
    """Content of a TUM file: a header, and a row for each pose.

    Args:
        trajectory: camera-to-world poses.
    """
    rows = np.column_stack([trajectory.timestamps, trajectory.poses_wc])
    return TUM_HEADER + "".join(tum_row(row) for row in rows)


def tum_row(values: Iterable[float]) -> str:
    """Row of a TUM file.

    Args:
        values: timestamp in seconds and camera-to-world pose, ``timestamp tx ty tz qx qy qz qw``.

    Returns:
        The values with nine decimals, zero without a sign, and the end of the line.

    Example:
        >>> tum_row([0.5, 1, 2, 3, 0, 0, 0, 1])[:23]
        '0.500000000 1.000000000'
    """
    return " ".join(f"{value:z.9f}" for value in values) + "\n"


def read_tum(path: Path | str) -> Trajectory:
    """Read a trajectory in TUM's format: rows ``timestamp tx ty tz qx qy qz qw``, ``#`` comments.

    Times in nanoseconds (or milli- or microseconds) are recognised, a header that names the columns is followed, and
    rows of NaN are left out, see :func:`dvo.data.files.pose_table.read_pose_table`.

    Args:
        path: the file; blanks or commas between the numbers.

    Returns:
        Camera-to-world poses in the order of the rows, quaternions normalised; of rows with the same time the first.

    Raises:
        DvoError: missing file, no rows, a row without 8 finite numbers, a quaternion of another length than one, times
            that decrease, or that have lost their digits.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\\n0.5 1 2 3 0 0 0 1\\n")
        >>> read_tum("groundtruth.txt").poses_wc
        array([[1., 2., 3., 0., 0., 0., 1.]])
    """
    path = Path(path)
    clock, poses, numbers = read_pose_table(path)
    times = clock.seconds
    late = np.flatnonzero(np.diff(times) < 0)
    if len(late):
        row = int(late[0]) + 1
        raise DvoError(
            f"times must not decrease, but {times[row]:.9f} follows {times[row - 1]:.9f}",
            file=path,
            field=f"line {numbers[row]}",
            remedy="sort the rows",
        )
    moved = (np.diff(times) == 0) & (np.diff(poses, axis=0) != 0).any(1)
    if 2 * moved.sum() > len(times):
        message = f"{moved.sum()} of {len(times)} rows have the time of the row before, and another pose"
        field = f"line {numbers[int(np.argmax(moved)) + 1]}"
        raise DvoError(message, file=path, field=field, remedy="write the times with all their digits")
    poses[:, 3:] = unit_quaternions(poses[:, 3:], path, numbers)
    first = np.diff(times, prepend=-np.inf) > 0  # TUM's own ground truth repeats some rows
    return Trajectory(times[first], poses[first])


def read_numbers(path: Path, columns: int, row: str, header: str) -> tuple[np.ndarray, list[int]]:
    """Read a table of numbers, none of which is beyond :data:`dvo.data.files.files.MAX_NUMBER`.

    Args:
        path: the file; see :func:`dvo.data.files.files.read_rows`.
        columns: numbers in each row.
        row: name of a row, for messages.
        header: names of the numbers, for messages.

    Returns:
        ``(N, columns)`` float64, and the lines of the rows.

    Raises:
        DvoError: missing or malformed file, no rows, or a row of other numbers.
    """
    values, numbers = array("d"), array("q")
    for number, fields in read_rows(path, f"give a file of rows '{header}'"):
        try:
            parsed = [parse_number(field) for field in fields]
        except ValueError:
            parsed = []
        if len(parsed) != columns:
            raise DvoError(f"not a {row}", file=path, field=f"line {number}", remedy=f"use '{header}'")
        values.extend(parsed)
        numbers.append(number)
    if not numbers:
        raise DvoError("no poses in it", file=path, remedy=f"give a file of rows '{header}'")
    return np.array(values, dtype=np.float64).reshape(-1, columns), numbers.tolist()


_LENGTH = 0.1  # largest difference of the length of a quaternion from one, which rounding may change


def unit_quaternions(quaternions: np.ndarray, path: Path, lines: list[int]) -> np.ndarray:
    """Normalise quaternions of a table.

    Args:
        quaternions: ``(N, 4)`` finite.
        path: of the table.
        lines: numbers of the rows' lines.

    Returns:
        ``(N, 4)`` of length 1.

    Raises:
        DvoError: a length that is not one, as of angles in their place.
    """
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    bad = np.flatnonzero(~(np.abs(norms - 1) <= _LENGTH))
    if len(bad):
        row = int(bad[0])
        message = f"a quaternion of the length {norms[row, 0]:.3g}, as if it were none"
        remedy = "give qx qy qz qw, no angles, in the columns that the format has"
        raise DvoError(message, file=path, field=f"line {lines[row]}", remedy=remedy)
    return quaternions / norms


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


def read_kitti_poses(path: Path | str, numbers: int = 12) -> np.ndarray:
    """Read a KITTI pose file: a row-major 3x4 camera-to-world matrix a line.

    Args:
        path: the file.
        numbers: of a row; 16 for 4x4 matrices.

    Returns:
        ``(N, 7)`` float64 poses, camera to world. The file holds no times.

    Raises:
        DvoError: missing file, no rows, or a row that is not so many finite numbers with a rotation.
    """
    path = Path(path)
    table, lines = read_numbers(path, numbers, "KITTI row", f"{numbers} numbers, a {numbers // 4}x4 matrix")
    matrices = table.reshape(-1, numbers // 4, 4)
    wrong = np.flatnonzero((matrices[:, 3:] != [0, 0, 0, 1]).any(axis=(1, 2)))
    if len(wrong):
        where = f"line {lines[int(wrong[0])]}"
        raise DvoError("the last row of the matrix is not 0 0 0 1", file=path, field=where, remedy="correct the row")
    matrices = matrices[:, :3]
    rotations = matrices[:, :, :3]
    products = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero(~((products < 0.02) & (np.linalg.det(rotations) > 0)))
    if len(bad):
        raise DvoError(
            "the matrix is no rotation", file=path, field=f"line {lines[int(bad[0])]}", remedy="correct the row"
        )
    return poses_from_matrices(matrices)


def write_kitti_poses(path: Path | str, poses_wc: np.ndarray) -> None:
    """Write poses in KITTI's format: a row-major 3x4 matrix a line; the format holds no times.

    Args:
        path: file to write.
        poses_wc: ``(N, 7)`` camera to world.
    """
    rows = pose_matrices(poses_wc)[:, :3].reshape(len(poses_wc), 12)
    with replaced(path) as part, part.open("w", encoding="utf-8") as file:
        for row in rows:
            file.write(" ".join(f"{value:z.9e}" for value in row) + "\n")
