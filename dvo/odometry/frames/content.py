"""Content of images: whether two show the same scene, and reasons in words of frames without a pose."""

from __future__ import annotations

import cv2
import numpy as np

MATCHED = 0.15
"""Least share of matched corners of two images of the same scene."""

NO_MATCH = "no match with the frames before"
TOO_LITTLE_MOTION, TOO_FEW, NO_FIT = "too little motion", "too few keyframes", "no motion fits the images"
"""Reasons of an odometry that is initialising."""

_WIDTH = 160  # of the images whose corners are matched, pixels
_CORNERS = 150  # at most
_SPACING, _QUALITY = 5.0, 0.01  # of corners: least distance in pixels, and least strength as a share of the strongest
_SIDE, _LEVELS = 15, 4  # of the windows, and halvings of the resolution
_RETURN = 1.0  # largest distance of a corner from its start after the way there and back, pixels
_DEVIATION = 48.0  # standard deviation that the images are brought to, grey levels
_UNLIKE = 24.0  # mean difference of two windows above which they do not show the same, grey levels


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
