"""Calibration of the text of DSO and LSD-SLAM: a model with its numbers, the size, what is done with it, the size then.

The first line is ``[Pinhole|FOV|RadTan|EquiDistant|KannalaBrandt] fx fy cx cy ...``; without a name, 5 numbers are
``fov`` and 8 ``radtan``. If cx and cy are below 1, the four are relative to the size, and pixels are counted from the
corner of the first one (README of https://github.com/JakobEngel/dso). The lines after the size tell how DSO crops the
undistorted image; images as recorded are those of the first two.
"""

from __future__ import annotations

from pathlib import Path

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect
from dvo.data.calibration.colmap_cameras import CORNER
from dvo.geometry.camera import DistortionModel

_MODELS: dict[str, tuple[DistortionModel, int]] = {
    "pinhole": ("none", 5), "fov": ("fov", 5), "atan": ("fov", 5), "radtan": ("radtan", 8),
    "equidistant": ("fisheye", 8), "kannalabrandt": ("fisheye", 8),
}  # fmt: skip
_REMEDY = "write 'MODEL fx fy cx cy ...' on the first line and 'width height' on the second, as DSO has them"


def _rows(text: str) -> list[list[str]]:
    rows = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
    return [row for row in rows if row]


def _numbers(row: list[str]) -> list[float] | None:
    try:
        return [float(field) for field in row]
    except ValueError:
        return None


def is_dso(path: Path, text: str) -> bool:
    """True for a first line of a model's numbers and a second one of a size.

    Args:
        path: of the file.
        text: its content.
    """
    rows = _rows(text[:4000])
    if len(rows) < 2:
        return False
    named = rows[0][0].lower() in _MODELS
    values = _numbers(rows[0][named:])
    size = rows[1]
    fits = values is not None and (named or len(values) in (5, 8))
    return fits and len(size) == 2 and all(field.isdecimal() and int(field[:9]) >= 2 for field in size)


def dso_calibration(path: Path, text: str) -> Calibration:
    """Calibration of the images as recorded.

    Args:
        path: of the file, for messages.
        text: its content.

    Raises:
        DvoError: another number of parameters than the model has.
    """
    rows = _rows(text)
    name = rows[0][0].lower() if rows[0][0].lower() in _MODELS else ""
    values = _numbers(rows[0][bool(name) :]) or []
    width, height = (int(field[:9]) for field in rows[1])
    model, count = _MODELS[name] if name else ("fov" if len(values) == 5 else "radtan", len(values))
    if len(values) != count and not (name == "pinhole" and len(values) == 4):
        message = f"{len(values)} numbers of the model {rows[0][0]}, expected {count}"
        raise DvoError(message, file=path, field="line 1", remedy=_REMEDY)
    fx, fy, cx, cy, *coefficients = values
    if model == "none" and any(coefficients):
        message = f"the model {rows[0][0]} with a distortion of {coefficients[0]:g}"
        raise DvoError(message, file=path, field="line 1", remedy="name the model FOV, or write 0")
    if model == "none" or (model in ("fov", "radtan") and not any(coefficients)):
        model, coefficients = "none", []
    if cx < 1 and cy < 1:
        fx, fy, cx, cy = fx * width, fy * height, cx * width - CORNER, cy * height - CORNER
    ignored = tuple(f"line {number}: {' '.join(row)[:60]}" for number, row in enumerate(rows[2:], start=3))
    return Calibration(fx, fy, cx, cy, model, tuple(coefficients), width, height, path, ignored=ignored)


DIALECT = Dialect(is_dso, lambda path, text, camera: dso_calibration(path, text))
