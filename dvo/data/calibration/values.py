"""Calibrations of named values: the YAML of EuRoC, Kalibr, ROS, OpenCV, ORB-SLAM and dvo itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.yaml_files import parse_yaml
from dvo.data.calibration.calibration import EXPECTED, Calibration, Dialect
from dvo.geometry.camera import DistortionModel

_MODELS: dict[str, DistortionModel] = {
    "": "none",
    "none": "none",
    "pinhole": "none",
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "radialtangential": "radtan",
    "plumb_bob": "radtan",
    "opencv": "radtan",
    "brown": "radtan",
    "fisheye": "fisheye",
    "equidistant": "fisheye",
    "kannala-brandt": "fisheye",
    "kannalabrandt8": "fisheye",
    "kannala_brandt": "fisheye",
    "opencv_fisheye": "fisheye",
}


def from_matrix(matrix: np.ndarray, path: Path) -> Calibration:
    """Calibration of a matrix K.

    Args:
        matrix: K of a pinhole camera without skew.
        path: file that it comes from, for messages.

    Raises:
        DvoError: not a ``(3, 3)`` matrix of that form.
    """
    if matrix.shape != (3, 3) or matrix[1, 0] != 0 or (matrix[2] != [0, 0, 1]).any() or matrix[0, 1] != 0:
        raise DvoError("not a pinhole matrix K", file=path, field="intrinsics", remedy=EXPECTED)
    return Calibration(float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2]), file=path)


def load_yaml(text: str, path: Path) -> Any:
    """Parse a YAML document, also with OpenCV's ``%YAML:1.0`` head and its ``!!opencv-matrix`` tags. Plain data only.

    Args:
        text: the document.
        path: file that it comes from, for messages.

    Raises:
        DvoError: not valid YAML, see :func:`dvo.core.yaml_files.parse_yaml`.
    """
    lines = [line for line in text.splitlines() if not line.startswith("%YAML")]
    if lines and lines[0].strip() == "---":
        lines = lines[1:]
    return parse_yaml("\n".join(lines), path, remedy=EXPECTED)


def _numbers(value: Any, path: Path, field: str) -> np.ndarray:
    if isinstance(value, dict):  # {rows, cols, data}
        value = value.get("data")
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DvoError("not numbers", file=path, field=field, remedy=EXPECTED) from None


def _find(data: dict[str, Any], *keys: str) -> Any:
    return next((data[key] for key in keys if data.get(key) is not None), None)


def from_values(data: Any, path: Path) -> Calibration:
    """Calibration of the entries of one of the YAML dialects of :func:`read_calibration`.

    Args:
        data: dictionary of the entries.
        path: file that they come from, for messages.

    Raises:
        DvoError: as :func:`read_calibration`; the signs of the focal lengths are not checked.
    """
    if isinstance(data, dict) and "cam0" in data:
        data = data["cam0"]
    if not isinstance(data, dict):
        raise DvoError("no keys in it", file=path, field="intrinsics", remedy=EXPECTED)
    calibration = _yaml_intrinsics(data, path)
    resolution = _find(data, "resolution", "image_size")
    width = _find(data, "width", "image_width", "Camera.width") if resolution is None else None
    height = _find(data, "height", "image_height", "Camera.height") if resolution is None else None
    pair = resolution if resolution is not None else [width or 0, height or 0]
    size = _numbers(pair, path, "resolution")
    if size.shape != (2,) or not ((size >= 0) & (size <= 1e6) & (size == np.rint(size))).all():
        raise DvoError("expected width and height", file=path, field="resolution", remedy="give two whole numbers")
    calibration = replace(calibration, width=int(size[0]) or None, height=int(size[1]) or None)
    calibration = _with_sensors(calibration, data, path)
    return _with_distortion(calibration, data, path)


def _yaml_intrinsics(data: dict[str, Any], path: Path) -> Calibration:
    for prefix in ("", "Camera.", "Camera1."):
        found = [data.get(prefix + name) for name in ("fx", "fy", "cx", "cy")]
        if all(value is not None for value in found):
            numbers = _numbers(found, path, "intrinsics")
            break
    else:
        numbers = _other_intrinsics(data, path)
    if numbers.size == 9:
        return from_matrix(numbers.reshape(3, 3), path)
    if numbers.shape != (4,):
        raise DvoError("expected 4 numbers or a 3x3 matrix", file=path, field="intrinsics", remedy=EXPECTED)
    fx, fy, cx, cy = (float(number) for number in numbers)
    return Calibration(fx, fy, cx, cy, file=path)


def _other_intrinsics(data: dict[str, Any], path: Path) -> np.ndarray:
    value = _find(data, "intrinsics", "camera_matrix", "K", "Camera matrix")
    if value is None:
        raise DvoError("no fx, fy, cx, cy in it", file=path, field="intrinsics", remedy=EXPECTED)
    return _numbers(value, path, "intrinsics")


def _with_sensors(calibration: Calibration, data: dict[str, Any], path: Path) -> Calibration:
    found: dict[str, float | None] = {}
    keys: dict[str, tuple[str, ...]] = {
        "depth_scale": ("depth_scale", "DepthMapFactor", "RGBD.DepthMapFactor"),
        "baseline": ("baseline", "Stereo.b"),
        "readout": ("readout",),
    }
    for name, names in keys.items():
        value = _find(data, *names)
        if value is None and name == "baseline" and data.get("Camera.bf") is not None:
            product = _numbers(data["Camera.bf"], path, "Camera.bf")
            value = product / calibration.fx if calibration.fx else product  # fx of 0 is refused later
        number = None if value is None else _numbers(value, path, name)
        low, high, expected = (0, 1, "seconds, 0 to 1") if name == "readout" else (1e-6, 1e6, "one positive number")
        if number is not None and (number.shape != () or not low <= number <= high):
            raise DvoError(f"expected {expected}", file=path, field=name, remedy="give a number, or leave it out")
        found[name] = None if number is None else float(number)
    scale, baseline, readout = found["depth_scale"], found["baseline"], found["readout"] or 0.0
    return replace(calibration, depth_scale=scale, baseline=baseline, readout=readout)


def _with_distortion(calibration: Calibration, data: dict[str, Any], path: Path) -> Calibration:
    name = _find(data, "distortion_model", "model", "Camera.type", "camera_model")
    value = _find(data, "coefficients", "distortion_coefficients", "distortion_coeffs", "dist_coeffs", "D")
    if value is None:  # ORB-SLAM writes them one by one
        is_fisheye = _MODELS.get(str(name).lower()) == "fisheye"
        named = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2", "k3")
        for prefix in ("", "Camera.", "Camera1."):
            if data.get(f"{prefix}k1") is not None:
                value = [data.get(prefix + key) or 0 for key in named]
                break
    coefficients = _numbers([] if value is None else value, path, "coefficients").ravel()
    key = str(name if name is not None else ("radtan" if len(coefficients) else "none")).lower().replace(" ", "_")
    if key == "pinhole" and len(coefficients):
        key = "radtan"
    if key not in _MODELS:
        raise DvoError(
            f"unknown distortion model {str(name)[:60]!r}",
            file=path,
            field="model",
            remedy="use none, radtan or fisheye",
        )
    model = _MODELS[key]
    allowed = {"none": (0,), "radtan": (0, 4, 5), "fisheye": (0, 4)}[model]
    most = max(allowed)
    if len(coefficients) > most and not coefficients[most:].any():
        coefficients = coefficients[:most]  # zeros that OpenCV and ROS append
    if len(coefficients) not in allowed:
        raise DvoError(
            f"{len(coefficients)} coefficients for the model {model}",
            file=path,
            field="coefficients",
            remedy="radtan has k1 k2 p1 p2 [k3], fisheye k1 k2 k3 k4",
        )
    if model == "radtan" and not coefficients.any():
        model = "none"
    kept = () if model == "none" else tuple(float(coefficient) for coefficient in coefficients)
    return replace(calibration, model=model, coefficients=kept)


def is_yaml(path: Path, text: str) -> bool:
    """True for a file with the name or the first line of a YAML.

    Args:
        path: of the file.
        text: its content.
    """
    return path.suffix.lower() in (".yaml", ".yml") or text.startswith("%YAML")


DIALECT = Dialect(is_yaml, lambda path, text, camera: from_values(load_yaml(text, path), path))
