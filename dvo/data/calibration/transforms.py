"""Calibration of ``transforms.json`` of nerfstudio and instant-ngp.

Intrinsics stand at the top or in each of ``frames``. Pixels are counted from the corner of the first one, as in COLMAP:
0.5 is subtracted from cx and cy. Fields: https://docs.nerf.studio/quickstart/data_conventions.html.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import FOUND, Calibration, Dialect
from dvo.data.calibration.colmap_cameras import CORNER
from dvo.data.calibration.documents import load_json
from dvo.data.calibration.values import from_values

_KEYS = frozenset(
    [
        "fl_x",
        "fl_y",
        "cx",
        "cy",
        "w",
        "h",
        "k1",
        "k2",
        "k3",
        "k4",
        "k5",
        "k6",
        "p1",
        "p2",
        "camera_model",
        "is_fisheye",
        "distortion_params",
        "skew",
    ]
)
_ANGLES = ("camera_angle_x", "camera_angle_y")
_REMEDY = "give fl_x, fl_y, cx, cy, w and h"


def is_transforms(path: Path, text: str) -> bool:
    """True for JSON with a focal length or an angle of view under the names of nerfstudio.

    Args:
        path: of the file.
        text: its content.
    """
    return text.lstrip()[:1] == "{" and re.search(r'"(fl_x|fl_y|camera_angle_x)"\s*:', text) is not None


def transforms_calibration(path: Path, text: str) -> Calibration:
    """Calibration of all frames.

    Args:
        path: of the file, for messages.
        text: its content.

    Raises:
        DvoError: frames of different cameras, an angle of view without a size, or see
            :func:`dvo.data.calibration.values.from_values`.
    """
    data = load_json(text, path)
    frames = data.get("frames")
    frames = [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []
    top = {key: value for key, value in data.items() if key not in ("frames", FOUND)}
    own = [{key: frame[key] for key in (*_KEYS, *_ANGLES) if key in frame} for frame in frames]
    if any(camera != own[0] for camera in own[1:]):
        raise DvoError(
            "frames of different cameras in it", file=path, field="frames",
            remedy="write fx fy cx cy of the camera of the images into a file",
        )  # fmt: skip
    values = top | (own[0] if own else {})
    focal = "fl_x" in values or "fl_y" in values
    for axis, side in (("x", "w"), ("y", "h")):
        angle = values.pop(f"camera_angle_{axis}", None)
        if not focal and angle is not None and f"fl_{axis}" not in values:
            values[f"fl_{axis}"] = _focal(angle, values.get(side), side, path)
    for name, other in (("fl_x", "fl_y"), ("fl_y", "fl_x")):
        values.setdefault(name, values.get(other))
    for name, side in (("cx", "w"), ("cy", "h")):
        if name not in values and isinstance(values.get(side), int | float):
            values[name] = values[side] / 2
    is_fisheye = "FISHEYE" in str(values.get("camera_model", "")).upper() or bool(values.get("is_fisheye"))
    if not is_fisheye and values.get("k4"):
        message = "k4 of a camera that is no fisheye means different things in different programs"
        raise DvoError(message, file=path, field="k4", remedy="calibrate with OPENCV or OPENCV_FISHEYE")
    found = from_values(values, path)
    ignored = (*found.ignored, *(["frames"] if frames else []))
    return replace(
        found, cx=found.cx - CORNER, cy=found.cy - CORNER, ignored=ignored, was_found=data.get(FOUND) is True
    )


def _focal(angle: Any, side: Any, name: str, path: Path) -> float:
    if not isinstance(side, int | float):
        message = f"an angle of view without the size of the images ({name})"
        raise DvoError(message, file=path, field="camera_angle_x", remedy=_REMEDY)
    if not isinstance(angle, int | float) or not 0 < angle < math.pi:
        raise DvoError("no angle of view in radians", file=path, field="camera_angle_x", remedy=_REMEDY)
    return side / 2 / math.tan(angle / 2)


DIALECT = Dialect(is_transforms, lambda path, text, camera: transforms_calibration(path, text))
