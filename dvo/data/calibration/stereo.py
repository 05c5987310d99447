"""Right camera of a stereo pair, from the calibration file of the left one: KITTI, EuRoC and Kalibr."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.yaml_files import read_text
from dvo.data.calibration.calibration import Calibration, StereoRig
from dvo.data.calibration.documents import load_yaml
from dvo.data.calibration.euroc import read_rig
from dvo.data.calibration.kitti import projection_rig, read_projections
from dvo.data.calibration.values import from_values
from dvo.data.extrinsics import pose_of_numbers
from dvo.data.files.files import is_file
from dvo.geometry.poses import compose_poses, invert_poses

_PAIRS = {"image_2": ("P2", "P3"), "image_02": ("P2", "P3"), "image_1": None, "image_01": None,
          "image_3": None, "image_03": None}  # fmt: skip
_NO_RIGID = "give a rigid 4x4 matrix, row by row"


def right_camera(calibration: Calibration, images: str) -> StereoRig | None:
    """Right camera that the file of a calibration states beside that of the images.

    KITTI's ``calib.txt`` has the rows ``P0`` and ``P1``, or ``P2`` and ``P3`` for images of a folder ``image_2``;
    EuRoC's ``cam0/sensor.yaml`` has ``cam1/sensor.yaml`` beside it, both with ``T_BS``; Kalibr's camchain has ``cam0``
    and ``cam1``, with ``T_cn_cnm1`` (points of the camera before to this one) or ``T_cam_imu`` in both.

    Args:
        calibration: of the left images; its file is read again.
        images: name of the folder or video of the left images.

    Returns:
        The camera; None where the file states none, or is not there any more.

    Raises:
        DvoError: a malformed file.
    """
    file = calibration.file
    if file is None or not is_file(file) or file.suffix.lower() == ".bin":
        return None
    text = read_text(file)
    if file.name == "sensor.yaml" and file.parent.name == "cam0":
        return read_rig(file.parent.parent)
    if any(line.lstrip().startswith(("P0:", "P1:", "P2:", "P3:")) for line in text.splitlines()):
        return _of_kitti(file, images)
    if file.suffix.lower() in (".yaml", ".yml"):
        return _of_kalibr(load_yaml(text, file), file)
    return None


def _of_kitti(file: Path, images: str) -> StereoRig | None:
    pair = _PAIRS.get(images, ("P0", "P1"))
    rows = read_projections(file)
    if pair is None or not set(pair) <= set(rows):
        return None
    return projection_rig(rows[pair[0]], rows[pair[1]], file)


def _of_kalibr(data: Any, file: Path) -> StereoRig | None:
    cameras = [data.get(name) if isinstance(data, dict) else None for name in ("cam0", "cam1")]
    left, right = cameras
    if not isinstance(left, dict) or not isinstance(right, dict):
        return None
    if right.get("T_cn_cnm1") is not None:
        T_right_left = _pose(right, "T_cn_cnm1", "cam1", file)
    elif left.get("T_cam_imu") is not None and right.get("T_cam_imu") is not None:
        T_left_imu, T_right_imu = (_pose(c, "T_cam_imu", n, file) for c, n in ((left, "cam0"), (right, "cam1")))
        T_right_left = compose_poses(T_right_imu, invert_poses(T_left_imu))
    else:
        return None
    return StereoRig(from_values(right, file), invert_poses(T_right_left))


def _pose(camera: dict[str, Any], key: str, name: str, file: Path) -> np.ndarray:
    try:
        return pose_of_numbers(camera[key], file)
    except DvoError as error:
        raise DvoError(error.message, file=file, field=f"{name}.{key}", remedy=_NO_RIGID) from None
