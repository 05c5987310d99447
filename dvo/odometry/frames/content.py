"""Content of images: whether one shows anything, and whether two show the same scene."""

from __future__ import annotations

import cv2
import numpy as np

MATCHED = 0.15
"""Least share of matched corners of two images of the same scene."""

NO_MATCH = "no match with the frames before"
TOO_LITTLE_MOTION, TOO_FEW, NO_FIT = "too little motion", "too few keyframes", "no motion fits the images"
"""Reasons of an odometry that is initialising."""
MASK_MARGIN = 12
"""Distance from ignored pixels within which nothing is measured: the size of a patch of three feature pixels, at a
quarter of the resolution."""
MASKED = "masked image"
"""Reason of a loss of a frame of which its mask leaves too little."""

_BLOCK = 8  # side of the blocks whose means show structure, pixels of the working image
_CONTRAST = 2.5  # least difference of neighbouring blocks that counts as structure without noise, grey levels
_NOISE = 6.0  # and its share of the expected difference of blocks of independent noise
_STRONG_NOISE = 10.0  # difference of neighbouring pixels that sensor noise stays below, grey levels
_DARK, _BRIGHT = 64.0, 192.0

_LEAST_USED = 0.05  # share of the pixels that a mask leaves, beside a margin

_WIDTH = 160  # of the images whose corners are matched, pixels
_CORNERS = 150  # at most
_SPACING, _QUALITY = 5.0, 0.01  # of corners: least distance in pixels, and least strength as a share of the strongest
_SIDE, _LEVELS = 15, 4  # of the windows, and halvings of the resolution
_RETURN = 1.0  # largest distance of a corner from its start after the way there and back, pixels
_DEVIATION = 48.0  # standard deviation that the images are brought to, grey levels
_UNLIKE = 24.0  # mean difference of two windows above which they do not show the same, grey levels


def missing_content(image: np.ndarray, mask: np.ndarray | None = None) -> str:
    """Find out if an image shows nothing: its blocks differ no more than those of uniform light and sensor noise would.

    Noise is estimated from the median difference of neighbouring pixels. The mean of an ``8x8`` block averages
    independent noise to an eighth, while differences of a view grow with the distance. Strong noise could be a fine
    texture; only the measurements in several images tell them apart.

    Args:
        image: ``(H, W, 3)`` uint8 RGB working image.
        mask: ``(H, W)`` bool, the only pixels that are looked at; None for all. If less than a twentieth of them is
            left beside a margin, the image is masked.

    Returns:
        Description, such as ``"black image"``; empty for an image with content.

    Example:
        >>> missing_content(np.zeros((240, 320, 3), np.uint8))
        'black image'
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if mask is not None:
        return _missing_in_mask(grey, mask)
    height, width = (max(2, side // _BLOCK) for side in grey.shape)
    blocks = cv2.resize(grey.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    steps = np.concatenate([np.abs(np.diff(blocks, axis=axis)).ravel() for axis in (0, 1)])
    structure = float(np.percentile(steps, 99))
    noise = float(np.median(cv2.absdiff(grey[::4, 1:], grey[::4, :-1])))
    return _judged(structure, noise, float(blocks.mean()))


def _missing_in_mask(grey: np.ndarray, mask: np.ndarray) -> str:
    """Description of an image of which a part is used, as :func:`missing_content`: by the blocks that lie in it."""
    margin = np.ones((2 * MASK_MARGIN + 1,) * 2, np.uint8)
    if cv2.erode(mask.astype(np.uint8), margin).mean() < _LEAST_USED:
        return MASKED
    height, width = (max(2, side // _BLOCK) for side in grey.shape)
    share = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    blocks = cv2.resize(grey * mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    blocks = np.where(share > 0.5, blocks / np.maximum(share, 0.5), np.nan)
    steps = np.concatenate([np.abs(np.diff(blocks, axis=axis)).ravel() for axis in (0, 1)])
    pairs = mask[::4, 1:] & mask[::4, :-1]
    if not (np.isfinite(steps).any() and pairs.any()):
        return MASKED
    noise = float(np.median(cv2.absdiff(grey[::4, 1:], grey[::4, :-1])[pairs]))
    return _judged(float(np.nanpercentile(steps, 99)), noise, float(np.nanmean(blocks)))


def _judged(structure: float, noise: float, mean: float) -> str:
    """Description of an image by the differences of its blocks and of its pixels, and its brightness."""
    if noise > _STRONG_NOISE or structure > _CONTRAST + _NOISE * noise / _BLOCK:
        return ""
    return "black image" if mean < _DARK else "white image" if mean > _BRIGHT else "image without content"


def matched_share(before: np.ndarray, after: np.ndarray) -> float:
    """Share of the corners of an image that are found in the next one, and from there back where they were.

    For odometries whose network does not tell how sure it is: images of noise and of different scenes have corners too,
    but these do not return. Pyramidal Lucas-Kanade flow (Bouguet, 2000) of images of 160 pixels' width, brought to
    equal mean and contrast.

    Args:
        before, after: ``(H, W, 3)`` uint8 RGB working images of one size.

    Returns:
        In [0, 1]; 0 for an image without corners.
    """
    a, b = _small_grey(before), _small_grey(after)
    corners = cv2.goodFeaturesToTrack(a, _CORNERS, _QUALITY, _SPACING)
    if corners is None:
        return 0.0
    start = np.asarray(corners, np.float32).reshape(-1, 2)
    there, found = _flow(a, b, start)
    back, returned = _flow(b, a, there)
    near = np.linalg.norm(back - start, axis=1) < _RETURN
    inside = ((there >= 0) & (there <= np.array(a.shape[::-1]) - 1)).all(1)
    return float((near & inside & found & returned).mean())


def _flow(a: np.ndarray, b: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places ``(N, 2)`` of points of image ``a`` in image ``b``, and whether the windows there are alike ``(N,)``."""
    there, found, unlike = cv2.calcOpticalFlowPyrLK(
        a, b, points, np.zeros_like(points), winSize=(_SIDE,) * 2, maxLevel=_LEVELS
    )
    return np.asarray(there).reshape(-1, 2), (np.asarray(found).ravel() > 0) & (np.asarray(unlike).ravel() < _UNLIKE)


def _small_grey(image: np.ndarray) -> np.ndarray:
    """Grey image of the width of matching, with a mean of 128 and a standard deviation of :data:`_DEVIATION`."""
    height = max(32, round(image.shape[0] * _WIDTH / image.shape[1]))
    grey = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (_WIDTH, height), interpolation=cv2.INTER_AREA)
    level = (grey.astype(np.float32) - grey.mean()) / max(float(grey.std()), 1.0)
    return (_DEVIATION * level + 128.0).clip(0, 255).astype(np.uint8)
