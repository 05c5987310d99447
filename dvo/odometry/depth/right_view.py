"""Right image of a stereo pair at the size of the working image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.data.frame import Frame, StereoView
from dvo.data.frame_checks import checked_frame
from dvo.geometry.poses import invert_poses


@dataclass(frozen=True)
class RightView:
    """Right image of a stereo pair.

    Attributes:
        image: ``(H, W, 3)`` uint8 RGB of the size of the working image.
        intrinsics: ``(4,)`` float64 fx fy cx cy of it.
        pose_right_left: ``(7,)`` float64, left camera to right camera, metres.
    """

    image: np.ndarray
    intrinsics: np.ndarray
    pose_right_left: np.ndarray


def right_view(frame: Frame, width: int, height: int) -> RightView | None:
    """Read the right image of a frame, and resize it as its image.

    Args:
        frame: with an image and a camera.
        width, height: of the working image.

    Returns:
        The view; None for a frame without one.

    Raises:
        DvoError: a value that is no :class:`dvo.data.frame.StereoView`, an image of another size than that of the
            frame or of another type, a camera with distortion, or a pose without a distance between the cameras.
    """
    view = frame.right
    if view is None:
        return None
    field = f"frame {frame.index}: right"
    if not isinstance(view, StereoView):
        remedy = "give dvo.data.StereoView(image, camera, T_left_right)"
        raise DvoError(f"expected a StereoView, got {type(view).__name__}", field=field, remedy=remedy)
    try:
        image = checked_frame(Frame(frame.index, frame.timestamp, view.image, view.camera)).image
    except DvoError as error:
        raise DvoError(f"{error.field}: {error.message}", field=field, remedy=error.remedy) from None
    if image.shape != frame.image.shape:
        message = "is {1}x{0}, the left image {3}x{2} (width x height)".format(*image.shape[:2], *frame.image.shape[:2])
        raise DvoError(message, field=field, remedy="give both images of a pair at one size")
    if view.camera.needs_undistortion:
        remedy = "undistort both images first: dvo.geometry.undistort.Undistorter, or dvo.open, which does this"
        raise DvoError(f"has {view.camera.model} distortion", field=field, remedy=remedy)
    pose = np.asarray(view.T_left_right, dtype=np.float64)
    if pose.shape != (7,) or not np.isfinite(pose).all() or abs(np.linalg.norm(pose[3:]) - 1) > 1e-3:
        remedy = "give tx ty tz qx qy qz qw of the right camera in the axes of the left one, metres"
        raise DvoError("T_left_right is no pose", field=field, remedy=remedy)
    if not 1e-6 < np.linalg.norm(pose[:3]) < math.inf:
        remedy = "give the distance between the cameras, metres, as the translation of T_left_right"
        raise DvoError("the cameras are at one place", field=field, remedy=remedy)
    camera = view.camera
    if (width, height) != (camera.width, camera.height):
        image, camera = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), camera.resized(width, height)
    return RightView(image, camera.intrinsics, invert_poses(pose))
