"""Evidence for the pose of a frame: content of its image, and agreement of its measurements with the window."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from torch import Tensor

from dvo.geometry.projection import reproject
from dvo.map.window import Window
from dvo.nets.patch.masks import MASK_MARGIN, shrunk

CONFIDENT = 0.1
"""Confidence of a measurement above which it can be an inlier."""
AGREEMENT = 0.5
"""Largest distance of an inlier from the reprojection of its patch after bundle adjustment, feature pixels."""

MATCHED = 0.15
"""Least share of matched corners of two images of the same scene."""

NO_MATCH = "no match with the frames before"
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


@dataclass(frozen=True)
class Evidence:
    """Agreement of the measurements of a frame with those before it in the window.

    Attributes:
        confidence: mean confidence of the edges from these frames and its own patches into the frame, in [0, 1].
        inliers: share of the patches of earlier frames that are found in it: confident, and where bundle adjustment
            reprojects them, in [0, 1].
    """

    confidence: float
    inliers: float

    def supports(self, confidence: float, inliers: float) -> bool:
        """Decide if the images bear out the pose.

        Args:
            confidence, inliers: that are needed at least.

        Returns:
            True if they do.
        """
        return self.confidence >= confidence and self.inliers >= inliers


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
    if shrunk(mask, MASK_MARGIN).mean() < _LEAST_USED:
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


def newest_evidence(window: Window) -> Evidence:
    """Evidence for the pose of the newest frame of a window, after a step.

    Args:
        window: after a step.

    Returns:
        Evidence; zero for a window of one frame.
    """
    return evidence_of(window, len(window) - 1)


def evidence_of(window: Window, position: int) -> Evidence:
    """Evidence for the pose of a frame of a window, after a step; later frames do not count.

    Args:
        window: after a step.
        position: of the frame in the window.

    Returns:
        Evidence; without inliers for the first frame.
    """
    into = (window.jj == position) & (window.ii <= position)
    if not bool(into.any()):
        return Evidence(0.0, 0.0)
    into = measured(window, window.confidence, into)
    if not bool(into.any()):
        return Evidence(0.0, 0.0)
    confidence = float(window.confidence[into].mean())
    earlier = into & (window.ii < position)
    if not bool(earlier.any()):
        return Evidence(confidence, 0.0)
    return Evidence(confidence, _inliers(window, earlier))


def measured(window: Window, confidence: Tensor, among: Tensor) -> Tensor:
    """Edges whose measurement counts as evidence: those that do not lie in ignored pixels.

    Args:
        window: of the edges.
        confidence: ``(E, 2)``, 0 for measurements in ignored pixels.
        among: ``(E,)`` bool.

    Returns:
        ``(E,)`` bool; ``among`` itself if no frame has a mask.
    """
    return among if window.visible is None else among & (confidence != 0).any(dim=-1)  # NaN is evidence against


def last_unrelated(window: Window, least_confidence: float, least_inliers: float) -> int:
    """Position after the last pair of consecutive frames of a window that do not show the same scene.

    Args:
        window: after some steps.
        least_confidence, least_inliers: of two frames that show the same scene.

    Returns:
        Position of the first frame that all later ones are related to; 0 if all frames are.
    """
    found = 0
    for position in range(1, len(window)):
        pair = (window.ii == position - 1) & (window.jj == position)
        pair |= (window.ii == position) & (window.jj == position - 1)
        if not bool(pair.any()):  # its edges have left the window: nothing speaks against the two any more
            continue
        pair = measured(window, window.confidence, pair)
        confidence, inliers = float(window.confidence[pair].mean()), _inliers(window, pair)
        if confidence >= least_confidence and inliers >= least_inliers:
            continue
        # Where most of the picture is sky or water few patches agree, although both frames show the same.
        before, after = window.frames[position - 1].image, window.frames[position].image
        if before is None or after is None or math.isnan(confidence) or matched_share(before, after) < MATCHED:
            found = position
    return found


def related_share(window: Window, among: Tensor) -> float:
    """Share of the edges between different frames that are inliers.

    Args:
        window: after a step.
        among: ``(E,)`` bool, edges that count.

    Returns:
        In [0, 1]; 0 without such an edge.
    """
    edges = measured(window, window.confidence, among & (window.ii != window.jj))
    return _inliers(window, edges) if bool(edges.any()) else 0.0


def _inliers(w: Window, edges: Tensor) -> float:
    seen = reproject(w.poses_cw[None], w.patches[None], w.intrinsics[None], w.ii[edges], w.jj[edges], w.kk[edges])
    centre = seen.coords.shape[2] // 2
    residual = (w.targets[edges] - seen.coords[0, :, centre, centre]).norm(dim=-1)
    found = (w.confidence[edges].mean(dim=-1) > CONFIDENT) & (residual < AGREEMENT)
    return float(found.float().mean())
