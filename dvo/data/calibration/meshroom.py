"""Calibration of a scene of Meshroom (AliceVision): ``cameras.sfm``, ``sfm.json``, numbers written as texts.

Versions below 1.2.2 have the focal length in pixels, later ones in millimetres of ``sensorWidth``; from 1.2.1 on the
principal point is counted from the middle of the image (https://github.com/alicevision/AliceVision,
``sfmDataIO/jsonIO.cpp``).
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect, one_of
from dvo.data.calibration.documents import load_json
from dvo.data.calibration.values import from_values

_LENSES = {
    "pinhole": ("none", ()),
    "radial1": ("radtan", (0,)),
    "radial3": ("radtan", (0, 1, None, None, 2)),
    "brown": ("radtan", (0, 1, 3, 4, 2)),
    "fisheye4": ("fisheye", (0, 1, 2, 3)),
}
"""Lens model of dvo, and the positions of its coefficients among ``distortionParams``; None is 0."""
_OTHER_NAMES = {"radialk1": "radial1", "radialk3": "radial3", "": "pinhole", "none": "pinhole"}
_REMEDY = "give cameras.sfm of the node StructureFromMotion, estimated with a pinhole, radial, brown or fisheye4 camera"


def is_meshroom(path: Path, text: str) -> bool:
    """True for JSON with intrinsics under the names of AliceVision.

    Args:
        path: of the file.
        text: its content.
    """
    keys = ("intrinsics", "intrinsicId")
    return text.lstrip()[:1] == "{" and all(re.search(rf'"{key}"\s*:', text) for key in keys)


def meshroom_calibration(path: Path, text: str, camera: int | None) -> Calibration:
    """Calibration of the only camera, or of that of a number.

    Args:
        path: of the file, for messages.
        text: its content.
        camera: position among the ``intrinsics``; None for none.

    Raises:
        DvoError: a project in place of a scene, cameras that differ, another lens model, or a malformed file.
    """
    data = load_json(text, path)
    listed, version = data.get("intrinsics"), data.get("version")
    if not isinstance(listed, list) or not all(isinstance(one, dict) for one in listed):
        raise DvoError("no list of cameras", file=path, field="intrinsics", remedy=_REMEDY)
    if not isinstance(version, list) or len(version) != 3:
        raise DvoError("no version of three numbers", file=path, field="version", remedy=_REMEDY)
    stated = tuple(int(_number(part, "version", path)) for part in version)
    read = [(str(one.get("intrinsicId")), _calibration(one, stated, path)) for one in listed]
    return one_of(read, camera, path)


def _calibration(values: dict[str, Any], version: tuple[int, ...], path: Path) -> Calibration:
    def number(name: str, default: float | None = None) -> float:
        return _number(values.get(name, default), name, path)

    def pair(name: str) -> list[float]:
        value = values.get(name)
        value = [value.get("x"), value.get("y")] if isinstance(value, dict) else value
        if not isinstance(value, list) or len(value) != 2:
            raise DvoError("no two numbers", file=path, field=name, remedy=_REMEDY)
        return [_number(part, name, path) for part in value]

    width, height = number("width"), number("height")
    cx, cy = pair("principalPoint")
    if version >= (1, 2, 1):
        cx, cy = cx + width / 2, cy + height / 2
    if version < (1, 2, 0):
        fx = fy = number("pxFocalLength")
    elif version < (1, 2, 2):
        fx, fy = pair("pxFocalLength")
    else:
        sensor, ratio = number("sensorWidth"), number("pixelRatio", 1.0)
        if sensor <= 0 or ratio <= 0:
            raise DvoError("not positive", file=path, field="sensorWidth, pixelRatio", remedy=_REMEDY)
        fx = number("focalLength") / sensor * width
        fy = fx * ratio if version >= (1, 2, 5) else fx / ratio
    kinds = [str(values.get(name) or "").lower() for name in ("undistortionType", "type", "distortionType")]
    kinds = [_OTHER_NAMES.get(kind, kind) for kind in kinds]
    unread = [kind for kind in kinds if kind not in _LENSES]
    if unread:
        raise DvoError(f"{unread[0][:40]!r} is not read", file=path, field="type", remedy=_REMEDY)
    kind = kinds[2] if kinds[2] != "pinhole" else kinds[1]
    model, order = _LENSES[kind]
    listed = values.get("distortionParams") or []
    if not isinstance(listed, list):
        raise DvoError("no list of numbers", file=path, field="distortionParams", remedy=_REMEDY)
    numbers = [_number(part, "distortionParams", path) for part in listed]
    if any(numbers[sum(place is not None for place in order) :]):
        message = f"{len(numbers)} coefficients of {kind}"
        raise DvoError(message, file=path, field="distortionParams", remedy=_REMEDY)
    lens = [0.0 if place is None or place >= len(numbers) else numbers[place] for place in order]
    lens += [0.0] * (4 - len(lens)) if model == "radtan" else []
    found = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height}
    return from_values({**found, "model": model, "coefficients": lens}, path)


def _number(value: Any, name: str, path: Path) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise DvoError(f"no number: {str(value)[:40]!r}", file=path, field=name, remedy=_REMEDY)
    return number


DIALECT = Dialect(is_meshroom, meshroom_calibration)
