"""Reduction of large images by a whole factor, right after they are decoded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera

MAX_PIXELS = 4_000_000
"""Images with more pixels than this are reduced by default: 4K is, 2560 x 1440 is not."""


@dataclass(frozen=True)
class Reduction:
    """Reduction of the images of a recording.

    Attributes:
        recorded: width and height of the images as recorded, pixels.
        factor: whole number by which width and height are divided, and rounded.
    """

    recorded: tuple[int, int]
    factor: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the reduced images, pixels."""
        width, height = (max(1, round(side / self.factor)) for side in self.recorded)
        return width, height

    @property
    def is_exact(self) -> bool:
        """True if every reduced pixel is made of whole recorded ones."""
        return all(side % self.factor == 0 for side in self.recorded)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Reduce an image by area.

        Args:
            image: ``(H, W)`` or ``(H, W, C)``, uint8, uint16 or float.

        Returns:
            Image of ``size`` and of the same type; the image itself if it is not of the recorded size.
        """
        import cv2

        if image.shape[1::-1] != self.recorded:
            return image
        return cv2.resize(image, self.size, interpolation=cv2.INTER_AREA)

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """Reduce a mask: a pixel is used if more than half of it is.

        Args:
            mask: ``(H, W)`` bool.
        """
        return self(mask.astype(np.uint8) * 255) > 127

    def camera(self, camera: Camera) -> Camera:
        """Camera of the reduced images.

        Args:
            camera: of the recorded ones.
        """
        return camera.resized(*self.size)


def reduce_images(recording: Any, width: int, height: int, max_pixels: int | None) -> Reduction | None:
    """Let a recording reduce its images by the smallest factor that leaves at most ``max_pixels``.

    Args:
        recording: a :class:`dvo.data.recording.Recording`; one without the attribute ``reduction`` is left as it is.
        width, height: of its images, pixels.
        max_pixels: pixels of an image; None for any number.

    Returns:
        What it will do; None for nothing.

    Raises:
        DvoError: ``max_pixels`` is not positive.
    """
    if max_pixels is None:
        return None
    if not max_pixels > 0:  # NaN fails too
        raise DvoError(f"{max_pixels} pixels", field="max_pixels", remedy="give a positive number, or None")
    factor = math.ceil(math.sqrt(width * height / max_pixels))
    if factor < 2 or not hasattr(recording, "reduction"):
        return None
    recording.reduction = Reduction((width, height), factor)
    return recording.reduction
