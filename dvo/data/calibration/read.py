"""Calibration files: which dialect a file is of, and what it says."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.core.yaml_files import is_shell_pipe, read_text
from dvo.data.calibration.calibration import EXPECTED, Calibration, Dialect
from dvo.data.calibration.colmap_cameras import split_camera
from dvo.data.files.files import MAX_NUMBER, is_file

_BUILT_IN = {
    "colmap": "dvo.data.calibration.colmap_cameras:DIALECT",
    "yaml": "dvo.data.calibration.values:DIALECT",
    "text": "dvo.data.calibration.text:DIALECT",
}
DIALECTS = Registry("calibration dialect", "dvo.calibration_dialects", dict(_BUILT_IN))
"""Names to ``"module:DIALECT"``, each a :class:`dvo.data.calibration.calibration.Dialect`. Those of other packages come
first, because ``text`` takes any file."""
_NUMBERED = "colmap"  # the only dialect of the package whose files number their cameras


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
    path, camera = split_camera(Path(path))
    if not (is_file(path) or is_shell_pipe(path)):
        raise DvoError("no such file", file=path, field="calibration", remedy="give an existing calibration file")
    text = "" if path.suffix.lower() == ".bin" else read_text(path, EXPECTED)
    names = [*(name for name in DIALECTS if name not in _BUILT_IN), *_BUILT_IN]
    dialects: dict[str, Dialect] = {name: DIALECTS.resolve(name) for name in names}
    name = next(name for name, dialect in dialects.items() if dialect.matches(path, text))
    if camera is not None and name in _BUILT_IN and name != _NUMBERED:
        raise DvoError("no cameras of COLMAP in it", file=path, field="calibration", remedy=f"leave out :{camera}")
    calibration = dialects[name].read(path, text, camera)
    values = [calibration.fx, calibration.fy, calibration.cx, calibration.cy, *calibration.coefficients]
    if not (np.abs(values) <= MAX_NUMBER).all():  # NaN fails too
        raise DvoError("not a finite number", file=path, field="intrinsics", remedy=EXPECTED)
    if calibration.fx <= 0 or calibration.fy <= 0:
        raise DvoError("focal length must be positive", file=path, field="intrinsics", remedy=EXPECTED)
    return calibration
