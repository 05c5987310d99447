"""Calibration of a scene of OpenMVG, ``sfm_data.json``: a list of ``intrinsics`` as cereal writes polymorphic values.

The type of a camera is named where it first occurs, and is a number afterwards; the pinhole part of a camera with
distortion stands in ``value0`` or beside it (https://openmvg.readthedocs.io/en/latest/openMVG/cameras/cameras/).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect, one_of
from dvo.data.calibration.documents import load_json
from dvo.data.calibration.values import from_values

_LENSES = {
    "pinhole": ("", ()),
    "pinhole_radial_k1": ("disto_k1", (0,)),
    "pinhole_radial_k3": ("disto_k3", (0, 1, None, None, 2)),
    "pinhole_brown_t2": ("disto_t2", (0, 1, 3, 4, 2)),
    "fisheye": ("fisheye", (0, 1, 2, 3)),
}
"""Key of the coefficients, and their positions in the order of dvo; None is 0."""
_FIRST = 0x80000000  # is set in the number of a type where it is named
_REMEDY = "give sfm_data.json of OpenMVG with a pinhole, radial, brown or fisheye camera"


def is_openmvg(path: Path, text: str) -> bool:
    """True for JSON with a version of OpenMVG's scenes.

    Args:
        path: of the file.
        text: its content.
    """
    return text.lstrip()[:1] == "{" and re.search(r'"sfm_data_version"\s*:', text) is not None


def openmvg_calibration(path: Path, text: str, camera: int | None) -> Calibration:
    """Calibration of the only camera, or of that of a number.

    Args:
        path: of the file, for messages.
        text: its content.
        camera: position among the ``intrinsics``; None for none.

    Raises:
        DvoError: cameras that differ, one of another type, or a malformed file.
    """
    listed = load_json(text, path).get("intrinsics")
    if not isinstance(listed, list):
        raise DvoError("no list of cameras", file=path, field="intrinsics", remedy=_REMEDY)
    types: dict[int, str] = {}
    cameras = []
    for number, one in enumerate(listed):
        value = one.get("value") if isinstance(one, dict) else None
        wrapper = value.get("ptr_wrapper") if isinstance(value, dict) else None
        data = wrapper.get("data") if isinstance(wrapper, dict) else None
        if not isinstance(value, dict) or not isinstance(data, dict):
            raise DvoError("no camera", file=path, field=f"intrinsics[{number}]", remedy=_REMEDY)
        known = value.get("polymorphic_id")
        kind = known % _FIRST if isinstance(known, int) else -1
        named = types.setdefault(kind, str(value.get("polymorphic_name", "")))
        cameras.append((str(one.get("key")), _calibration(data, named, path)))
    return one_of(cameras, camera, path)


def _calibration(data: dict[str, Any], kind: str, path: Path) -> Calibration:
    if kind not in _LENSES:
        raise DvoError(f"{kind[:40]!r} is not read", file=path, field="polymorphic_name", remedy=_REMEDY)
    inner = data.get("value0")
    values = data | (inner if isinstance(inner, dict) else {})
    key, order = _LENSES[kind]

    def numbers(name: str, count: int) -> list[float]:
        value: Any = values.get(name)
        listed: list[Any] = value if isinstance(value, list) else [value]
        try:
            found = [float(part) for part in listed]
        except (TypeError, ValueError, OverflowError):
            found = []
        if not found or len(found) > count:
            raise DvoError(f"expected {count} numbers", file=path, field=name, remedy=_REMEDY)
        return found + [0.0] * (count - len(found))

    other = [name for name in values if name.startswith(("disto_", "fisheye")) and name != key and values[name]]
    if other:
        raise DvoError(f"not of the type {kind}", file=path, field=str(other[0])[:40], remedy=_REMEDY)
    listed = numbers(key, sum(place is not None for place in order)) if key else []
    lens = [0.0 if place is None else listed[place] for place in order]
    model = "fisheye" if kind == "fisheye" else "radtan" if lens else "none"
    lens += [0.0] * (4 - len(lens)) if model == "radtan" else []
    focal, centre = numbers("focal_length", 1)[0], numbers("principal_point", 2)
    sizes = {name: numbers(name, 1)[0] for name in ("width", "height")}
    found = {"fx": focal, "fy": focal, "cx": centre[0], "cy": centre[1], **sizes}
    return from_values({**found, "model": model, "coefficients": lens}, path)


DIALECT = Dialect(is_openmvg, openmvg_calibration)
