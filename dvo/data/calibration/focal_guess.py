"""Guess of the focal length of a camera without a calibration: from metadata, else from the usual angle of view.

Pixels are taken to be square, the principal point to be the centre of the image, and the lens to be free of distortion.
A guess holds for a portrait and a landscape image alike: it is made from the diagonal, or from the longer side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.data.calibration import quicktime
from dvo.data.calibration.calibration import Calibration
from dvo.data.images import exif

ANGLE = 64.0
"""Angle of view along the longer side that is assumed, degrees: phones, webcams and Kinects have 55 to 75."""
SPREAD = 0.25
"""Standard deviation of the logarithm of the focal length under this assumption."""
SPREAD_OF_METADATA = 0.1
"""The same for a focal length from metadata: stabilised video is cut out of the image that the metadata describe."""

_DIAGONAL = math.hypot(36.0, 24.0)  # of 35 mm film, millimetres
_MILLIMETRES = (4.0, 2000.0)  # shortest and longest focal length for 35 mm film that is believed


@dataclass(frozen=True)
class FocalGuess:
    """Focal length before anything is measured.

    Attributes:
        focal: fx and fy, pixels.
        deviation: standard deviation, pixels.
        source: ``prior`` (the usual angle of view), ``exif`` or ``video`` (metadata of an image or of a video), or
            ``given``.
        width, height: of the images, pixels.
    """

    focal: float
    deviation: float
    source: str
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (0 < self.focal < math.inf and 0 < self.deviation < math.inf):  # NaN fails too
            message = f"focal length {self.focal:g} +- {self.deviation:g}"
            raise DvoError(message, field="focal", remedy="give two positive numbers of pixels")

    @property
    def calibration(self) -> Calibration:
        """Intrinsics, with the principal point at the centre of the image."""
        return centred(self.focal, self.width, self.height)


def centred(focal: float, width: int, height: int) -> Calibration:
    """Calibration with square pixels, the principal point at the centre of the image, and no distortion.

    Args:
        focal: fx and fy, pixels.
        width, height: of the images, pixels.
    """
    return Calibration(focal, focal, (width - 1) / 2, (height - 1) / 2, width=width, height=height)


def guess_from_angle(width: int, height: int) -> FocalGuess:
    """Guess for the usual angle of view.

    Args:
        width, height: of the images, pixels.
    """
    focal = max(width, height) / 2 / math.tan(math.radians(ANGLE / 2))
    return FocalGuess(focal, SPREAD * focal, "prior", width, height)


def guess_from_metadata(millimetres: float | None, source: str, width: int, height: int) -> FocalGuess | None:
    """Guess from a focal length for 35 mm film, which relates to the diagonal of the image (CIPA DCG-001).

    Args:
        millimetres: as stated; None if nothing is.
        source: of it, ``exif`` or ``video``.
        width, height: of the images, pixels.

    Returns:
        The guess; None without a believable number.
    """
    if millimetres is None or not _MILLIMETRES[0] <= millimetres <= _MILLIMETRES[1]:  # NaN fails too
        return None
    focal = millimetres / _DIAGONAL * math.hypot(width, height)
    return FocalGuess(focal, SPREAD_OF_METADATA * focal, source, width, height)


def guess_focal(file: Path, width: int, height: int) -> FocalGuess:
    """Guess the focal length of the camera that has recorded a file.

    Args:
        file: video, or one of the images.
        width, height: of the images, pixels.

    Returns:
        From the metadata of the file if they state the focal length, else from the usual angle of view.
    """
    for read, source in ((exif.equivalent_focal, "exif"), (quicktime.equivalent_focal, "video")):
        found = guess_from_metadata(read(file), source, width, height)
        if found is not None:
            return found
    return guess_from_angle(width, height)
