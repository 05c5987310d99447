"""Ground-truth files that a user names: one table of formats, recognised by their rows."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.clock import PARTS, is_number
from dvo.data.files.files import read_rows
from dvo.data.files.pose_table import names_a_pose
from dvo.data.readers.icl_nuim import read_counted_poses
from dvo.data.readers.tartanair import read_ned_poses
from dvo.data.trajectory import Trajectory, read_kitti_poses, read_tum

_WITHOUT_TIMES = (7, 12, 16)  # numbers of a row
_LONGER = 1.5  # times that times of poses are longer than those of the images, and no seconds
_SAME = 0.05  # of the span of the images: what the span of as many poses may differ by


def read_groundtruth(file: Path, timestamps: np.ndarray | None, notes: list[str] | None = None) -> Trajectory:
    """Read camera-to-world poses of a recording.

    ============================  ================================================================================
    row                           format
    ============================  ================================================================================
    8 numbers, or a header        TUM: ``timestamp tx ty tz qx qy qz qw``; see :func:`dvo.data.trajectory.read_tum`
    8 numbers, ``*.freiburg``     ICL-NUIM: as TUM, but the stamp counts images from 1
    12 or 16 numbers              KITTI: a row-major 3x4 (or 4x4) matrix, one row per image
    13 or 17 numbers              a time and such a matrix
    7 numbers                     TartanAir: ``tx ty tz qx qy qz qw`` of the NED camera frame, one row per image
    ============================  ================================================================================

    Args:
        file: the poses.
        timestamps: ``(N,)`` seconds of all images of the recording; None if they are not known (a video).
        notes: for what the user has to know of the times, in sentences.

    Returns:
        Poses with times; those of formats without times are the images', and so are those of rows whose times are
        numbers of images: whole ones that, as seconds, would last longer than the recording.

    Raises:
        DvoError: a malformed file, or rows without times that do not fit the images.
    """
    columns = _columns(file)
    if file.suffix == ".freiburg" and columns == 8:
        numbers, poses = read_counted_poses(file)
        times = np.zeros(0) if timestamps is None else timestamps
        inside = numbers < len(times)
        if not inside.any():
            raise _no_times(len(poses), times, file)
        return Trajectory(np.asarray(times[numbers[inside]]), poses[inside])
    if columns not in _WITHOUT_TIMES or _has_header(file) or names_a_pose(file):
        notes = [] if notes is None else notes
        return _of_images(_on_clock(read_tum(file), timestamps), timestamps, file.name, notes)
    poses = read_ned_poses(file) if columns == 7 else read_kitti_poses(file, columns)
    times = np.zeros(0) if timestamps is None else timestamps
    if len(times) != len(poses):
        raise _no_times(len(poses), times, file)
    return Trajectory(np.asarray(times), poses)


def rows_without_times(file: Path) -> int | None:
    """Number of poses of a file whose rows are those of images, without times.

    Args:
        file: the poses.

    Returns:
        Rows of a KITTI or TartanAir file; None for a file with times.

    Raises:
        DvoError: the file cannot be read.
    """
    lengths = [len(fields) for _, fields in read_rows(file, "give an existing file", "groundtruth")]
    return len(lengths) if lengths and lengths[0] in _WITHOUT_TIMES and not _has_header(file) else None


def _on_clock(found: Trajectory, timestamps: np.ndarray | None) -> Trajectory:
    """The trajectory in the unit in which its times are those of the images, if they are not in seconds."""
    if timestamps is None or len(timestamps) < 2 or len(found) < 2:
        return found
    first, last = float(timestamps[0]), float(timestamps[-1])
    span = last - first
    for parts in PARTS.values():
        start, end = found.timestamps[0] / parts, found.timestamps[-1] / parts
        common = min(end, last) - max(start, first)
        if common > 0.5 * span and common > 0.1 * (end - start):
            return found if parts == 1 else Trajectory(found.timestamps / parts, found.poses_wc)
    return found


def _of_images(found: Trajectory, timestamps: np.ndarray | None, name: str, notes: list[str]) -> Trajectory:
    """The trajectory with the times of the images if its own are their numbers; a note if theirs do not fit."""
    times = found.timestamps
    if timestamps is None or min(len(timestamps), len(found)) < 3:
        return found
    span, spanned = float(timestamps[-1] - timestamps[0]), float(times[-1] - times[0])
    numbers = times.astype(np.int64)
    base = int(numbers[0] == 1 and numbers[-1] == len(timestamps))
    are_numbers = (numbers == times).all() and numbers[0] - base >= 0 and numbers[-1] - base < len(timestamps)
    if are_numbers and spanned > _LONGER * span:
        notes.append(
            f"the times of {name} are taken for numbers of images, from {base}: as seconds they would be too long"
        )
        return Trajectory(np.asarray(timestamps[numbers - base]), found.poses_wc)
    if len(found) == len(timestamps) and abs(spanned - span) > _SAME * span:
        notes.append(
            f"{name} has a pose for each image, but they span {spanned:.4g} s and the images {span:.4g} s: is the rate "
            "of the images (--fps, --times) right?"
        )
    return found


def _columns(file: Path) -> int:
    """Numbers in the first row."""
    return next((len(fields) for _, fields in read_rows(file, "give an existing file", "groundtruth")), 0)


def _has_header(file: Path) -> bool:
    """True for a first row of names that is no comment."""
    rows = read_rows(file, "give an existing file", "groundtruth")
    return not any(is_number(field) for _, fields in islice(rows, 1) for field in fields)


def _no_times(rows: int, times: np.ndarray, file: Path) -> DvoError:
    return DvoError(
        f"{rows} rows without times for {len(times)} images",
        file=file,
        field="groundtruth",
        remedy="give a TUM trajectory with times",
    )
