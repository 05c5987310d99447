"""Positions and colours of marks on an image."""

from __future__ import annotations

import numpy as np

from dvo.geometry.camera import Camera


def pixels(rays: np.ndarray, camera: Camera) -> np.ndarray:
    """Project positions on the plane at depth 1.

    Args:
        rays: ``(N, 2)``.
        camera: of the image.

    Returns:
        ``(N, 2)`` pixels.
    """
    return rays * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def shade(confidence: np.ndarray) -> np.ndarray:
    """Colours from red (0) over yellow to green (1).

    Args:
        confidence: ``(N,)`` in [0, 1].

    Returns:
        ``(N, 3)`` uint8 RGB.
    """
    value = np.clip(confidence, 0, 1)
    red, green = np.clip(2 - 2 * value, 0, 1), np.clip(2 * value, 0, 1)
    return np.column_stack([230 * red + 20, 200 * green + 30, np.full(len(value), 60.0)]).astype(np.uint8)
