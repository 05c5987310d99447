"""Calibration as the tools of RealSense print it: ``rs-enumerate-devices -c``, and intrinsics in Python.

A block for each stream and size (``Intrinsic of "Color" / 640x480 / {...}`` with lines ``Width:``, ``PPX:``, ``Fx:``,
``Distortion:``, ``Coeffs:``), or a line ``[ 640x480  p[325.2 238.3]  f[385.3 384.8]  Brown Conrady [0 0 0 0 0] ]``
(https://github.com/IntelRealSense/librealsense/tree/master/tools/enumerate-devices). Pixel centres are at integers.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect, one_of
from dvo.data.calibration.values import from_values

_BLOCK = re.compile(r'Intrinsic of "([^"\n]*)"\s*/?\s*(\d+)\s*x\s*(\d+)')
_LINE = re.compile(
    r"(?P<width>\d+)x(?P<height>\d+)\s+p\[(?P<centre>[^\]\n]*)\]\s+f\[(?P<focal>[^\]\n]*)\]\s+"
    r"(?P<model>[A-Za-z][\w -]*?)\s*\[(?P<coefficients>[^\]\n]*)\]"
)
_ENTRY = re.compile(r"^[\s#%/*]*([A-Za-z]+):\s*(.*?)\s*$", re.MULTILINE)
_NAMES = {"width": "width", "height": "height", "fx": "fx", "fy": "fy", "ppx": "cx", "ppy": "cy",
          "distortion": "model", "coeffs": "coefficients"}  # fmt: skip
_COLOUR = ("color", "rgb camera")
_REMEDY = "give the lines from 'Intrinsic of' to 'Coeffs:' as rs-enumerate-devices -c prints them"


def is_realsense(path: Path, text: str) -> bool:
    """True for text with intrinsics in one of the two forms.

    Args:
        path: of the file.
        text: its content.
    """
    return _BLOCK.search(text) is not None or _LINE.search(text) is not None


def realsense_calibration(path: Path, text: str, camera: int | None) -> Calibration:
    """Calibration of a stream: of the only one, of the only one named Color, or of that of a number.

    Args:
        path: of the file, for messages.
        text: its content.
        camera: position in the file; None for none.

    Raises:
        DvoError: several sizes of one stream, a block without intrinsics, a lens model that is not read (inverse
            Brown-Conrady with coefficients, f-theta), or see :func:`dvo.data.calibration.values.from_values`.
    """
    heads = list(_BLOCK.finditer(text))
    ends = [*(head.start() for head in heads[1:]), len(text)]
    found = [(head[1], _block(text[head.start() : end], head[1], path)) for head, end in zip(heads, ends, strict=False)]
    found = found or [("", _line(line)) for line in _LINE.finditer(text)]
    names = [f"{name} {one['width']}x{one['height']}".strip() for name, one in found]
    if camera is None:
        colour = [number for number, (name, _) in enumerate(found) if name.lower() in _COLOUR]
        camera = colour[0] if len(colour) == 1 else None
    if camera is None or camera >= len(found):
        read = [from_values(_numbers(one, path), path) for _, one in found]
        return one_of(list(zip(names, read, strict=True)), camera, path)
    others = tuple(name for number, name in enumerate(names) if number != camera)
    calibration = from_values(_numbers(found[camera][1], path), path)  # other streams need not be read
    return replace(calibration, ignored=(*calibration.ignored, *others))


def _line(line: re.Match[str]) -> dict[str, str]:
    numbers = zip(("cx", "cy", "fx", "fy"), [*line["centre"].split(), *line["focal"].split()], strict=False)
    return dict(numbers) | {key: line[key] for key in ("width", "height", "model", "coefficients")}


def _block(part: str, name: str, path: Path) -> dict[str, str]:
    found = {}
    for key, value in _ENTRY.findall(part):
        known = _NAMES.get(key.lower())
        if known is not None and known not in found:
            found[known] = value
    missing = [key for key in _NAMES.values() if key not in found]
    if missing:
        raise DvoError(f"no {', '.join(missing)} in it", file=path, field=f'Intrinsic of "{name}"', remedy=_REMEDY)
    return found


def _numbers(values: dict[str, str], path: Path) -> dict[str, Any]:
    found: dict[str, Any] = {"model": values["model"]}
    for key in ("fx", "fy", "cx", "cy", "width", "height", "coefficients"):
        text = values.get(key, "")
        try:
            numbers = [float(word) for word in text.replace(",", " ").split()]
        except ValueError:
            numbers = []
        if not numbers:
            raise DvoError(f"no number: {text[:60]!r}", file=path, field=key, remedy=_REMEDY)
        found[key] = numbers if key == "coefficients" else numbers[0]
    return found


DIALECT = Dialect(is_realsense, realsense_calibration)
