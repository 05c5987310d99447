"""Reconstruction of a trajectory with the images that it was made from: after a run, without its keyframes."""

from __future__ import annotations

from collections.abc import Iterable

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


def reconstruct_recorded(
    frames: Iterable[Frame], trajectory: Trajectory, points: SparseMap, most: int = MOST_IMAGES
) -> Reconstruction:
    """Images of a recording with their poses, and the points of a map, which no image observes.

    The poses are divided into stretches of equal numbers, and the sharpest image of each is taken.

    Args:
        frames: of the recording, without lens distortion.
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
    best: dict[int, tuple[float, int, int, Frame]] = {}  # by stretch: sharpness, row, number, frame
    for frame in frames:
        row = int(np.argmin(np.abs(times - frame.timestamp))) if len(times) else -1
        if row < 0 or abs(times[row] - frame.timestamp) > _ROUNDING:
            continue
        sharpness = float(cv2.Laplacian(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var())
        stretch = row // length
        if stretch not in best or sharpness > best[stretch][0]:
            best[stretch] = sharpness, row, frame.index, frame
    if not best:
        raise DvoError(
            "no image of the source has the time of a pose", field="source", remedy="give the folder of its last run"
        )
    cameras: list[Camera] = []
    rows, identifiers, owners, jpegs = [], [], [], []
    for _, row, number, frame in (best[stretch] for stretch in sorted(best)):
        if frame.camera not in cameras:
            cameras.append(frame.camera)
        rows.append(row)
        identifiers.append(number)
        owners.append(cameras.index(frame.camera))
        bgr = np.ascontiguousarray(frame.image[..., ::-1])
        jpegs.append(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())
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
