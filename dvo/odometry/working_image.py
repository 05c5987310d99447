"""The image that the network sees: a fixed budget of pixels, the aspect kept."""

from __future__ import annotations

import math

import cv2
import numpy as np

from dvo.data.frame import Frame
from dvo.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import needs_undistortion

_MULTIPLE = 8


def working_size(width: int, height: int, pixels: int) -> tuple[int, int]:
    """Width and height, multiples of 8, of about ``pixels`` pixels and the same aspect; never larger than the image
    by more than the rounding. ``pixels = 0`` keeps the size up to the rounding."""
    scale = 1.0 if pixels <= 0 else min(1.0, math.sqrt(pixels / (width * height)))
    return tuple(max(_MULTIPLE * 4, _MULTIPLE * round(side * scale / _MULTIPLE)) for side in (width, height))  # type: ignore[return-value]


def working_image(frame: Frame, pixels: int) -> tuple[np.ndarray, Camera]:
    """Area-resampled ``(H, W, 3)`` uint8 image and its camera.

    Raises:
        DvoError: the frame's camera has distortion, with which poses would be wrong without a word.
    """
    if needs_undistortion(frame.camera):
        raise DvoError(
            f"frames with {frame.camera.model} distortion cannot be tracked",
            field="camera",
            remedy="undistort them first: dvo.geometry.undistort.Undistorter, or open_source, which does it",
        )
    width, height = working_size(frame.camera.width, frame.camera.height, pixels)
    if (width, height) == (frame.camera.width, frame.camera.height):
        return np.ascontiguousarray(frame.image), frame.camera
    image = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA)
    return image, frame.camera.resized(width, height)
