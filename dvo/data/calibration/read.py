"""Calibration files: which dialect a file is of, and what it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.core.yaml_files import MAX_BYTES, is_shell_pipe, read_text
from dvo.data.calibration.calibration import EXPECTED, FOUND, Calibration, Dialect
from dvo.data.calibration.colmap_cameras import split_camera
from dvo.data.calibration.numpy_files import SUFFIXES
from dvo.data.files.files import MAX_NUMBER, is_file
from dvo.geometry.lenses import LENSES

_BUILT_IN = {
    "numpy": "dvo.data.calibration.numpy_files:DIALECT",
    "colmap": "dvo.data.calibration.colmap_cameras:DIALECT",
    "dso": "dvo.data.calibration.dso:DIALECT",
    "kitti raw": "dvo.data.calibration.kitti_raw:DIALECT",
    "transforms": "dvo.data.calibration.transforms:DIALECT",
    "gyroflow": "dvo.data.calibration.gyroflow:DIALECT",
    "opensfm": "dvo.data.calibration.opensfm:DIALECT",
    "meshroom": "dvo.data.calibration.meshroom:DIALECT",
    "openmvg": "dvo.data.calibration.openmvg:DIALECT",
    "matlab": "dvo.data.calibration.matlab:DIALECT",
    "middlebury": "dvo.data.calibration.middlebury:DIALECT",
    "realsense": "dvo.data.calibration.realsense:DIALECT",
    "depthai": "dvo.data.calibration.depthai:DIALECT",
    "zed": "dvo.data.calibration.zed:DIALECT",
    "mrcal": "dvo.data.calibration.mrcal:DIALECT",
    "metashape": "dvo.data.calibration.metashape:DIALECT",
    "ost": "dvo.data.calibration.values:OST",
    "xml": "dvo.data.calibration.values:XML",
    "toml": "dvo.data.calibration.values:TOML",
    "json": "dvo.data.calibration.values:JSON",
    "yaml": "dvo.data.calibration.values:DIALECT",
    "ini": "dvo.data.calibration.values:INI",
    "text": "dvo.data.calibration.text:DIALECT",
}
DIALECTS = Registry("calibration dialect", "dvo.calibration_dialects", dict(_BUILT_IN))
"""Names to ``"module:DIALECT"``, each a :class:`dvo.data.calibration.calibration.Dialect`. Those of other packages come
first, because ``text`` takes any file."""
_NUMBERED = frozenset(["numpy", "colmap", "kitti raw", "meshroom", "openmvg", "matlab", "middlebury", "realsense",
                       "depthai", "zed", "metashape", "toml", "ini", "json", "yaml", "xml"])  # fmt: skip
"""Those that may have several cameras."""
SHORTEST = 0.01
"""Focal length at least, widths of the images: below it, it is no number of pixels."""
TANGENTIAL = 0.05
"""Largest tangential coefficients: those of lenses are below 0.01."""
_UNSTATED = 100
"""Width that is assumed for this where the file states none."""
_BINARY = (".bin", *SUFFIXES)
_LARGEST = 64 * 1024**2  # of a JSON file, which may list thousands of images beside the camera


def read_calibration(path: Path | str) -> Calibration:
    """Read a calibration file.

    docs/inputs.md has the table of dialects and lens models. Text: numbers ``fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5
    k6]]]`` (radial-tangential) separated by blanks or commas, ``#`` comments; the same by name, ``fx=525 fy=525 cx=320
    cy=240``, or in two lines; or a matrix K of 3x3, 3x4 or 4x4 numbers; ROS's ``ost.txt``; the text of DSO; KITTI's
    ``calib.txt``, if all its cameras have the same intrinsics, and ``calib_cam_to_cam.txt``. YAML, JSON and OpenCV's
    XML: ``fx, fy, cx, cy`` with optional ``width, height, model, coefficients``, at the top or in a mapping within;
    EuRoC, Kalibr, ROS, OpenCV, ORB-SLAM, VINS, basalt, nerfstudio. These may state ``depth_scale`` (ORB-SLAM:
    ``DepthMapFactor``) and ``baseline`` (ORB-SLAM: ``Stereo.b``, or ``Camera.bf``, which is ``fx`` times it) too; and
    ``readout``, the seconds from the first to the last row of a rolling shutter (0, a global one, if it is left out;
    Kalibr's ``line_delay`` is not read). COLMAP's ``cameras.txt`` and ``cameras.bin``. Of a file of several cameras the
    first or the left one is read, or that of the number in ``FILE:NUMBER``; COLMAP's have no first one. NumPy's
    ``.npz`` of named arrays; MATLAB's ``cameraParameters`` and ``Calib_Results.m``; scenes of Meshroom and OpenMVG;
    Middlebury's ``calib.txt``; what the tools of RealSense print.

    Args:
        path: of the file.

    Raises:
        DvoError: missing or malformed file, an unknown distortion model, a wrong number of coefficients, or an entry
            that looks like lens distortion and is not understood.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("calib.txt").write_text("525 525 319.5 239.5")
        >>> read_calibration("calib.txt").camera(640, 480).fx
        525.0
    """
    path, camera = split_camera(Path(path))
    if not (is_file(path) or is_shell_pipe(path)):
        message = "a folder, no file" if path.is_dir() else "no such file"
        raise DvoError(message, file=path, field="calibration", remedy="give an existing calibration file")
    suffix = path.suffix.lower()
    limit = _LARGEST if suffix in (".json", ".sfm") else MAX_BYTES
    text = "" if suffix in _BINARY else read_text(path, EXPECTED, limit)
    names = [*(name for name in DIALECTS if name not in _BUILT_IN), *_BUILT_IN]
    dialects: dict[str, Dialect] = {name: DIALECTS.resolve(name) for name in names}
    name = next(name for name, dialect in dialects.items() if dialect.matches(path, text))
    if camera is not None and name in _BUILT_IN and name not in _NUMBERED:
        raise DvoError("no numbered cameras in it", file=path, field="calibration", remedy=f"leave out :{camera}")
    calibration = dialects[name].read(path, text, camera)
    was_found = calibration.was_found or text.startswith(f"# {FOUND}")
    calibration = replace(calibration, dialect=calibration.dialect or name, was_found=was_found)
    values = [calibration.fx, calibration.fy, calibration.cx, calibration.cy, *calibration.coefficients]
    if not (np.abs(values) <= MAX_NUMBER).all():  # NaN fails too
        raise DvoError("not a finite number", file=path, field="intrinsics", remedy=EXPECTED)
    if calibration.fx <= 0 or calibration.fy <= 0:
        raise DvoError("focal length must be positive", file=path, field="intrinsics", remedy=EXPECTED)
    if min(calibration.fx, calibration.fy) < SHORTEST * (calibration.width or _UNSTATED):
        raise DvoError(
            f"a focal length of {min(calibration.fx, calibration.fy):g} pixels, as if it were a share of the size",
            file=path, field="intrinsics", remedy="give fx, fy, cx, cy in pixels",
        )  # fmt: skip
    try:
        LENSES[calibration.model].check(calibration.coefficients, calibration.model)
    except DvoError as error:
        raise DvoError(error.message, file=path, field=error.field, remedy=error.remedy or EXPECTED) from None
    tangential = calibration.coefficients[2:4] if calibration.model == "radtan" else ()
    if max(map(abs, tangential), default=0.0) > TANGENTIAL:
        note = (
            f"p1 and p2 of {tangential[0]:g} and {tangential[1]:g} are those of no usual lens: are they k3 and k4 of a "
            "fisheye, or coefficients in another order than k1 k2 p1 p2 k3?"
        )
        calibration = replace(calibration, notes=(*calibration.notes, note))
    if not calibration.width and max(abs(calibration.cx), abs(calibration.cy)) <= 1:
        raise DvoError(
            f"a principal point of ({calibration.cx:g}, {calibration.cy:g}), as if it were a share of the size",
            file=path, field="intrinsics", remedy="give fx, fy, cx, cy in pixels",
        )  # fmt: skip
    if calibration.width and calibration.height:
        calibration.camera(calibration.width, calibration.height)  # what is stated fits together
    return calibration
