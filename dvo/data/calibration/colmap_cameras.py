"""Calibration from the cameras of a COLMAP model: ``cameras.txt`` and ``cameras.bin``.

Formats: https://colmap.github.io/format.html; models: https://colmap.github.io/cameras.html. COLMAP counts pixels from
the corner of the first one, dvo from its centre: 0.5 is subtracted from principal points. Distortion acts on normalised
coordinates and is the same in both. Binary files are little endian.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.core.yaml_files import MAX_BYTES, is_shell_pipe
from dvo.data.calibration.calibration import Calibration, Dialect
from dvo.data.files.files import is_file, lookups
from dvo.geometry.camera import DistortionModel
from dvo.geometry.lenses import LENSES

CORNER = 0.5
"""Coordinates of the centre of the first pixel in COLMAP."""

_REMEDY = "give cameras.txt or cameras.bin of a COLMAP model"
_SELECTED = re.compile(r"(.+):([0-9]{1,10})", re.DOTALL)

# Number in binary files, and names of the parameters.
_MODELS: dict[str, tuple[int, str]] = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "FOV": (7, "fx fy cx cy omega"),
    "SIMPLE_RADIAL_FISHEYE": (8, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, "f cx cy k1 k2"),
    "THIN_PRISM_FISHEYE": (10, "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, "fx fy cx cy k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4"),
    "SIMPLE_DIVISION": (12, "f cx cy k"),
    "DIVISION": (13, "fx fy cx cy k"),
    "SIMPLE_FISHEYE": (14, "f cx cy"),
    "FISHEYE": (15, "fx fy cx cy"),
    "EUCM": (16, "fx fy cx cy alpha beta"),
    "EQUIRECTANGULAR": (17, "w h"),
}
_LENSES: dict[str, DistortionModel] = {
    "FOV": "fov", "EUCM": "eucm",
    "THIN_PRISM_FISHEYE": "thin_prism_fisheye", "RAD_TAN_THIN_PRISM_FISHEYE": "fisheye624",
}  # fmt: skip
_NAMES = {number: name for name, (number, _) in _MODELS.items()}


@dataclass(frozen=True)
class _Entry:
    """Camera as it stands in a file."""

    identifier: int
    model: str
    width: int
    height: int
    values: tuple[float, ...]


def split_camera(path: Path) -> tuple[Path, int | None]:
    """Split ``cameras.txt:ID``.

    Args:
        path: of a calibration file.

    Returns:
        The file and the number of the camera; the path as it is and None where there is no number, or where a file has
        that very name.
    """
    found = _SELECTED.fullmatch(str(path))
    if found is None or is_file(path):
        return path, None
    return Path(found.group(1)), int(found.group(2))


def is_calibration_file(path: Path) -> bool:
    """True for what :func:`dvo.data.calibration.read.read_calibration` can open: a file, ``FILE:ID``, a pipe of
    the shell.

    Args:
        path: of a calibration.
    """
    return is_file(split_camera(path)[0]) or is_shell_pipe(path)


def is_colmap(path: Path, text: str) -> bool:
    """True for a binary file, and for a text whose first row is ``NUMBER MODEL ...``.

    Args:
        path: of the file.
        text: its content.
    """
    return path.suffix.lower() == ".bin" or _is_list(text)


def colmap_calibration(path: Path, text: str, identifier: int | None = None) -> Calibration:
    """Calibration of a camera of a COLMAP model.

    Args:
        path: a file; ``*.bin`` is read as a binary one.
        text: content of any other file.
        identifier: number of the camera, CAMERA_ID; None for the only one.

    Returns:
        Calibration with the size of the images, whose focal lengths are not checked.

    Raises:
        DvoError: malformed file, several cameras and no number, no camera of that number, or an unknown model.
    """
    entries = _read_binary(path) if path.suffix.lower() == ".bin" else _read_text(text, path)
    if not entries:
        raise DvoError("no camera in it", file=path, field="calibration", remedy=_REMEDY)
    found = {entry.identifier: entry for entry in entries}
    if len(found) < len(entries):
        raise DvoError("two cameras of one number", file=path, field="calibration", remedy=_REMEDY)
    known = ", ".join(map(str, list(found)[:10])) + (", ..." if len(found) > 10 else "")
    if identifier is None and len(found) > 1:
        remedy = f"name one: {path.name}:{entries[0].identifier}"
        raise DvoError(f"{len(found)} cameras in it: {known}", file=path, field="calibration", remedy=remedy)
    entry = entries[0] if identifier is None else found.get(identifier)
    if entry is None:
        message, remedy = f"no camera {identifier} in it", f"name one of {known}"
        raise DvoError(message, file=path, field="calibration", remedy=remedy)
    if not (0 < entry.width <= 10**6 and 0 < entry.height <= 10**6):
        message = f"{entry.width}x{entry.height} is no size of images"
        raise DvoError(message, file=path, field=f"camera {entry.identifier}", remedy=_REMEDY)
    return _calibration(entry, path)


def _is_list(text: str) -> bool:
    first = next((row for row in map(str.split, text.splitlines()) if row and not row[0].startswith("#")), [])
    return len(first) > 1 and first[0].isdecimal() and re.fullmatch(r"[A-Z][A-Z_]{2,}", first[1]) is not None


def _calibration(entry: _Entry, path: Path) -> Calibration:
    if entry.model in ("SIMPLE_DIVISION", "DIVISION", "EQUIRECTANGULAR"):
        raise DvoError(
            f"dvo has no lens model for {entry.model}",
            file=path,
            field=f"camera {entry.identifier}",
            remedy="use OPENCV or OPENCV_FISHEYE in COLMAP, or undistort the images with colmap image_undistorter",
        )
    named = dict(zip(_MODELS[entry.model][1].split(), entry.values, strict=True))
    model = _LENSES.get(entry.model) or ("fisheye" if "FISHEYE" in entry.model else "radtan")
    if model in _LENSES.values():
        coefficients = entry.values[4:]
    else:
        coefficients = tuple(named.get(key, 0.0) for key in LENSES[model].names[:8])
    if model == "radtan":
        used = next(count for count in (4, 5, 8) if not any(coefficients[count:]))
        coefficients = coefficients[:used]
    if model in ("radtan", "fov") and not any(coefficients):
        model, coefficients = "none", ()
    fx, fy = (named.get(key, named.get("f", 0.0)) for key in ("fx", "fy"))
    cx, cy = named["cx"] - CORNER, named["cy"] - CORNER
    return Calibration(fx, fy, cx, cy, model, coefficients, entry.width, entry.height, path)


def _read_text(text: str, path: Path) -> list[_Entry]:
    entries = []
    for line, row in enumerate(text.splitlines(), start=1):
        fields, where = row.split("#")[0].split(), f"line {line}"
        if not fields:
            continue
        name = fields[1] if len(fields) > 1 else ""
        if name not in _MODELS:
            raise DvoError(f"unknown camera model {name[:40]!r}", file=path, field=where, remedy=_REMEDY)
        expected, rest = _MODELS[name][1], fields[2:]
        if len(rest) != 2 + len(expected.split()):
            message = f"{len(rest)} numbers after {name}, expected width height {expected}"
            raise DvoError(message, file=path, field=where, remedy=_REMEDY)
        try:
            number, width, height = (int(field[:20]) for field in (fields[0], *rest[:2]))
            entries.append(_Entry(number, name, width, height, tuple(float(value) for value in rest[2:])))
        except ValueError:
            raise DvoError("not a number", file=path, field=where, remedy=_REMEDY) from None
    return entries


def _read_binary(path: Path) -> list[_Entry]:
    with lookups(path):
        data = path.read_bytes() if path.stat().st_size <= MAX_BYTES else b""
    if len(data) < 8:
        raise DvoError(f"empty, or larger than {MAX_BYTES:,} bytes", file=path, field="calibration", remedy=_REMEDY)
    (count,), at = struct.unpack_from("<Q", data), 8
    entries: list[_Entry] = []
    try:
        while len(entries) < count:
            number, model, width, height = struct.unpack_from("<iiQQ", data, at)
            if model not in _NAMES:
                message, where = f"unknown camera model number {model}", f"camera {number}"
                raise DvoError(message, file=path, field=where, remedy=_REMEDY)
            name = _NAMES[model]
            layout = f"<{len(_MODELS[name][1].split())}d"
            values = struct.unpack_from(layout, data, at + 24)
            entries.append(_Entry(number, name, width, height, values))
            at += 24 + struct.calcsize(layout)
    except struct.error:
        raise DvoError("cut short, or no cameras.bin", file=path, field="calibration", remedy=_REMEDY) from None
    if at != len(data):
        raise DvoError("bytes after the last camera", file=path, field="calibration", remedy=_REMEDY)
    return entries


DIALECT = Dialect(is_colmap, colmap_calibration)
