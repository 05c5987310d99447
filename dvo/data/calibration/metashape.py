"""Calibration of Agisoft Metashape: an exported calibration, or the sensors of a document of cameras, as XML.

One focal length ``f``, the principal point from the middle of the image, ``b1`` and ``b2`` for other pixels than square
ones, and ``p1`` and ``p2`` in the order opposite to OpenCV's (Metashape's manual, appendix D: x' has P1 (r^2 + 2 x^2)).
Pixel centres are at halves.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect, one_of
from dvo.data.calibration.colmap_cameras import CORNER
from dvo.data.calibration.documents import xml_root
from dvo.data.calibration.values import from_values

_REMEDY = "export the calibration for OpenCV, or undistorted images"
_KINDS = {"frame": ("radtan", ("k1", "k2", "p2", "p1", "k3")), "fisheye": ("fisheye", ("k1", "k2", "k3", "k4"))}
"""Lens model of dvo, and Metashape's names of its coefficients in their order."""
_NUMBERS = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


def is_metashape(path: Path, text: str) -> bool:
    """True for XML with a calibration that has a focal length ``f``.

    Args:
        path: of the file.
        text: its content.
    """
    return "<calibration" in text and re.search(r"<f>\s*[-+.\d]", text) is not None


def metashape_calibration(path: Path, text: str, camera: int | None) -> Calibration:
    """Calibration of the only sensor, or of that of a number.

    Args:
        path: of the file, for messages.
        text: its content.
        camera: position among the sensors, from 0; None for any, if all are the same.

    Raises:
        DvoError: sensors that differ, another type than ``frame`` and ``fisheye``, coefficients that its lens model has
            not, skew, or no numbers.
    """
    root = xml_root(text, path)
    sensors = [root] if root.tag == "calibration" else list(root.iter("sensor"))
    found = []
    for sensor in sensors:
        each = [sensor] if sensor.tag == "calibration" else sensor.findall("calibration")
        adjusted = [one for one in each if one.get("class") == "adjusted"] or each
        if adjusted:
            found.append((sensor.get("label") or "calibration", _calibration(adjusted[-1], path)))
    return one_of(found, camera, path)


def _calibration(values: Element, path: Path) -> Calibration:
    kind = values.get("type") or (values.findtext("projection") or "frame").strip()
    if kind not in _KINDS:
        raise DvoError(f"cameras of type {kind[:40]!r} are not known", file=path, field="calibration", remedy=_REMEDY)

    def number(name: str) -> float:
        try:
            return float(values.findtext(name) or 0)
        except ValueError:
            raise DvoError("no number", file=path, field=name, remedy=_REMEDY) from None

    model, names = _KINDS[kind]
    left_out = [name for name in _NUMBERS if name not in names and number(name)]
    if left_out:
        message = f"a camera of type {kind} of dvo has no {left_out[0]}"
        raise DvoError(message, file=path, field=left_out[0], remedy=_REMEDY)
    resolution = values.find("resolution")
    width, height = number("width"), number("height")
    if resolution is not None:
        sides = [resolution.get("width") or "", resolution.get("height") or ""]
        width, height = (float(side) if side.isdecimal() else 0.0 for side in sides)
    if not (width >= 1 and height >= 1):
        raise DvoError("no size of the images", file=path, field="resolution", remedy=_REMEDY)
    found = from_values(
        {
            "fx": number("f") + number("b1"), "fy": number("f"), "skew": number("b2") / (number("f") or 1.0),
            "cx": width / 2 + number("cx") - CORNER, "cy": height / 2 + number("cy") - CORNER,
            "width": width, "height": height, "model": model, "coefficients": [number(name) for name in names],
        },
        path,
    )  # fmt: skip
    known = {*names, *_NUMBERS, "f", "b1", "b2", "cx", "cy", "width", "height", "resolution", "projection"}
    return replace(found, ignored=tuple(child.tag for child in values if child.tag not in known))


DIALECT = Dialect(is_metashape, metashape_calibration)
