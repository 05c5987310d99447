"""Pixels that do not move with the scene: bonnet, dashboard, watermark, drops on the lens, black border.

A pixel of the image is fixed to it if its grey level varies less, over frames between which the picture has changed,
than a small displacement would make it with the gradient that is there, although the motion of the picture at that
place would have displaced it across its gradient. That motion is affine, of the corners that move: so neither an edge
along which the picture moves (a lane marking) counts as fixed, nor what lies straight ahead.
"""

from __future__ import annotations

import cv2
import numpy as np

TEXTURE = 3.0
"""Least mean gradient of a pixel that can be judged, grey levels a pixel."""
DISPLACEMENT = 0.3
"""Largest RMS displacement of a fixed pixel, pixels of the working image."""
NOISE = 2.0
"""Standard deviation of the grey level of a pixel of a still scene."""
EXPECTED = 0.8
"""Least mean displacement between samples, across the gradient of a fixed pixel, that the motion of the picture asks
for, pixels."""
LARGE = 3.0
"""Displacement above which a sample counts no more, pixels: one jump proves nothing."""
CORNERS = 80
"""Corners that the motion of the picture is taken from, found in the image at half its size."""
MIN_CORNERS = 8
"""Corners that have to agree on it."""
CHANGED = 0.2
"""Share of the pixels with texture that have to change from one sample to the next."""
SAMPLES = 12
"""Samples before the first mask."""
MEMORY = 24
"""Samples over which means are taken, about."""
FIXED_SHARES = (0.002, 0.6)
"""Least and largest share of the pixels with texture that are fixed, for a mask: where nearly all is fixed the camera
stands still before something that moves."""
MARGIN = 3
"""Distance from a fixed pixel that is ignored too, pixels."""


class FixedPixels:
    """Running statistics of the grey levels of working images.

    Only frames in which the picture has changed count as samples, so that a camera that stands still fixes nothing.

    Attributes:
        mask: ``(H, W)`` bool, False for pixels that are fixed to the image; None as long as there are none.
    """

    def __init__(self) -> None:
        self.mask: np.ndarray | None = None
        self._count = 0
        self._last = self._mean = self._square = self._slope = self._across = np.zeros((0, 0), np.float32)

    def see(self, image: np.ndarray) -> bool:
        """Take the next working image.

        Args:
            image: ``(H, W, 3)`` uint8 RGB, of the size of those before.

        Returns:
            True if :attr:`mask` was made anew.
        """
        grey, (dx, dy), slope = _grey_and_gradient(image)
        if not self._count:
            self._count, self._last, self._mean, self._square, self._slope = 1, grey, grey, grey**2, slope
            self._across = np.zeros_like(grey)
            return False
        texture = np.maximum(slope, self._slope) > TEXTURE
        changed = texture & (np.abs(grey - self._last) > DISPLACEMENT * slope + 2 * NOISE)
        if int(changed.sum()) < CHANGED * max(int(texture.sum()), 1):
            return False
        motion = picture_motion(self._last, grey)
        self._last, self._count = grey, self._count + 1
        rate = 1 / min(self._count, MEMORY)
        self._mean = self._mean + rate * (grey - self._mean)
        self._square = self._square + rate * (grey**2 - self._square)
        self._slope = self._slope + rate * (slope - self._slope)
        if motion is not None:
            across = np.abs(dx * motion[0] + dy * motion[1]) / np.maximum(slope, 1e-6)
            self._across = self._across + rate * (np.minimum(across, LARGE) - self._across)
        if self._count < SAMPLES:
            return False
        before, self.mask = self.mask, self._found()
        return not (before is None and self.mask is None)

    def _found(self) -> np.ndarray | None:
        """Mask by the samples so far."""
        variance = np.maximum(self._square - self._mean**2, 0)
        texture = self._slope > TEXTURE
        still = np.sqrt(variance) < DISPLACEMENT * self._slope + NOISE
        fixed = texture & still & (self._across > EXPECTED)
        whole = cv2.morphologyEx(fixed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        share = int(whole.sum()) / max(int(texture.sum()), 1)
        if not FIXED_SHARES[0] < share < FIXED_SHARES[1]:
            return None
        return cv2.dilate(whole, np.ones((2 * MARGIN + 1,) * 2, np.uint8)) == 0


def picture_motion(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Displacement of every pixel from one image to another, by an affine motion of the corners that move.

    Args:
        first, second: ``(H, W)`` float32 grey levels.

    Returns:
        ``(H, W)`` to the right and down, pixels; None if too few corners agree.
    """
    height, width = first.shape
    one, other = (
        cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA).astype(np.uint8)
        for image in (first, second)
    )
    corners = cv2.goodFeaturesToTrack(one, CORNERS, 0.01, 5)
    if corners is None:
        return None
    there, found, _ = cv2.calcOpticalFlowPyrLK(one, other, corners, np.zeros_like(corners), winSize=(11, 11))
    pairs = np.concatenate([corners, there], 2)[found > 0].reshape(-1, 4)
    moved = pairs[np.abs(pairs[:, 2:] - pairs[:, :2]).max(1) > DISPLACEMENT / 2]
    if len(moved) < MIN_CORNERS:
        return None
    cv2.setRNGSeed(0)
    before, after = (np.ascontiguousarray(side) for side in np.hsplit(moved, 2))
    affine, agree = cv2.estimateAffine2D(before, after, ransacReprojThreshold=1.0)
    if affine is None or int(agree.sum()) < MIN_CORNERS:
        return None
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) / 2
    to_right, down = (2 * (row[0] * x + row[1] * y + row[2]) for row in affine.astype(np.float32))
    return to_right - 2 * x, down - 2 * y


def _grey_and_gradient(image: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Smoothed grey levels ``(H, W)`` float32, their gradient to the right and down, and its magnitude."""
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    x, y = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    return grey, (x, y), cv2.magnitude(x, y)
