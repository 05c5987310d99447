"""Tables of poses with times: which columns hold what, and in which unit the times are."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.clock import (
    PARTS,
    Clock,
    in_seconds,
    named_times,
    parse_time,
    parts_of,
    read_table,
    refuse_lost_zeros,
    unit_of,
)
from dvo.data.files.files import MAX_NUMBER, parse_number, read_lines
from dvo.geometry.poses import poses_from_matrices

HEADER = "timestamp tx ty tz qx qy qz qw"
_NUMBERS = 8
_LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "km": 1e3, "ft": 0.3048, "feet": 0.3048, "in": 0.0254,
            "inch": 0.0254, "um": 1e-6}  # fmt: skip
_OTHERS = re.compile(r"v|vel|velocity|a|acc|accel|b|w|gyr|gyro|omega|lin|linear|ang|angular|bias|cov|sigma|std")


@dataclass(frozen=True)
class _Columns:
    """Places of the parts of a pose in a row.

    Attributes:
        time: column.
        unit: of the times, if the header states it.
        rest: column of what is beyond whole seconds, None for none.
        parts: of a second in it.
        pose: columns of ``tx ty tz qx qy qz qw``.
        length: metres of a unit of the positions.
    """

    time: int
    unit: str | None
    pose: tuple[int, ...]
    length: float = 1.0
    rest: int | None = None
    parts: int = PARTS["ns"]


_TUM = _Columns(0, None, tuple(range(1, _NUMBERS)))
_EUROC = _Columns(0, "ns", (1, 2, 3, 5, 6, 7, 4))  # state_groundtruth_estimate0/data.csv: velocity and biases follow
_EUROC_NUMBERS = 17
_NANOSECONDS = 10**15  # since 1970, at least
_JOINED = re.compile(  # before an axis: "posx"
    r"(?:pos|position|trans|translation|loc|location|tvec|coord|point|center|centre|gt|est|world|cam|camera|quat|"
    r"quaternion|rot|rotation|orient|orientation)$"
)
_BRACKETS = re.compile(r"[\[(]\s*([a-z]+)\s*[\])]")
_OF_CAMERA = re.compile(r"(?:^|[^a-z])[tqrp]?_?(?:cw|c_w|w2c)(?:[^a-z]|$)")  # T_cw
_IN_WORLD = re.compile(r"([tpq]_?[wxyz])_(?:world|odom|map)_[a-z]+")  # of Project Aria
_RIGID = 0.02  # largest deviation of a rotation from an orthogonal matrix
_MATRIX = {13: 12, 17: 16}  # numbers of a row of a time and a matrix, and of the matrix


def read_pose_table(path: Path) -> tuple[Clock, np.ndarray, list[int]]:
    """Read rows of a time and a pose.

    A header that names the columns is followed: in any order, with ``q_w`` before or behind ``q_x``, and further
    columns besides. Without one a row is ``timestamp tx ty tz qx qy qz qw``, one of 17 numbers of EuRoC, or a time and
    a 3x4 or 4x4 matrix, row by row (or column by column, if it is rigid only so). Rows whose position or quaternion is
    NaN throughout, or whose matrix is not finite, are left out: there is no pose at that time.

    Args:
        path: text or CSV file.

    Returns:
        Times, ``(N, 7)`` float64 ``tx ty tz qx qy qz qw`` (not normalised), and the lines of the rows.

    Raises:
        DvoError: missing or malformed file, no rows, a header without what makes a pose, a row of other numbers, or 17
            numbers whose time is no nanoseconds.
    """
    table = read_table(path, f"give a file of rows '{HEADER}'")
    if not table.rows:
        raise DvoError("no poses in it", file=path, remedy=f"give a file of rows '{HEADER}'")
    columns = None if table.header is None else _named(table.header, path)
    if columns is None and table.header is not None and not table.is_comment:
        names = ", ".join(table.header)[:200]
        raise DvoError(
            f"the header '{names}' does not name a time, a position and a quaternion",
            file=path, field="header", remedy=f"name the columns as in '{HEADER}'",
        )  # fmt: skip
    width = len(table.rows[0])
    named = width if columns is None else len(table.header or ())
    if named != width:  # an empty field would shift the others
        message = f"the header names {named} columns, this row has {width}"
        raise DvoError(message, file=path, field=f"line {table.lines[0]}", remedy="give each column a name and a value")
    if columns is None and (by_columns := _are_matrices(table.rows)) is not None:
        table = replace(table, rows=[_of_matrix(fields, by_columns) for fields in table.rows])
        width = _NUMBERS
    elif columns is None and width == _EUROC_NUMBERS and _time_of(table.rows[0]) < _NANOSECONDS:
        message = "17 numbers without a header, as EuRoC's, but with a time that is no nanoseconds"
        raise DvoError(message, file=path, field=f"line {table.lines[0]}", remedy="name the columns in the first line")
    if columns is None and width == _NUMBERS and _ends_in_comma(path, table.lines[0]):
        message = "8 numbers without a header, and a comma behind them, as VINS writes poses with q_w before q_x"
        remedy = "write timestamp,tx,ty,tz,qw,qx,qy,qz as the first line, or the order that they have"
        raise DvoError(message, file=path, field=f"line {table.lines[0]}", remedy=remedy)
    columns = columns or (_EUROC if width == _EUROC_NUMBERS else _TUM)
    expected = width if columns is not _TUM else _NUMBERS
    times: list[int | float] = []
    poses, lines = [], []
    for line, fields in zip(table.lines, table.rows, strict=True):
        if len(fields) != expected:
            raise _no_row(path, line)
        try:
            texts = [fields[k] for k in columns.pose]
            if all(text.lower() == "nan" for text in texts[:3]) or all(text.lower() == "nan" for text in texts[3:]):
                parse_time(fields[columns.time])
                continue
            pose = [parse_number(text) for text in texts]
            time = parse_time(fields[columns.time])
            if columns.rest is not None:
                time = int(time) * PARTS["ns"] + int(parse_time(fields[columns.rest])) * (PARTS["ns"] // columns.parts)
            times.append(time)
        except (ValueError, IndexError):
            raise _no_row(path, line) from None
        poses.append(pose)
        lines.append(line)
    if not poses:
        raise DvoError("no poses in it, all rows are NaN", file=path, remedy=f"give a file of rows '{HEADER}'")
    refuse_lost_zeros([fields[columns.time] for fields in table.rows], path)
    unit = columns.unit or unit_of(times, poses=True)
    seconds, values = in_seconds(times, unit), np.array(poses, dtype=np.float64)
    beyond = np.flatnonzero(~(np.abs(seconds) <= MAX_NUMBER))
    if len(beyond):
        raise _no_row(path, lines[int(beyond[0])])
    values[:, :3] *= columns.length
    return Clock(seconds, unit, columns.time), values, lines


def names_a_pose(path: Path) -> bool:
    """True for a file whose header, a comment too, names a time, a position and a quaternion.

    Args:
        path: text or CSV file.

    Raises:
        DvoError: the file cannot be read, or see :func:`read_pose_table`.
    """
    header = read_table(path, f"give a file of rows '{HEADER}'").header
    return header is not None and _named(header, path) is not None


def _ends_in_comma(path: Path, number: int) -> bool:
    lines = read_lines(path, f"give a file of rows '{HEADER}'")
    return next(line for count, line in lines if count == number).split("#")[0].rstrip().endswith(",")


def _are_matrices(rows: Sequence[Sequence[str]]) -> bool | None:
    """False for rows of a time and a rigid 3x4 or 4x4 matrix, True if it stands column by column (ARKit), else None."""
    count = _MATRIX.get(len(rows[0]))
    if count is None or any(len(fields) != 1 + count for fields in rows):
        return None
    try:
        matrices = np.array([[float(field) for field in fields[1:]] for fields in rows]).reshape(len(rows), -1, 4)
    except ValueError:
        return None
    matrices = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if len(matrices) and _are_rigid(matrices):
        return False
    return True if len(matrices) and count == 16 and _are_rigid(np.swapaxes(matrices, 1, 2)) else None


def _are_rigid(matrices: np.ndarray) -> bool:
    rotations = matrices[:, :3, :3]
    products = rotations @ np.swapaxes(rotations, 1, 2)
    is_rigid = np.abs(products - np.eye(3)).max(initial=0) < _RIGID and (np.linalg.det(rotations) > 0).all()
    return bool(is_rigid and (matrices[:, 3:] == [0, 0, 0, 1]).all())


def _of_matrix(fields: Sequence[str], by_columns: bool) -> list[str]:
    """The same pose as ``tx ty tz qx qy qz qw``."""
    matrix = np.array([float(field) for field in fields[1:]]).reshape(-1, 4)
    matrix = (matrix.T if by_columns else matrix)[:3]
    pose = poses_from_matrices(matrix) if np.isfinite(matrix).all() else np.full(_NUMBERS - 1, np.nan)
    return [fields[0], *map(repr, pose.tolist())]


def _time_of(fields: Sequence[str]) -> float:
    """The first field of a row, 0 if it is no number."""
    try:
        return parse_time(fields[0])
    except ValueError:
        return 0.0


def _no_row(path: Path, line: int) -> DvoError:
    return DvoError("not a TUM row", file=path, field=f"line {line}", remedy=f"use '{HEADER}'")


def _named(header: Sequence[str], path: Path) -> _Columns | None:
    """Columns that a header names; None if it does not name all.

    Raises:
        DvoError: poses of the world in the camera, or of two trajectories.
    """
    times = named_times(header)
    found: dict[str, list[int]] = {}
    for k, cell in enumerate(header):
        if _OF_CAMERA.search(cell.lower()):
            remedy = "give poses of the camera in the world, T_wc"
            raise DvoError("poses of the world in the camera", file=path, field=f"column {cell[:40]!r}", remedy=remedy)
        name = re.sub(r"[\[(].*?[\])]", "", cell.lower()).strip()
        in_world = _IN_WORLD.fullmatch(name)
        part = _part(in_world[1] if in_world else name)
        if part is not None:
            found.setdefault(part, []).append(k)
    if times is None or len(found) < _NUMBERS - 1:
        return None
    if all(len(columns) > 1 for columns in found.values()):
        both = f"{header[found['tx'][0]][:40]!r} and {header[found['tx'][1]][:40]!r}"
        remedy = "leave the columns of one of them"
        raise DvoError(f"two trajectories, {both}", file=path, field="header", remedy=remedy)
    pose = tuple(found[part][0] for part in ("tx", "ty", "tz", "qx", "qy", "qz", "qw"))
    units = {_BRACKETS.search(header[k].lower()) for k in pose[:3]}
    lengths = {_LENGTHS.get(unit[1], 1.0) if unit else 1.0 for unit in units}
    if len(lengths) > 1:
        names = ", ".join(header[k] for k in pose[:3])[:80]
        remedy = "give all of them in metres"
        raise DvoError(f"positions in several units: {names}", file=path, field="header", remedy=remedy)
    (length,) = lengths
    column, unit_of_time, rest = times
    if rest is None:
        return _Columns(column, unit_of_time, pose, length)
    return _Columns(column, "ns", pose, length, rest, parts_of(header, rest))


def _part(name: str) -> str | None:
    """Part of a pose that a column holds, such as ``p_RS_R_x``, ``pose.orientation.w`` or ``tz``."""
    axis = re.fullmatch(r"(.*?)([_. ]?)([wxyz])", name)
    if axis is None:
        return None
    head = axis[1]
    joined = re.search(r"[a-z]*$", head)
    if not axis[2] and len(joined[0] if joined else "") > 1 and not _JOINED.search(head):
        return None  # such as "index"
    words = re.split(r"[^a-z]+", head)
    if any(word.startswith(("q", "orient", "quat", "rot")) for word in words) or (axis[3] == "w" and not head):
        return f"q{axis[3]}"
    is_other = axis[3] == "w" or _OTHERS.fullmatch(words[0]) or {"linear", "angular", "velocity"} & set(words)
    return None if is_other else f"t{axis[3]}"
