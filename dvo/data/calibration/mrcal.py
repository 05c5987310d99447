"""Calibration of mrcal: ``*.cameramodel``, a dictionary as Python writes it.

``intrinsics`` holds ``fx fy cx cy`` and the coefficients in the order of OpenCV; pixel centres are at integers
(https://mrcal.secretsauce.net/cameramodels.html).
"""

from __future__ import annotations

import ast
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect
from dvo.data.calibration.values import from_values

_COUNTS = {"LENSMODEL_PINHOLE": 0, "LENSMODEL_OPENCV4": 4, "LENSMODEL_OPENCV5": 5, "LENSMODEL_OPENCV8": 8,
           "LENSMODEL_OPENCV12": 12}  # of coefficients  # fmt: skip
_REMEDY = f"calibrate with one of {', '.join(_COUNTS)} (mrcal-convert-lensmodel)"
_NAMES = ("lensmodel", "lens_model", "distortion_model")  # of all its versions
_HEAD = re.compile(rf"^\s*['\"](?:{'|'.join(_NAMES)})['\"]\s*:\s*['\"](?:LENSMODEL|DISTORTION)_", re.MULTILINE)


def is_mrcal(path: Path, text: str) -> bool:
    """True for a dictionary that names a lens model of mrcal.

    Args:
        path: of the file.
        text: its content.
    """
    return _HEAD.search(text) is not None


def mrcal_calibration(path: Path, text: str) -> Calibration:
    """Calibration of the camera of the file.

    Args:
        path: of the file, for messages.
        text: its content.

    Raises:
        DvoError: no dictionary, another lens model, or another number of values than it has.
    """
    try:
        with warnings.catch_warnings():  # of Python, about numbers that run into words
            warnings.simplefilter("ignore")
            entries = ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError):
        entries = None
    if not isinstance(entries, dict):
        raise DvoError("no dictionary of Python", file=path, field="calibration", remedy="write it with mrcal again")
    model = str(next((entries[name] for name in _NAMES if name in entries), ""))
    model = model.replace("DISTORTION_", "LENSMODEL_").replace("LENSMODEL_NONE", "LENSMODEL_PINHOLE")
    if model not in _COUNTS:
        raise DvoError(f"{model[:60]} is not known", file=path, field="lensmodel", remedy=_REMEDY)
    numbers, size, count = entries.get("intrinsics"), entries.get("imagersize"), _COUNTS[model]
    if not isinstance(numbers, list | tuple) or len(numbers) != 4 + count:
        message, remedy = f"{model} has {4 + count} numbers", "give fx, fy, cx, cy and the coefficients"
        raise DvoError(message, file=path, field="intrinsics", remedy=remedy)
    values: dict[str, Any] = {"intrinsics": list(numbers[:4]), "model": "radtan" if count else "none"}
    values |= {"coefficients": list(numbers[4:])} if count else {}
    values |= {} if size is None else {"image_size": list(size) if isinstance(size, tuple) else size}
    used = (*_NAMES, "intrinsics", "imagersize")
    ignored = tuple(str(key) for key in entries if key not in used)
    return replace(from_values(values, path), ignored=ignored)


DIALECT = Dialect(is_mrcal, lambda path, text, camera: mrcal_calibration(path, text))
