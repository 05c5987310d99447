"""Working image of the tracker: the frame resized to a fixed number of pixels at the same aspect."""

from __future__ import annotations

import math

import cv2
import numpy as np

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera

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


def working_image(frame: Frame, pixels: int | None) -> tuple[np.ndarray, Camera, np.ndarray | None]:
    """Resize a frame by area resampling, and its mask by the nearest pixels.

    Args:
        frame: checked, without lens distortion.
        pixels: see :func:`working_size`; None for the image as it is.

    Returns:
        ``(h, w, 3)`` uint8 RGB image, its camera, and its ``(h, w)`` bool mask, None without one.

    Raises:
        DvoError: the frame's camera has distortion, which the odometries do not model.
    """
    if frame.camera.needs_undistortion:
        raise DvoError(
            f"frames with {frame.camera.model} distortion cannot be tracked",
            field="camera",
            remedy="undistort them first: dvo.geometry.undistort.Undistorter, or dvo.open, which does this",
        )
    given = frame.camera.width, frame.camera.height
    width, height = given if pixels is None else working_size(*given, pixels)
    if (width, height) == given:
        # Copies: a caller may use its buffers for the next frame.
        mask = None if frame.mask is None else np.array(frame.mask, order="C")
        return np.array(frame.image, order="C"), frame.camera, mask
    image = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA)
    camera = frame.camera.resized(width, height)
    if frame.mask is None:
        return image, camera, None
    return image, camera, cv2.resize(frame.mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
