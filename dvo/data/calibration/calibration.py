"""Calibration files: the common text line, COLMAP's cameras, and the YAML of EuRoC, Kalibr, ROS, OpenCV, ORB-SLAM."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.yaml_files import is_shell_pipe, parse_yaml, read_text
from dvo.data.calibration.named_values import read_named_values
from dvo.data.files.files import MAX_NUMBER, is_file
from dvo.geometry.camera import Camera, DistortionModel

_LINE = "write 'fx fy cx cy [k1 k2 p1 p2 [k3]]' on one line, or a YAML with fx, fy, cx, cy"
_TURN = (
    "the images stand upright, the calibration is that of the sensor: turn it too (fx and fy, and cx and cy, change "
    "places)"
)
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


@dataclass(frozen=True)
class Calibration:
    """Intrinsics in pixels, without an image yet.

    Attributes:
        fx, fy, cx, cy: pixels; pixel centres at integers.
        model, coefficients: as in :class:`dvo.geometry.camera.Camera`.
        width, height: size of the images that it was made for, if the file states it.
        file: file that it was read from, for messages.
        depth_scale: units of a metre in depth images of integers that belong to the images.
        baseline: metres from the camera to the right camera of a rectified pair with the same intrinsics.
        readout: seconds in which a rolling shutter reads the rows, as in :class:`dvo.geometry.camera.Camera`.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    model: DistortionModel = "none"
    coefficients: tuple[float, ...] = ()
    width: int | None = None
    height: int | None = None
    file: Path | None = None
    depth_scale: float | None = None
    baseline: float | None = None
    readout: float = 0.0

    def camera(self, width: int, height: int) -> Camera:
        """Camera of images of this size.

        Args:
            width, height: size of the images in pixels.

        Raises:
            DvoError: the intrinsics do not fit: another resolution stated, a focal length below 0.1 or above 20 image
                widths, a principal point outside of the image; or a readout outside of 0 to 1 s.
        """
        remedy = f"give the calibration of these {width}x{height} images"
        if (self.width or width, self.height or height) != (width, height):
            raise DvoError(
                f"calibration is for {self.width}x{self.height} images, but these are {width}x{height}",
                file=self.file,
                field="intrinsics",
                remedy=_TURN if (self.width, self.height) == (height, width) else remedy,
            )
        for name, focal in (("fx", self.fx), ("fy", self.fy)):
            if not 0.1 * width <= focal <= 20 * width:  # NaN fails too
                raise DvoError(
                    f"{name}={focal:g} does not fit an image {width} pixels wide",
                    file=self.file,
                    field="intrinsics",
                    remedy=f"{remedy}, in pixels",
                )
        try:
            numbers = (self.fx, self.fy, self.cx, self.cy)
            return Camera(*numbers, width, height, self.model, self.coefficients, self.readout)
        except DvoError as error:
            turned = error.field == "intrinsics" and self._fits_turned(width, height)
            remedy = _TURN if turned else error.remedy or remedy
            raise DvoError(error.message, file=self.file, field=error.field, remedy=remedy) from None

    def _fits_turned(self, width: int, height: int) -> bool:
        """True if the principal point is not near the centre of these images, but near that of the same ones turned."""
        upright, turned = (abs(self.cx - w / 2) + abs(self.cy - h / 2) for w, h in ((width, height), (height, width)))
        return width != height and turned < min(0.1 * max(width, height), 0.5 * upright)

    def doubts(self, width: int, height: int) -> list[str]:
        """Oddities of the calibration for images of this size, in sentences; nothing in it need be wrong.

        Args:
            width, height: size of the images in pixels.
        """
        found = []
        if self._fits_turned(width, height):
            found.append(
                f"the principal point ({self.cx:g}, {self.cy:g}) is the centre of {height}x{width} images, but these "
                f"are {width}x{height}: {_TURN}"
            )
        elif abs(self.cx - width / 2) > width / 4 or abs(self.cy - height / 2) > height / 4:
            found.append(
                f"the principal point ({self.cx:g}, {self.cy:g}) lies far from the centre of the {width}x{height} "
                "images: is the calibration that of another resolution?"
            )
        if not 0.8 * self.fy < self.fx < 1.25 * self.fy:
            found.append(f"fx={self.fx:g} and fy={self.fy:g} differ a lot: were the images stretched?")
        return found


def read_calibration(path: Path | str) -> Calibration:
    """Read a calibration file.

    Text: numbers ``fx fy cx cy [k1 k2 p1 p2 [k3]]`` (radial-tangential) separated by blanks or commas, ``#`` comments;
    the same by name, ``fx=525 fy=525 cx=320 cy=240``; or a 3x3 matrix K on three lines. YAML: ``fx, fy, cx, cy`` with
    optional ``width, height, model: none|radtan|fisheye, coefficients``; EuRoC ``sensor.yaml``; Kalibr camchain (its
    ``cam0``); KITTI's ``calib.txt``, if all its cameras have the same intrinsics; ROS camera_info and OpenCV's
    ``camera_matrix``; ORB-SLAM's ``Camera.fx`` keys. A YAML may state ``depth_scale`` (ORB-SLAM: ``DepthMapFactor``)
    and ``baseline`` (ORB-SLAM: ``Stereo.b``, or ``Camera.bf``, which is ``fx`` times it) too; and ``readout``, the
    seconds from the first to the last row of a rolling shutter (0, a global one, if it is left out; Kalibr's
    ``line_delay`` is not read). COLMAP's ``cameras.txt`` and ``cameras.bin``, with ``:ID`` after the name if there are
    several cameras, see :mod:`dvo.data.calibration.colmap_cameras`.

    Args:
        path: text, YAML or COLMAP file.

    Raises:
        DvoError: missing or malformed file, an unknown distortion model, or a wrong number of coefficients.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("calib.txt").write_text("525 525 319.5 239.5")
        >>> read_calibration("calib.txt").camera(640, 480).fx
        525.0
    """
    from dvo.data.calibration.colmap_cameras import colmap_calibration, split_camera

    path, camera = split_camera(Path(path))
    if not (is_file(path) or is_shell_pipe(path)):
        raise DvoError("no such file", file=path, field="calibration", remedy="give an existing calibration file")
    text = "" if path.suffix.lower() == ".bin" else read_text(path, _LINE)
    looks_yaml = path.suffix.lower() in (".yaml", ".yml") or text.startswith("%YAML")
    calibration = colmap_calibration(path, text, camera)
    if calibration is None:
        calibration = _from_yaml(text, path) if looks_yaml else _from_text(text, path)
    values = [calibration.fx, calibration.fy, calibration.cx, calibration.cy, *calibration.coefficients]
    if not (np.abs(values) <= MAX_NUMBER).all():  # NaN fails too
        raise DvoError("not a finite number", file=path, field="intrinsics", remedy=_LINE)
    if calibration.fx <= 0 or calibration.fy <= 0:
        raise DvoError("focal length must be positive", file=path, field="intrinsics", remedy=_LINE)
    return calibration


def _from_text(text: str, path: Path) -> Calibration:
    named = read_named_values(text, path, _LINE)
    rows: list[list[float]] = [] if named is None else [named]
    for line in text.splitlines() if named is None else ():
        fields = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        if not fields:
            continue
        if fields[0].rstrip(":").upper() in ("P0", "P1", "P2", "P3", "P_RECT_00", "P_RECT_02"):
            from dvo.data.calibration.stereo import kitti_calibration

            return kitti_calibration(path)
        try:
            rows.append([float(field) for field in fields])
        except ValueError:
            if ":" in line:  # a YAML with a .txt name
                return _from_yaml(text, path)
            raise DvoError(
                f"not a number in {line.strip()[:100]!r}", file=path, field="intrinsics", remedy=_LINE
            ) from None
    if [len(row) for row in rows] == [3, 3, 3]:
        return _from_matrix(np.array(rows), path)
    if len(rows) != 1 or len(rows[0]) not in (4, 8, 9):
        counts = " + ".join(str(len(row)) for row in rows[:10]) or "no"
        raise DvoError(f"{counts} numbers, expected 4, 8 or 9 on one line", file=path, field="intrinsics", remedy=_LINE)
    fx, fy, cx, cy, *coefficients = rows[0]
    model: DistortionModel = "radtan" if any(coefficients) else "none"
    return Calibration(fx, fy, cx, cy, model, tuple(coefficients) if model == "radtan" else (), file=path)


def _from_matrix(matrix: np.ndarray, path: Path) -> Calibration:
    if matrix.shape != (3, 3) or matrix[1, 0] != 0 or (matrix[2] != [0, 0, 1]).any() or matrix[0, 1] != 0:
        raise DvoError("not a pinhole matrix K", file=path, field="intrinsics", remedy=_LINE)
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
    return parse_yaml("\n".join(lines), path, remedy=_LINE)


def _numbers(value: Any, path: Path, field: str) -> np.ndarray:
    if isinstance(value, dict):  # {rows, cols, data}
        value = value.get("data")
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DvoError("not numbers", file=path, field=field, remedy=_LINE) from None


def _find(data: dict[str, Any], *keys: str) -> Any:
    return next((data[key] for key in keys if data.get(key) is not None), None)


def _from_yaml(text: str, path: Path) -> Calibration:
    return from_values(load_yaml(text, path), path)


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
        raise DvoError("no keys in it", file=path, field="intrinsics", remedy=_LINE)
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
        return _from_matrix(numbers.reshape(3, 3), path)
    if numbers.shape != (4,):
        raise DvoError("expected 4 numbers or a 3x3 matrix", file=path, field="intrinsics", remedy=_LINE)
    fx, fy, cx, cy = (float(number) for number in numbers)
    return Calibration(fx, fy, cx, cy, file=path)


def _other_intrinsics(data: dict[str, Any], path: Path) -> np.ndarray:
    value = _find(data, "intrinsics", "camera_matrix", "K", "Camera matrix")
    if value is None:
        raise DvoError("no fx, fy, cx, cy in it", file=path, field="intrinsics", remedy=_LINE)
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
