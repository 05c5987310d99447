"""Calibration of ``camera_models.json`` of OpenSfM and OpenDroneMap.

Lengths are shares of the longer side of the images, and points are counted from their middle:
https://opensfm.org/docs/geometry.html.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect
from dvo.data.calibration.documents import load_json
from dvo.data.calibration.values import from_values
from dvo.data.files.files import MAX_NUMBER

_LENSES = {
    "perspective": ("radtan", ("k1", "k2", "", "")),
    "simple_radial": ("radtan", ("k1", "", "", "")),
    "radial": ("radtan", ("k1", "k2", "", "")),
    "brown": ("radtan", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("fisheye", ("k1", "k2", "", "")),
    "fisheye_opencv": ("fisheye", ("k1", "k2", "k3", "k4")),
}
"""Lens model of dvo, and the coefficients of a projection type in its order; an empty name is 0."""
_KEYS = frozenset(["projection_type", "width", "height", "focal", "focal_x", "focal_y", "c_x", "c_y", "k1", "k2", "k3",
                   "k4", "p1", "p2"])  # fmt: skip


def is_opensfm(path: Path, text: str) -> bool:
    """True for JSON of cameras with a type of projection.

    Args:
        path: of the file.
        text: its content.
    """
    return text.lstrip()[:1] == "{" and re.search(r'"projection_type"\s*:', text) is not None


def opensfm_calibration(path: Path, text: str) -> Calibration:
    """Calibration of all cameras.

    Args:
        path: of the file, for messages.
        text: its content.

    Raises:
        DvoError: cameras that differ, another type of projection, an entry that is not known, or one that is missing.
    """
    data = load_json(text, path)
    cameras = [data] if "projection_type" in data else [one for one in data.values() if isinstance(one, dict)]
    found = [_calibration(one, path) for one in cameras]
    if not found or any(other != found[0] for other in found[1:]):
        message = f"{len(found)} cameras in it" if found else "no camera in it"
        raise DvoError(message, file=path, field="projection_type", remedy="leave that of the images in it")
    return found[0]


def _calibration(values: dict[str, Any], path: Path) -> Calibration:
    kind = str(values.get("projection_type")).lower()
    if kind not in _LENSES:
        raise DvoError(
            f"{kind[:40]!r} is not known", file=path, field="projection_type", remedy=f"use {', '.join(_LENSES)}"
        )
    priors = tuple(name for name in values if name.endswith("_prior"))  # what the estimate began with
    unknown = sorted(set(values) - _KEYS - set(priors))
    if unknown:
        raise DvoError("not known here", file=path, field=str(unknown[0])[:40], remedy="remove it if it is 0")

    def number(*names: str, default: float | None = None) -> float:
        value = next((values[name] for name in names if name in values), default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise DvoError("no number", file=path, field=names[0], remedy="give it as OpenSfM does")
        if abs(value) > MAX_NUMBER:
            raise DvoError("too large", file=path, field=names[0], remedy="give it as OpenSfM does")
        return float(value)

    def pixels(name: str) -> int:
        value = number(name)
        if not value.is_integer() or value < 1:  # NaN is none either
            raise DvoError("no number of pixels", file=path, field=name, remedy="give a whole number")
        return int(value)

    model, names = _LENSES[kind]
    left_out = [name for name in ("k1", "k2", "k3", "k4", "p1", "p2") if name not in names and values.get(name)]
    if left_out:
        raise DvoError(f"{kind} has none", file=path, field=left_out[0], remedy="remove it, or name another type")
    width, height = pixels("width"), pixels("height")
    side = max(width, height)
    found = from_values(
        {
            "fx": side * number("focal_x", "focal"), "fy": side * number("focal_y", "focal_x", "focal"),
            "cx": side * number("c_x", default=0.0) + (width - 1) / 2,
            "cy": side * number("c_y", default=0.0) + (height - 1) / 2,
            "width": width, "height": height, "model": model,
            "coefficients": [number(name, default=0.0) if name else 0.0 for name in names],
        },
        path,
    )  # fmt: skip
    return replace(found, ignored=(*found.ignored, *priors))


DIALECT = Dialect(is_opensfm, lambda path, text, camera: opensfm_calibration(path, text))
