"""What a frame is: the thing that readers yield and every odometry is fed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.geometry.camera import Camera


@dataclass(frozen=True)
class Frame:
    """One image with its time and camera.

    Attributes:
        index: position in the source, counted from 0 before any stride.
        timestamp: seconds, float64.
        image: ``(H, W, 3)`` uint8 RGB.
        camera: the camera of exactly this image (same size).
    """

    index: int
    timestamp: float
    image: np.ndarray
    camera: Camera
