"""Calibration of Luxonis' DepthAI, the JSON of an OAK camera (``CalibrationHandler.eepromToJsonFile``).

``cameraData`` has pairs of a socket and its camera: ``intrinsicMatrix`` for images of ``width`` and ``height``,
``cameraType`` 0 (perspective) or 1 (fisheye), and ``distortionCoeff`` in the order of OpenCV, zeros appended.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect, one_of
from dvo.data.calibration.documents import load_json
from dvo.data.calibration.lens_names import says_nothing
from dvo.data.calibration.values import from_values

_KINDS = {0: "radtan", 1: "fisheye"}
_REMEDY = "write it with eepromToJsonFile again"


def is_depthai(path: Path, text: str) -> bool:
    """True for JSON with ``cameraData``.

    Args:
        path: of the file.
        text: its content.
    """
    return text.lstrip()[:1] == "{" and re.search(r'"cameraData"\s*:\s*\[', text) is not None


def depthai_calibration(path: Path, text: str, camera: int | None) -> Calibration:
    """Calibration of the only socket with intrinsics, or of that of a number.

    Args:
        path: of the file, for messages.
        text: its content.
        camera: position among the sockets with intrinsics, from 0; None for any, if all are the same.

    Raises:
        DvoError: cameras that differ, another type of camera, or no numbers.
    """
    data = load_json(text, path)
    pairs = data.get("cameraData")
    if not isinstance(pairs, list) or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
        raise DvoError("no pairs of socket and camera", file=path, field="cameraData", remedy=_REMEDY)
    known = [(socket, one) for socket, one in pairs if isinstance(one, dict) and not _is_empty(one)]
    found = [
        (f"socket {socket} {one.get('width')}x{one.get('height')}", _calibration(one, path)) for socket, one in known
    ]
    ignored = tuple(key for key in data if key != "cameraData")
    return replace(one_of(found, camera, path), ignored=ignored)


def _is_empty(one: dict[str, Any]) -> bool:
    """True for a socket that has not been calibrated."""
    return says_nothing(one.get("intrinsicMatrix"))


def _calibration(one: dict[str, Any], path: Path) -> Calibration:
    kind = one.get("cameraType", 0)
    if not isinstance(kind, int) or kind not in _KINDS:
        remedy = "give a camera of type 0 (perspective) or 1 (fisheye)"
        raise DvoError(f"cameras of type {str(kind)[:20]} are not known", file=path, field="cameraType", remedy=remedy)
    values = {"K": one.get("intrinsicMatrix"), "model": _KINDS[kind], "coefficients": one.get("distortionCoeff")}
    return from_values(values | {name: one.get(name) for name in ("width", "height")}, path)


DIALECT = Dialect(is_depthai, depthai_calibration)
