"""Images whose lines alternate: interlaced ones, of two moments half a frame apart, and mosaics of colours."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

import numpy as np

DEINTERLACE = "deinterlace the video: ffmpeg -i VIDEO -vf bwdif OUT.mp4"
INTERLACED = (
    f"the images are interlaced, their even and odd lines of two moments: if they are of a video, {DEINTERLACE}"
)
INTERLACED_STREAM = (
    "the images are interlaced, their even and odd lines of two moments: set the camera or its converter to "
    "progressive images, or deinterlace them (ffmpeg -i ADDRESS -vf bwdif -f image2pipe - | dvo run -)"
)
MOSAIC = (
    "the images look like the mosaic of a sensor, each pixel of one colour (Bayer): convert them to colour before"
    " (cv2.cvtColor with a code such as COLOR_BayerRG2BGR, image_proc of ROS)"
)
LOOKED_AT = 16  # images
_TRIPLES = 8  # of images with motion, that suffice
_FEWEST = 3
_MOVED = 6.0  # grey levels
_SHARE = 0.005  # least share of pixels that have moved
_HIGHEST = 1088  # lines; formats with more know no fields
_WIDTH = 640  # columns that are looked at, about
_ROUGH = 1.1  # differences of neighbouring lines over those of every second line; 0.5 for a slope, 1 for noise
_ALTERNATES = 1.15  # as much, of a mosaic; 1 for noise
_FURTHER = 1.1  # differences to the farthest field over those within an image, at least
_NEAR = 0.6  # place of the nearest field beside those of the same image, from 0 (as near) to 1 (as far as any)


def is_mosaic(image: np.ndarray) -> bool:
    """True for the raw image of a colour sensor: neighbours differ more than every second pixel, in rows and columns.

    Args:
        image: ``(H, W, 3)`` or ``(H, W)`` uint8. Of images with channels that differ the answer is no, and so it is of
            scenes without colours, whose mosaic is a grey image.
    """
    grey = image.reshape(*image.shape[:2], -1)
    if min(grey.shape[:2]) < 8 or (grey[..., :1] != grey).any():
        return False
    values = grey[..., 0].astype(np.float32)
    return all(
        np.abs(part[1:] - part[:-1]).mean() > _ALTERNATES * max(np.abs(part[2:] - part[:-2]).mean(), 1e-3)
        for part in (values, values.T)
    )


class FieldTest:
    """Looks at images as they come and tells if they are interlaced.

    Among the pixels that move, even lines are compared with the odd lines around them, of the same image, the one
    before and the one after. The two fields of a progressive image are of one moment: they differ less from each other
    than from those of both neighbours. Of an interlaced one, whichever field comes first, a field of one neighbour is
    as near in time as that of the same image. Fast motion makes combs: neighbouring lines differ more than every
    second one.
    """

    def __init__(self) -> None:
        self._window: list[np.ndarray] = []
        self._totals = np.zeros(4)
        self._triples = self._seen = 0

    @property
    def is_done(self) -> bool:
        """True if no more images need to be looked at."""
        return self._seen >= LOOKED_AT or self._triples >= _TRIPLES

    def look(self, image: np.ndarray) -> None:
        """Look at the next image.

        Args:
            image: ``(H, W, 3)`` or ``(H, W)`` uint8, neither turned nor resized.
        """
        if self.is_done:
            return
        self._seen += 1
        grey = (image if image.ndim == 2 else image[..., 1]).astype(np.float32)  # green is nearest to luminance
        grey = np.ascontiguousarray(grey[: len(grey) // 2 * 2, :: max(1, round(grey.shape[1] / _WIDTH))])
        if not 8 <= len(grey) <= _HIGHEST:
            self._seen = LOOKED_AT
            return
        self._window = [*self._window, grey][-3:]
        if len(self._window) < 3 or len({part.shape for part in self._window}) > 1:
            return
        sums = _compared(*self._window)
        if sums is not None:
            self._totals += sums
            self._triples += 1

    def skip(self) -> None:
        """Images were left out: those before them are compared with none behind them."""
        self._window = []

    @property
    def is_interlaced(self) -> bool:
        """True for interlaced images; False also where nothing has moved yet."""
        if self._triples < _FEWEST:
            return False
        same, before, after, second = self._totals.tolist()
        nearest, farthest = sorted((before, after))
        is_told = farthest > _FURTHER * same  # of noise all fields are as far apart
        return same > _ROUGH * second or (is_told and nearest - same < _NEAR * (farthest - same))


def are_interlaced(images: Iterable[np.ndarray]) -> bool:
    """Find out if images that follow each other are interlaced, see :class:`FieldTest`.

    Args:
        images: in order; the first 16 at most are read.

    Returns:
        True for interlaced ones; False also where nothing moves.
    """
    test = FieldTest()
    for image in islice(images, LOOKED_AT):
        test.look(image)
        if test.is_done:
            break
    return test.is_interlaced


def _compared(last: np.ndarray, this: np.ndarray, following: np.ndarray) -> tuple[float, float, float, float] | None:
    """Sums of an image with motion: even lines against odd ones of the same, the last, the next; against even ones."""
    import cv2

    moved = [cv2.boxFilter(np.abs(part - this), -1, (9, 9))[2:-2:2] > _MOVED for part in (last, following)]
    if min(mask.mean() for mask in moved) < _SHARE:  # a repeated image, or the first that moves
        return None
    mask = moved[0] | moved[1]
    even = this[2:-2:2]
    odd = ((part[1:-3:2], part[3:-1:2]) for part in (this, last, following))
    sums = [float((np.abs(even - upper) + np.abs(even - lower))[mask].sum()) for upper, lower in odd]
    second = np.abs(even - this[:-4:2]) + np.abs(even - this[4::2])
    return sums[0], sums[1], sums[2], float(second[mask].sum())
