"""Pixels that do not move with the scene: bonnet, dashboard, watermark, drops on the lens, black border or bars.

A pixel of the image is fixed to it if its grey level varies less, over frames between which the picture has changed,
than a small displacement would make it with the gradient that is there, although the motion of the picture at that
place would have displaced it across its gradient. That motion is affine, of the corners that move: so neither an edge
along which the picture moves (a lane marking) counts as fixed, nor what lies straight ahead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
DARK = 48
"""Largest grey level of the bars of a letterbox or pillarbox."""
FLAT = 6
"""Largest deviation of a pixel of a bar from its level."""
SPECKS = 0.005
"""Share of the pixels of a row or column that may deviate more."""
SMALLEST = 0.1
"""Share of an image that is picture between bars, at least."""
STEP = 0.3
"""Share of the pixels behind a bar that have to differ from it, at least in one image."""


class FixedPixels:
    """Running statistics of the grey levels of working images.

    Only frames in which the picture has changed count as samples, so that a camera that stands still fixes nothing.
    Dark bars at the sides are known from the first image on, and are as wide as in the image where they are least.

    Attributes:
        mask: ``(H, W)`` bool, False for pixels that are fixed to the image; None as long as there are none.
        picture: ``(H, W)`` bool, False in bars; None without bars.
    """

    def __init__(self) -> None:
        self.mask: np.ndarray | None = None
        self.picture: np.ndarray | None = None
        self._moved: np.ndarray | None = None  # the mask without bars
        self._bars = Bars()
        self._count = 0
        self._last = self._mean = self._square = self._slope = self._across = np.zeros((0, 0), np.float32)

    def see(self, image: np.ndarray) -> bool:
        """Take the next working image.

        Args:
            image: ``(H, W, 3)`` uint8 RGB, of the size of those before.

        Returns:
            True if :attr:`mask` was made anew.
        """
        bars, before = self._bars.with_image(image), self.picture
        if bars != self._bars:
            inside = bars.inside(image.shape, MARGIN)
            self._bars, self.picture = bars, None if inside is None else np.zeros(image.shape[:2], bool)
            if inside is not None and self.picture is not None:
                self.picture[inside] = True
        if not self._sample(image) and self.picture is before:
            return False
        masks = [mask for mask in (self.picture, self._moved) if mask is not None]
        self.mask = np.logical_and.reduce(masks) if masks else None
        return True

    def _sample(self, image: np.ndarray) -> bool:
        """Take the next image as a sample, if the picture has changed; True if :attr:`_moved` was made anew."""
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
        before, self._moved = self._moved, self._found()
        return not (before is None and self._moved is None)

    def _found(self) -> np.ndarray | None:
        """Mask by the samples so far."""
        variance = np.maximum(self._square - self._mean**2, 0)
        texture = self._slope > TEXTURE
        still = np.sqrt(variance) < DISPLACEMENT * self._slope + NOISE
        fixed = texture & still & (self._across > EXPECTED)
        if not fixed.any():
            return None
        whole = cv2.morphologyEx(fixed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        share = int(whole.sum()) / max(int(texture.sum()), 1)
        if not FIXED_SHARES[0] < share < FIXED_SHARES[1]:
            return None
        return cv2.dilate(whole, np.ones((2 * MARGIN + 1,) * 2, np.uint8)) == 0


@dataclass(frozen=True)
class Bars:
    """Dark bars at the sides of all images so far, as of a letterbox or pillarbox.

    Attributes:
        widths: of the rows above and below and the columns to the left and right that are dark and flat in all images,
            pixels; None before the first image.
        seen: of each, an image has shown that a picture begins behind it: what is dark at night is no bar.
    """

    widths: tuple[int, ...] | None = None
    seen: tuple[bool, ...] = (False,) * 4

    def with_image(self, image: np.ndarray) -> Bars:
        """The same with one more image, ``(H, W, 3)`` uint8."""
        if self.widths is not None and not any(self.widths):
            return self  # bars are in all images
        grey = image.max(2).astype(np.int16)
        sides = grey, grey[::-1], grey.T, grey.T[::-1]
        found = [_flat_rows(side) for side in sides]
        if (len(grey) - found[0] - found[1]) * (grey.shape[1] - found[2] - found[3]) < SMALLEST * grey.size:
            return self  # nothing but darkness, or a lamp in it
        widths = found if self.widths is None else [min(pair) for pair in zip(self.widths, found, strict=True)]
        rows, columns = _between(found[:2], len(grey)), _between(found[2:], grey.shape[1])
        seen = []
        for k, (side, inside) in enumerate(zip(sides, (columns, columns, rows, rows), strict=True)):
            known = self.widths is not None and self.seen[k] and widths[k] == self.widths[k]
            is_bar = widths[k] == found[k] > 0 and _is_step(side[:, inside], widths[k])
            seen.append(known or is_bar)
        return Bars(tuple(widths), tuple(seen))

    def inside(self, shape: tuple[int, ...], margin: int) -> tuple[slice, slice] | None:
        """Rows and columns of an image of that shape that keep a margin from the bars; None without bars."""
        if not any(self.seen) or self.widths is None:
            return None
        widths = [width + margin if seen else 0 for width, seen in zip(self.widths, self.seen, strict=True)]
        return _between(widths[:2], shape[0]), _between(widths[2:], shape[1])


def _between(widths: Sequence[int], size: int) -> slice:
    return slice(widths[0], size - widths[1])


def _flat_rows(grey: np.ndarray) -> int:
    """Number of rows from the first one on that are dark and flat."""
    level = int(np.median(grey[0]))
    if level > DARK:
        return 0
    uneven = (np.abs(grey - level) > FLAT).mean(1) > SPECKS
    return int(uneven.argmax()) if uneven.any() else len(grey)


def _is_step(grey: np.ndarray, rows: int) -> bool:
    """True if most of what follows the flat rows, behind a row of transition, is no longer of their level."""
    behind = grey[rows + 1 : rows + 3]
    return bool(len(behind)) and bool((np.abs(behind - int(np.median(grey[0]))) > 2 * FLAT).any(0).mean() > STEP)


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
    y, x = (np.arange(size, dtype=np.float32) for size in (height, width))
    moved = (affine - np.eye(2, 3)).astype(np.float32)  # of an image of half the size: its shift counts twice
    to_right, down = (by_x * x + (by_y * y + 2 * shift)[:, None] for by_x, by_y, shift in moved)
    return to_right, down


def _grey_and_gradient(image: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Smoothed grey levels ``(H, W)`` float32, their gradient to the right and down, and its magnitude."""
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    x, y = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    return grey, (x, y), cv2.magnitude(x, y)
