"""Calibration of a pair of Middlebury's stereo benchmark, and of ETH3D's two-view one: ``calib.txt``.

``cam0=[f 0 cx; 0 f cy; 0 0 1]``, ``cam1`` for the right images, ``doffs``, which is cx of ``cam1`` less that of
``cam0``, ``baseline`` in millimetres, ``width`` and ``height`` (https://vision.middlebury.edu/stereo/data/scenes2014/).
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect
from dvo.data.calibration.values import from_values

_ENTRY = re.compile(r"^\s*(\w+)\s*=\s*(.*?)\s*$", re.MULTILINE)
_MATRIX = re.compile(r"^\s*cam[01]\s*=\s*\[", re.MULTILINE)
_REMEDY = "write cam0=[fx 0 cx; 0 fy cy; 0 0 1], baseline= (millimetres), width= and height= as Middlebury has them"
_SAME = 1e-6  # pixels


def is_middlebury(path: Path, text: str) -> bool:
    """True for text with a matrix ``cam0=[...]``.

    Args:
        path: of the file.
        text: its content.
    """
    return _MATRIX.search(text) is not None


def middlebury_calibration(path: Path, text: str, camera: int | None) -> Calibration:
    """Calibration of the left camera, or of that of a number.

    Args:
        path: of the file, for messages.
        text: its content.
        camera: 0 or 1; None for 0.

    Raises:
        DvoError: another number, an entry twice or one that is no number, or no matrix of a camera.
    """
    found: dict[str, list[float]] = {}
    for key, value in _ENTRY.findall(text):
        try:
            numbers = [float(word) for word in re.sub(r"[\[\];,]", " ", value).split()]
        except ValueError:
            numbers = []
        if key in found or not numbers:
            message = "twice in it" if key in found else f"no numbers: {value[:60]!r}"
            raise DvoError(message, file=path, field=key, remedy=_REMEDY)
        found[key] = numbers
    name = f"cam{camera or 0}"
    if name not in found:
        raise DvoError(f"no {name} in it", file=path, field="calibration", remedy=_REMEDY)
    sizes = {key: found[key][0] for key in ("width", "height") if key in found}
    calibration = from_values({"K": found[name], **sizes}, path)
    offset, baseline = found.get("doffs", [0.0])[0], found.get("baseline", [0.0])[0] / 1000
    used, notes = {name, *sizes, "doffs", "baseline"}, calibration.notes
    if baseline and not camera and abs(offset) > _SAME:
        notes += (
            f"the principal points of the two cameras differ by doffs={offset:g} pixels: the baseline is not used, as "
            "distances of right images would be wrong",
        )
    known = baseline if baseline > 0 and not camera and abs(offset) <= _SAME else None
    ignored = tuple(key for key in found if key not in used)
    return replace(calibration, baseline=known, ignored=ignored, notes=notes)


DIALECT = Dialect(is_middlebury, middlebury_calibration)
