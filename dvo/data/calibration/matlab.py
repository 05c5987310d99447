"""Calibration of MATLAB: cameraParameters as JSON and as it is displayed, and ``.m`` files of Bouguet's toolbox.

``cameraParameters`` and ``cameraIntrinsics`` have ``IntrinsicMatrix`` transposed (``K`` is not), ``ImageSize`` as rows
and columns, radial and tangential coefficients apart, and count pixel centres from 1, so 1 is subtracted from the
principal point (https://www.mathworks.com/help/vision/ref/cameraintrinsicstoopencv.html). Bouguet's toolbox
(``Calib_Results.m``: ``fc``, ``cc``, ``alpha_c``, ``kc``, ``nx``, ``ny``) counts from 0, as dvo does.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import EXPECTED, Calibration, Dialect
from dvo.data.calibration.documents import load_json
from dvo.data.calibration.values import from_values

_FIRST_PIXEL = 1.0
_ASSIGNMENT = re.compile(r"^\s*([A-Za-z]\w*)\s*=\s*(\[[^\]]*\]|[-+.\w]+)\s*[;,]?", re.MULTILINE)
_SHOWN = re.compile(r"^\s*([A-Z]\w*):\s*(\[[^\]\n]*\]|[-+.\deE]+)\s*$", re.MULTILINE)
_TOOLBOX = {"fc": "focal_length", "cc": "principal_point", "alpha_c": "skew", "kc": "kc", "nx": "width", "ny": "height"}
_PARAMETERS = ("IntrinsicMatrix", "K", "FocalLength")
_READ = (*_PARAMETERS, "PrincipalPoint", "ImageSize", "RadialDistortion", "TangentialDistortion", "Skew")


def is_matlab(path: Path, text: str) -> bool:
    """True for an ``.m`` file, text with the assignment of ``fc``, and what holds ``RadialDistortion``.

    Args:
        path: of the file.
        text: its content.
    """
    found = path.suffix.lower() == ".m" or re.search(r"^\s*fc(_left)?\s*=\s*\[", text, re.MULTILINE) is not None
    return found or re.search(r'^\s*RadialDistortion:|"RadialDistortion"\s*:', text, re.MULTILINE) is not None


def matlab_calibration(path: Path, text: str, camera: int | None) -> Calibration:
    """Calibration of the camera, or of the first one of a pair.

    Args:
        path: of the file, for messages.
        text: its content.
        camera: number of the camera in JSON of ``stereoParameters``, from 1; None for the first.

    Raises:
        DvoError: skew, or see :func:`dvo.data.calibration.values.from_values`.
    """
    if text.lstrip()[:1] == "{":
        return from_values(_renamed(load_json(text, path), path), path, camera)
    if camera is not None:
        raise DvoError("no numbered cameras in it", file=path, field="calibration", remedy=f"leave out :{camera}")
    if re.search(r"^\s*RadialDistortion:", text, re.MULTILINE):
        shown = {name: value for name, text in _SHOWN.findall(text) if (value := _numbers(text)) is not None}
        return from_values(_renamed(shown, path), path)
    code = re.sub(r"\.\.\.[^\n]*\n", " ", re.sub(r"%[^\n]*", "", text))
    found = {name: value for name, text in _ASSIGNMENT.findall(code) if (value := _numbers(text)) is not None}
    side = "_left" if "fc" not in found and "fc_left" in found else ""
    if f"fc{side}" not in found:
        return from_values(found, path)
    named = {known: f"{name}{side}" if name not in ("nx", "ny") else name for name, known in _TOOLBOX.items()}
    values = {known: found[name] for known, name in named.items() if name in found}
    ignored = tuple(name for name in found if name not in named.values())
    return replace(from_values(values, path), ignored=ignored)


def _numbers(text: str) -> Any:
    """A number, a list of numbers, or a list of rows; None for something else."""
    if not text.startswith("["):
        return float(text) if re.fullmatch(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?", text) else None
    try:
        rows = [[float(word) for word in row.replace(",", " ").split()] for row in re.split(r"[;\n]", text.strip("[]"))]
    except ValueError:
        return None
    rows = [row for row in rows if row]
    if len(rows) == 1 or all(len(row) == 1 for row in rows):
        return [number for row in rows for number in row]
    return rows


def _renamed(value: Any, path: Path) -> Any:
    """The tree with ``cameraParameters`` under names and in the conventions of dvo."""
    if isinstance(value, list):
        return [_renamed(part, path) for part in value]
    if not isinstance(value, dict):
        return value
    if "RadialDistortion" not in value or not any(name in value for name in _PARAMETERS):
        return {name.replace("CameraParameters", "camera"): _renamed(part, path) for name, part in value.items()}
    found = {name: value[name] for name in _READ if value.get(name) is not None}
    size = found.pop("ImageSize", None)
    if isinstance(size, list) and len(size) == 2:
        found["height"], found["width"] = size
    matrices = [found.pop(name) for name in ("K", "IntrinsicMatrix") if name in found]
    if matrices:
        read = from_values({"K": matrices[0]}, path)
        found |= {"FocalLength": [read.fx, read.fy], "PrincipalPoint": [read.cx, read.cy]}
    centre = found.get("PrincipalPoint")
    if not isinstance(centre, list) or not all(isinstance(part, int | float) for part in centre):
        raise DvoError("no two numbers", file=path, field="PrincipalPoint", remedy=EXPECTED)
    found["PrincipalPoint"] = [part - _FIRST_PIXEL for part in centre]
    return found


DIALECT = Dialect(is_matlab, matlab_calibration)
