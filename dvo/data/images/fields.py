"""Interlaced images: their even and odd lines are of two moments, half a frame apart."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice

import numpy as np

DEINTERLACE = "deinterlace the video: ffmpeg -i VIDEO -vf bwdif OUT.mp4"
INTERLACED = (
    f"the images are interlaced, their even and odd lines of two moments: if they are of a video, {DEINTERLACE}"
)
LOOKED_AT = 16  # images
_TRIPLES = 8  # of images with motion, that suffice
_FEWEST = 3
_MOVED = 6.0  # grey levels
_SHARE = 0.005  # least share of pixels that have moved
_HIGHEST = 1088  # lines; formats with more know no fields
_WIDTH = 640  # columns that are looked at, about
_ROUGH = 1.1  # differences of neighbouring lines over those of every second line; 0.5 for a slope, 1 for noise
_FURTHER = 1.1  # differences to the farthest field over those within an image, at least
_NEAR = 0.6  # place of the nearest field beside those of the same image, from 0 (as near) to 1 (as far as any)


def are_interlaced(images: Iterable[np.ndarray]) -> bool:
    """Find out if images that follow each other are interlaced.

    Among the pixels that move, even lines are compared with the odd lines around them, of the same image, the one
    before and the one after. The two fields of a progressive image are of one moment: they differ less from each other
    than from those of both neighbours. Of an interlaced one, whichever field comes first, a field of one neighbour is
    as near in time as that of the same image. Fast motion makes combs: neighbouring lines differ more than every
    second one.

    Args:
        images: ``(H, W, 3)`` or ``(H, W)`` uint8, in order, neither turned nor resized; the first 16 are read.

    Returns:
        True for interlaced ones; False also where nothing moves.
    """
    totals = np.zeros(4)
    count = 0
    for sums in islice(_compared(islice(images, LOOKED_AT)), _TRIPLES):
        totals += sums
        count += 1
    if count < _FEWEST:
        return False
    same, before, after, second = totals.tolist()
    nearest, farthest = sorted((before, after))
    is_told = farthest > _FURTHER * same  # of noise all fields are as far apart
    return same > _ROUGH * second or (is_told and nearest - same < _NEAR * (farthest - same))


def _compared(images: Iterable[np.ndarray]) -> Iterator[tuple[float, float, float, float]]:
    """Sums of an image with motion: even lines against odd ones of the same, the last, the next; against even ones."""
    import cv2

    window: list[np.ndarray] = []
    for image in images:
        grey = (image if image.ndim == 2 else image[..., 1]).astype(np.float32)  # green is nearest to luminance
        grey = np.ascontiguousarray(grey[: len(grey) // 2 * 2, :: max(1, round(grey.shape[1] / _WIDTH))])
        if not 8 <= len(grey) <= _HIGHEST:
            return
        window = [*window, grey][-3:]
        if len(window) < 3 or len({part.shape for part in window}) > 1:
            continue
        last, this, following = window
        moved = [cv2.boxFilter(np.abs(part - this), -1, (9, 9))[2:-2:2] > _MOVED for part in (last, following)]
        if min(mask.mean() for mask in moved) < _SHARE:  # a repeated image, or the first that moves
            continue
        mask = moved[0] | moved[1]
        even = this[2:-2:2]
        odd = ((part[1:-3:2], part[3:-1:2]) for part in (this, last, following))
        sums = [float((np.abs(even - upper) + np.abs(even - lower))[mask].sum()) for upper, lower in odd]
        second = np.abs(even - this[:-4:2]) + np.abs(even - this[4::2])
        yield sums[0], sums[1], sums[2], float(second[mask].sum())
