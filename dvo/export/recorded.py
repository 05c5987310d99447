"""Reconstruction of a trajectory with the images that it was made from: after a run, without its keyframes."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.export.reconstruction import Reconstruction
from dvo.geometry.camera import Camera
from dvo.geometry.poses import pose_matrices
from dvo.odometry.protocol import SparseMap

MOST_IMAGES = 300
_QUALITY = 95
_ROUNDING = 1e-5  # seconds; trajectory files have nine decimals, and times may be large


def _row_of(frame: Frame, times: np.ndarray) -> int | None:
    """Row of the pose of a frame; None without one."""
    row = int(np.argmin(np.abs(times - frame.timestamp))) if len(times) else -1
    return row if row >= 0 and abs(times[row] - frame.timestamp) <= _ROUNDING else None


def _sharpness(frame: Frame) -> float:
    return float(cv2.Laplacian(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var())


def reconstruct_recorded(
    frames: Iterable[Frame], trajectory: Trajectory, points: SparseMap, most: int = MOST_IMAGES
) -> Reconstruction:
    """Images of a recording with their poses, and the points of a map, which no image observes.

    The poses are divided into stretches of equal numbers, and the sharpest image of each is taken.

    Args:
        frames: of the recording in order of time, without lens distortion.
        trajectory: camera-to-world poses; frames belong to them by their times.
        points: in the world of the trajectory.
        most: images.

    Returns:
        The reconstruction, its images of the size of the frames.

    Raises:
        DvoError: no frame has a pose.
    """
    times = trajectory.timestamps
    length = max(1, -(-len(times) // most))
    cameras: list[Camera] = []
    rows, identifiers, owners, jpegs = [], [], [], []
    with_pose = ((row, frame) for frame in frames if (row := _row_of(frame, times)) is not None)
    for _, stretch in groupby(with_pose, lambda one: one[0] // length):  # one image is held at a time
        row, frame = max(stretch, key=lambda one: _sharpness(one[1]))
        if frame.camera not in cameras:
            cameras.append(frame.camera)
        rows.append(row)
        identifiers.append(frame.index)
        owners.append(cameras.index(frame.camera))
        bgr = np.ascontiguousarray(frame.image[..., ::-1])
        jpegs.append(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())
    if not rows:
        raise DvoError(
            "no image of the source has the time of a pose", field="source", remedy="give the folder of its last run"
        )
    none = np.zeros(0, np.int64)
    return Reconstruction(
        cameras=tuple(cameras),
        camera_of=np.array(owners),
        identifiers=np.array(identifiers),
        timestamps=times[rows],
        T_cw=np.linalg.inv(pose_matrices(trajectory.poses_wc[rows])),
        jpegs=tuple(jpegs),
        points=points.points.astype(np.float64),
        colors=points.colors,
        errors=np.zeros(len(points.points)),
        image_of=none,
        point_of=none,
        positions=np.zeros((0, 2)),
        residuals=np.zeros(0),
    )
