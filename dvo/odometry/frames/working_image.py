"""Working image of the tracker: the frame resized to a fixed number of pixels at the same aspect."""

from __future__ import annotations

import math

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import needs_undistortion

_MULTIPLE = 8


def working_size(width: int, height: int, pixels: int) -> tuple[int, int]:
    """Size of the working image; larger than the image at most by the rounding.

    Args:
        width, height: of the image.
        pixels: number of pixels to aim for; 0 keeps the size up to the rounding.

    Returns:
        Width and height, multiples of 8 and at least 32, of nearly the same aspect.
    """
    scale = 1.0 if pixels <= 0 else min(1.0, math.sqrt(pixels / (width * height)))
    return tuple(max(_MULTIPLE * 4, _MULTIPLE * round(side * scale / _MULTIPLE)) for side in (width, height))  # type: ignore[return-value]


def masked_image(frame: Frame, pixels: int) -> tuple[np.ndarray, Camera, np.ndarray | None]:
    """Resize a frame and its mask, for an odometry that uses masks.

    Args:
        frame: checked, without lens distortion.
        pixels: see :func:`working_size`.

    Returns:
        Image and camera of :func:`working_image`; ``(h, w)`` bool mask by the nearest pixels, None without one.

    Raises:
        DvoError: the frame's camera has distortion.
    """
    image, camera = _resized(frame, pixels)
    if frame.mask is None:
        return image, camera, None
    mask = cv2.resize(frame.mask.astype(np.uint8), image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return image, camera, mask > 0


def working_image(frame: Frame, pixels: int) -> tuple[np.ndarray, Camera]:
    """Resize a frame by area resampling.

    Args:
        frame: without lens distortion.
        pixels: see :func:`working_size`.

    Returns:
        ``(H, W, 3)`` uint8 RGB image and its camera.

    Raises:
        DvoError: the frame's camera has distortion, which the tracker does not model; the frame has a mask, which the
            odometry would not see.
    """
    if frame.mask is not None:
        raise DvoError("this odometry does not use masks", field="mask", remedy="use weights of patch_vo, or no mask")
    return _resized(frame, pixels)


def _resized(frame: Frame, pixels: int) -> tuple[np.ndarray, Camera]:
    """Working image and its camera, whatever the mask."""
    if needs_undistortion(frame.camera):
        raise DvoError(
            f"frames with {frame.camera.model} distortion cannot be tracked",
            field="camera",
            remedy="undistort them first: dvo.geometry.undistort.Undistorter, or dvo.open, which does this",
        )
    width, height = working_size(frame.camera.width, frame.camera.height, pixels)
    if (width, height) == (frame.camera.width, frame.camera.height):
        return np.array(frame.image, order="C"), frame.camera  # a copy: a caller may use its buffer for the next frame
    image = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA)
    return image, frame.camera.resized(width, height)
