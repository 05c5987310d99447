"""Calibration of a lens profile of Gyroflow, as its calibrator writes them for action cameras and phones.

A profile is that of a recording mode: ``fisheye_params`` has the matrix and the coefficients of OpenCV's fisheye model
for images of ``calib_dimension`` (https://github.com/gyroflow/lens_profiles).
"""

from __future__ import annotations

import re
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration, Dialect
from dvo.data.calibration.documents import load_json
from dvo.data.calibration.values import from_values

_REMEDY = "choose the profile of a mode without it, or calibrate with dvo calibrate --board"


def is_gyroflow(path: Path, text: str) -> bool:
    """True for JSON of a lens profile.

    Args:
        path: of the file.
        text: its content.
    """
    return text.lstrip()[:1] == "{" and all(
        re.search(rf'"{key}"\s*:', text) for key in ("fisheye_params", "calib_dimension")
    )


def gyroflow_calibration(path: Path, text: str) -> Calibration:
    """Calibration of the images that the profile was made with.

    Args:
        path: of the file, for messages.
        text: its content.

    Raises:
        DvoError: another lens model, images that the camera stretches or warps, or a malformed file.
    """
    data = load_json(text, path)
    lens, size = data.get("fisheye_params"), data.get("calib_dimension")
    if not isinstance(lens, dict) or not isinstance(size, dict):
        raise DvoError("not a mapping", file=path, field="fisheye_params", remedy="use a lens profile of Gyroflow")
    for key, plain in (("distortion_model", "opencv_fisheye"), ("digital_lens", ""), ("asymmetrical", False),
                       ("input_horizontal_stretch", 1), ("input_vertical_stretch", 1)):  # fmt: skip
        value = data.get(key)
        if value and value != plain:
            raise DvoError(f"{str(value)[:40]!r} is not known here", file=path, field=key, remedy=_REMEDY)
    milliseconds = data.get("frame_readout_time")
    is_known = isinstance(milliseconds, int | float) and 0 < abs(milliseconds) <= 1000
    values = {"width": size.get("w"), "height": size.get("h"), "model": "fisheye",
              "camera_matrix": lens.get("camera_matrix"), "distortion_coefficients": lens.get("distortion_coeffs"),
              "readout": abs(milliseconds) / 1000 if is_known else 0}  # fmt: skip
    return from_values(values, path)


DIALECT = Dialect(is_gyroflow, lambda path, text, camera: gyroflow_calibration(path, text))
