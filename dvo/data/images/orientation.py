"""Images turned and mirrored as their EXIF data ask for, such as those of a phone that was held upright."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvo.data.files.files import is_file
from dvo.data.images import exif

MIRRORED = (
    "frames are mirrored, as the file asks for (front cameras do): if it holds what the camera saw, the path is that of"
    " a mirror image"
)
_LOOKED_AT = 9
_ZOOM = 1.02  # ratio of focal lengths above which the lens has zoomed; focusing changes them less
_MIRRORED = (2, 4, 5, 7)
_CLOCKWISE = {1: 0, 2: 0, 3: 180, 4: 180, 5: 270, 6: 90, 7: 90, 8: 270}  # after the mirroring


def common_orientation(images: list[Path], warnings: list[str]) -> int:
    """Orientation of the images of a recording.

    The data of all images are read only if the first, the middle or the last one is to be turned. Where they differ
    (the camera was turned while recording), images as stored have no jump between them and share one calibration.

    Args:
        images: files in order, at least one.
        warnings: receives a sentence if the images do not agree, or are mirrored.

    Returns:
        Orientation of EXIF, 1 to 8; 1 (as stored) if they do not agree.
    """
    some = {_orientation(images[index]) for index in (0, len(images) // 2, -1)}
    if some == {1}:
        return 1
    found = some if len(some) > 1 else {_orientation(image) for image in images}
    if len(found) == 1:
        warnings += [MIRRORED] * mirrors(min(found))
        return found.pop()
    warnings.append("the EXIF data of the images state different orientations: they are read as stored, not turned")
    return 1


def check_zoom(images: list[Path], warnings: list[str]) -> None:
    """Warn of images whose EXIF data state different focal lengths: they have no calibration in common.

    Args:
        images: files in order, at least one; some of them are looked at.
        warnings: receives a sentence.
    """
    some = sorted({round(k * (len(images) - 1) / (_LOOKED_AT - 1)) for k in range(_LOOKED_AT)})
    found = [focal for focal in (_focal(images[index]) for index in some) if focal is not None]
    if found and max(found) > _ZOOM * min(found):
        warnings.append(
            f"the EXIF data of the images state focal lengths from {min(found):g} to {max(found):g} mm: with zoom"
            " no calibration fits all of them; track each part without zooming (--start, --end)"
        )


def _focal(file: Path) -> float | None:
    return exif.focal_length(file) if is_file(file) else None


def _orientation(file: Path) -> int:
    return exif.orientation(file) if is_file(file) else 1


def turn(orientation: int) -> int:
    """Degrees clockwise by which images are turned, 0, 90, 180 or 270.

    Args:
        orientation: of EXIF, 1 to 8; mirrored ones are mirrored left to right before.
    """
    return _CLOCKWISE[orientation]


def mirrors(orientation: int) -> bool:
    """True for an orientation that shows images mirrored.

    Args:
        orientation: of EXIF, 1 to 8.
    """
    return orientation in _MIRRORED


def oriented(image: np.ndarray, orientation: int) -> np.ndarray:
    """Turn an image for display.

    Args:
        image: ``(H, W)`` or ``(H, W, C)`` as stored.
        orientation: of EXIF, 1 to 8.

    Returns:
        Image of the same type, ``(W, H)`` in size for the orientations 5 to 8.
    """
    import cv2

    image = cv2.flip(image, 1) if mirrors(orientation) else image
    turns = (cv2.ROTATE_90_CLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_COUNTERCLOCKWISE)
    return cv2.rotate(image, turns[turn(orientation) // 90 - 1]) if turn(orientation) else image
