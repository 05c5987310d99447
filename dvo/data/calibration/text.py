"""Calibrations of plain text: numbers on one line or one a line, the same by name, or a matrix K on three lines."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import EXPECTED, Calibration, Dialect
from dvo.data.calibration.documents import load_documents
from dvo.data.calibration.kitti import kitti_calibration
from dvo.data.calibration.named_values import read_named_values
from dvo.data.calibration.values import from_matrix, from_values
from dvo.geometry.camera import DistortionModel


def from_text(text: str, path: Path) -> Calibration:
    """Calibration of a plain text, see :func:`dvo.data.calibration.read.read_calibration`.

    Args:
        text: content of the file.
        path: of the file, for messages.

    Raises:
        DvoError: other numbers than those of a calibration.
    """
    named = read_named_values(text, path, EXPECTED)
    rows: list[list[float]] = [] if named is None else [named]
    for line in text.splitlines() if named is None else ():
        fields = _fields(line, path)
        if not fields:
            continue
        if fields[0].rstrip(":").upper() in ("P0", "P1", "P2", "P3"):
            return kitti_calibration(path)
        try:
            rows.append([float(field) for field in fields])
        except ValueError:
            if ":" in line:  # a YAML with a .txt name
                return from_values(load_documents(text, path), path)
            raise DvoError(
                f"not a number in {line.strip()[:100]!r}", file=path, field="intrinsics", remedy=EXPECTED
            ) from None
    if len(rows) > 1 and all(len(row) == 1 for row in rows):  # as numpy.savetxt writes a vector
        rows = [[number for row in rows for number in row]]
    lengths = [len(row) for row in rows]
    if lengths in ([3, 3, 3], [4, 4, 4], [4, 4, 4, 4]):
        return from_matrix(np.array(rows), path)
    if lengths in ([9], [12], [16]) and _is_matrix(rows[0]):
        return from_matrix(np.array(rows[0]).reshape(3 if lengths[0] < 16 else 4, -1), path)
    if path.suffix.lower() == ".pincam" and lengths == [6]:  # ARKitScenes
        return from_values({"intrinsics": rows[0][2:], "resolution": rows[0][:2]}, path)
    if len(rows) != 1 or len(rows[0]) not in (4, 8, 9, 12):
        counts = " + ".join(str(len(row)) for row in rows[:10]) or "no"
        raise DvoError(
            f"{counts} numbers, expected 4, 8, 9 or 12 on one line", file=path, field="intrinsics", remedy=EXPECTED
        )
    fx, fy, cx, cy, *coefficients = rows[0]
    model: DistortionModel = "radtan" if any(coefficients) else "none"
    return Calibration(fx, fy, cx, cy, model, tuple(coefficients) if model == "radtan" else (), file=path)


def _fields(line: str, path: Path) -> list[str]:
    """Words of a line, without comment and the brackets of a printed array; decimal commas as points."""
    line = line.split("#")[0].replace(";", " ")
    words = line.split()
    if len(words) > 3 and all(re.fullmatch(r"-?\d+,\d+", word) for word in words):
        fx, fy = map(int, words[0].split(","))
        if fy < 3 * fx < 9 * fy:
            message = f"commas between numbers, or within them, in {line.strip()[:100]!r}"
            raise DvoError(message, file=path, field="intrinsics", remedy="write decimal points, and blanks between")
        return [word.replace(",", ".") for word in words]
    return re.sub(r"[\[\](),]|\barray\b", " ", line).split()


def _is_matrix(row: list[float]) -> bool:
    """True for K, row by row or column by column, and for ``K [I | t]``, on one line."""
    if len(row) == 9:
        return row[8] == 1 and (row[3] == row[6] == row[7] == 0 or row[1] == row[2] == row[5] == 0)
    return row[4] == row[8] == row[9] == 0 and row[10] == 1


DIALECT = Dialect(lambda path, text: True, lambda path, text, camera: from_text(text, path))
