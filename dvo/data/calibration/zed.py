"""Factory calibration of Stereolabs' ZED cameras, ``SN*.conf``: sections of ``name=number``.

``[LEFT_CAM_HD]`` and ``[RIGHT_CAM_HD]`` for each resolution, of the images as recorded; those that the SDK gives out
are rectified and have others (https://www.stereolabs.com/developers/calib). ``[LEFT_DISTO]``, if there is one, has the
coefficients for all resolutions, up to eight.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect, one_of
from dvo.data.calibration.values import from_values

_SECTION = re.compile(r"^\s*\[(\w+)\][^\n]*\n(.*?)(?=^\s*\[|\Z)", re.MULTILINE | re.DOTALL)
_CAMERA = re.compile(r"(LEFT|RIGHT)_CAM_(\w+)", re.IGNORECASE)
_ENTRY = re.compile(r"^\s*(\w+)\s*=\s*(.*?)\s*$", re.MULTILINE)
_SIZES = {"4K": (3840, 2160), "QHDPLUS": (3200, 1800), "2K": (2208, 1242), "FHD1200": (1920, 1200), "FHD": (1920, 1080),
          "HD1200": (1920, 1200), "HD1080": (1920, 1080), "HD": (1280, 720), "HD720": (1280, 720), "SVGA": (960, 600),
          "VGA": (672, 376)}  # fmt: skip
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_LENS = {"fx", "fy", "cx", "cy", *_COEFFICIENTS}
_REMEDY = "download it again, or write 'fx fy cx cy [k1 k2 p1 p2 [k3]]' of a section on one line"
_NOTE = "the calibration is that of the images of a ZED as recorded; those that its SDK has rectified have another one"


def is_zed(path: Path, text: str) -> bool:
    """True for text with a section of a camera of a ZED.

    Args:
        path: of the file.
        text: its content.
    """
    return any(_CAMERA.fullmatch(name) for name, _ in _SECTION.findall(text))


def zed_calibration(path: Path, text: str, camera: int | None) -> Calibration:
    """Calibration of the left camera, if the file has one resolution, or of the section of a number.

    Args:
        path: of the file, for messages.
        text: its content.
        camera: position among the sections of cameras, from 0; None for the left camera.

    Raises:
        DvoError: several resolutions, an entry twice, no intrinsics, or coefficients that may be those of a fisheye.
    """
    sections = {name.upper(): _numbers(body, path) for name, body in _SECTION.findall(text)}
    names = [name for name in sections if _CAMERA.fullmatch(name)]
    left = [number for number, name in enumerate(names) if name.startswith("LEFT")]
    if camera is None and len(left) == 1:
        camera = left[0]
    if camera is None or camera >= len(names):
        return one_of([(name, _calibration(name, sections, path)) for name in names], camera, path)
    chosen = _calibration(names[camera], sections, path)  # others need not be read
    others = tuple(name for number, name in enumerate(names) if number != camera)
    return replace(chosen, ignored=(*chosen.ignored, *others), notes=(*chosen.notes, _NOTE))


def _calibration(name: str, sections: dict[str, dict[str, float]], path: Path) -> Calibration:
    values = dict(sections[name])
    side, _, kind = name.partition("_CAM_")
    own = {key: values.pop(key) for key in _COEFFICIENTS if key in values}
    shared = sections.get(f"{side}_DISTO", {})
    lens = [(shared if any(shared.values()) else own).get(key, 0.0) for key in _COEFFICIENTS]
    if lens[5] and not any(lens[6:]):
        message = "k4 without k5 and k6 may be that of a fisheye"
        raise DvoError(message, file=path, field=f"{side}_DISTO", remedy="write a YAML with model: and coefficients:")
    size = dict(zip(("width", "height"), _SIZES.get(kind, ()), strict=False))
    return from_values({**values, **size, "model": "radtan", "coefficients": lens}, path)


def _numbers(body: str, path: Path) -> dict[str, float]:
    values: dict[str, float] = {}
    for key, text in _ENTRY.findall(body):
        try:
            number = float(text)
        except ValueError:
            if key.lower() in _LENS:
                raise DvoError(f"no number: {text[:40]!r}", file=path, field=key, remedy=_REMEDY) from None
            continue  # of no camera
        if key.lower() in values:
            raise DvoError("twice in a section", file=path, field=key, remedy=_REMEDY)
        values[key.lower()] = number
    return values


DIALECT = Dialect(is_zed, zed_calibration)
