"""Calibration of KITTI's raw recordings: ``calib_cam_to_cam.txt``.

The images of the "synced+rectified" recordings are those of the rows ``P_rect_0N`` and ``S_rect_0N``; those of the
unsynced ones are as recorded, ``K_0N``, ``D_0N`` and ``S_0N`` (readme of the development kit).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect
from dvo.data.calibration.values import from_matrix

_ROW = re.compile(r"^(P_rect|S_rect|K|D|S)_(\d\d):(.*)$", re.MULTILINE)
_REMEDY = "use KITTI's calib_cam_to_cam.txt"


def kitti_raw_calibration(path: Path, text: str, camera: int | None = None) -> Calibration:
    """Calibration of the rectified images of a camera; of those as recorded if the file has no rectified ones.

    Args:
        path: of the file, for messages.
        text: its content.
        camera: number of the camera, 0 to 3; None if all of them have the same intrinsics.

    Raises:
        DvoError: a malformed row, no camera of that number, or several with different intrinsics and no number.
    """
    rows: dict[tuple[str, int], np.ndarray] = {}
    for kind, number, rest in _ROW.findall(text):
        try:
            rows[kind, int(number)] = np.array([float(value) for value in rest.split()])
        except ValueError:
            raise DvoError("not a number", file=path, field=f"{kind}_{number}", remedy=_REMEDY) from None
    kind = "P_rect" if any(key == "P_rect" for key, _ in rows) else "K"
    numbers = sorted(number for key, number in rows if key == kind)
    if camera is not None and camera not in numbers:
        known = ", ".join(map(str, numbers))
        raise DvoError(f"no camera {camera} in it", file=path, field="calibration", remedy=f"name one of {known}")
    found = {n: _camera(rows, kind, n, path) for n in (numbers if camera is None else [camera])}
    first = next(iter(found.values()))
    if any(other != first for other in found.values()):
        known = ", ".join(map(str, numbers))
        raise DvoError(f"{len(found)} cameras in it: {known}", file=path, field="calibration",
                       remedy=f"name the one of the images: {path.name}:{numbers[0]}")  # fmt: skip
    return first


def _camera(rows: dict[tuple[str, int], np.ndarray], kind: str, number: int, path: Path) -> Calibration:
    is_rectified = kind == "P_rect"
    values, size = rows[kind, number], rows.get(("S_rect" if is_rectified else "S", number))
    if len(values) != (12 if is_rectified else 9):
        raise DvoError(f"{len(values)} numbers", file=path, field=f"{kind}_{number:02}", remedy=_REMEDY)
    read = from_matrix(values.reshape(3, -1)[:, :3], path)
    whole = size is not None and len(size) == 2 and (size == np.rint(size)).all() and ((size > 0) & (size <= 1e6)).all()
    width, height = (int(side) for side in size) if whole and size is not None else (None, None)
    d = rows.get(("D", number), np.zeros(0))
    is_bent = not is_rectified and bool(d.any())
    if is_bent and len(d) not in (4, 5):
        raise DvoError(f"{len(d)} coefficients", file=path, field=f"D_{number:02}", remedy=_REMEDY)
    notes: tuple[str, ...] = ()
    if is_rectified and d.any():
        notes = (
            "the calibration is that of KITTI's rectified images (P_rect); K and D are those of the recorded ones",
        )
    return Calibration(
        read.fx, read.fy, read.cx, read.cy, "radtan" if is_bent else "none", tuple(map(float, d)) if is_bent else (),
        width, height, path, ignored=tuple(sorted({key for key, _ in rows} - {kind, f"S{kind[1:]}"})), notes=notes,
    )  # fmt: skip


DIALECT = Dialect(lambda path, text: re.search(r"^(?:P_rect|K)_\d\d:", text, re.MULTILINE) is not None,
                  kitti_raw_calibration)  # fmt: skip
