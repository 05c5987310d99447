"""Reduction of large images by a whole factor, right after they are decoded."""

from __future__ import annotations

import math
from dataclasses import dataclass

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


def reduction_to(max_pixels: int | None, width: int, height: int) -> Reduction | None:
    """Reduction by the smallest factor that leaves at most a number of pixels.

    Args:
        max_pixels: pixels of an image; None for any number.
        width, height: of the recorded images, pixels.

    Returns:
        None if they are small enough.

    Raises:
        DvoError: ``max_pixels`` is not positive.
    """
    if max_pixels is None:
        return None
    if not max_pixels > 0:  # NaN fails too
        raise DvoError(f"{max_pixels} pixels", field="max_pixels", remedy="give a positive number, or None")
    factor = math.ceil(math.sqrt(width * height / max_pixels))
    return None if factor < 2 else Reduction((width, height), factor)
