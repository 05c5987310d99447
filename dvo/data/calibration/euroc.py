"""Calibration of the ASL layout of EuRoC: poses of the sensors on the body, and the right camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.yaml_files import read_text
from dvo.data.calibration.calibration import StereoRig
from dvo.data.calibration.documents import load_yaml
from dvo.data.calibration.read import read_calibration
from dvo.data.files.files import MAX_NUMBER, is_file
from dvo.geometry.poses import compose_poses, invert_poses, poses_from_matrices


def read_extrinsics(sensor: Path) -> np.ndarray | None:
    """Read the pose of a sensor on the body.

    Args:
        sensor: ``sensor.yaml``.

    Returns:
        ``(7,)`` pose ``T_BS``, sensor to body, metres; None if there is no such file or key.

    Raises:
        DvoError: ``T_BS`` is no rigid 4x4 matrix.
    """
    if not is_file(sensor):
        return None
    data = load_yaml(read_text(sensor, "use EuRoC's sensor.yaml"), sensor)
    value = data.get("T_BS") if isinstance(data, dict) else None
    if value is None:
        return None
    try:
        matrix = np.array(value["data"] if isinstance(value, dict) else value, dtype=np.float64).reshape(4, 4)
    except (KeyError, TypeError, ValueError, OverflowError):
        matrix = np.zeros((4, 4))
    if not (np.abs(matrix) <= MAX_NUMBER).all():  # NaN fails too
        matrix = np.zeros((4, 4))
    rotation = matrix[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise DvoError("not a rigid 4x4 matrix", file=sensor, field="T_BS", remedy="give 16 numbers, row by row")
    return poses_from_matrices(matrix)


def read_rig(mav: Path) -> StereoRig | None:
    """Right camera ``cam1`` of a stereo pair, not rectified.

    Args:
        mav: folder with ``cam0/sensor.yaml`` and ``cam1/sensor.yaml``.

    Returns:
        None if one of the cameras has no extrinsics.

    Raises:
        DvoError: a malformed file.
    """
    body_left, body_right = (read_extrinsics(mav / name / "sensor.yaml") for name in ("cam0", "cam1"))
    if body_left is None or body_right is None:
        return None
    T_left_right = compose_poses(invert_poses(body_left), body_right)
    return StereoRig(read_calibration(mav / "cam1" / "sensor.yaml"), T_left_right)
