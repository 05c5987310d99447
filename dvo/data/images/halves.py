"""Images that are more than one view: two of a stereo camera, side by side or one above the other, or all around."""

from __future__ import annotations

from pathlib import Path

import numpy as np

_SIZE = 48  # pixels of the longer side of a half
_ALIKE = 0.8  # least correlation of two halves that show the same
_BLACK = 16  # grey level of the bars of a letterbox, at most
_SHIFT = 0.15  # largest disparity, share of a half
_SEAM = 3.0  # difference between the first and the last column of an image all around, usual ones between neighbours
_FAR = 0.3  # the same, of the difference between columns that are far apart
_POLE = 0.5  # spread in the first and last row, of that in the middle
_HEAD = 2**17  # bytes of a file that may hold what it says of itself
FLAT = "make a flat view of it: ffmpeg -i {} -vf v360=e:flat:h_fov=90:v_fov=60 OUT{}"
"""Remedy for images that show all around: names of a file and of the end of another one."""


def two_views(image: np.ndarray) -> str | None:
    """Find out if the halves of an image show the same scene.

    Args:
        image: ``(H, W, 3)`` uint8.

    Returns:
        ``side by side`` or ``one above the other``; None for one view.
    """
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    lit = grey > _BLACK  # the bars of a letterbox are alike in any two halves
    grey = grey[lit.any(1)][:, lit.any(0)]
    height, width = (side // 2 * 2 for side in grey.shape)
    if min(height, width) < 32:
        return None
    pairs = {
        "side by side": (grey[:, : width // 2], grey[:, width // 2 : width]),
        "one above the other": (grey[: height // 2], grey[height // 2 : height]),
    }
    for name, halves in pairs.items():
        scale = _SIZE / max(halves[0].shape)
        size = max(16, round(halves[0].shape[1] * scale)), max(16, round(halves[0].shape[0] * scale))
        small = [cv2.resize(half, size, interpolation=cv2.INTER_AREA).astype(np.float32) for half in halves]
        # what is left without the light from above and below, which is alike in any two halves of a landscape
        left, right = (half - cv2.GaussianBlur(half, (0, 0), 4) for half in small)
        margin = round(_SHIFT * size[0])
        inner = left[:, margin : size[0] - margin]
        if inner.std() > 2 and cv2.matchTemplate(right, inner, cv2.TM_CCOEFF_NORMED).max() > _ALIKE:
            return name
    return None


def is_panorama(file: Path) -> bool:
    """True for an image file that says it shows all around (XMP, ``GPano:ProjectionType``).

    Args:
        file: of any format.
    """
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError:
        return False
    at = head.find(b"GPano:ProjectionType")
    return at >= 0 and b"equirectangular" in head[at : at + 60].lower()


def looks_all_around(image: np.ndarray) -> bool:
    """True for an image twice as wide as high whose right rim goes on at the left one, and whose poles are stretched.

    Args:
        image: ``(H, W, 3)`` uint8.
    """
    import cv2

    height, width = image.shape[:2]
    if width != 2 * height or height < 64:
        return False
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    grey = cv2.resize(grey, (256, 128), interpolation=cv2.INTER_AREA).astype(np.float32)
    near = float(np.abs(np.diff(grey, axis=1)).mean())
    far = float(np.abs(grey - np.roll(grey, 128, 1)).mean())
    seam = float(np.abs(grey[:, 0] - grey[:, -1]).mean())
    poles = float(max(grey[0].std(), grey[-1].std()))
    is_closed = seam < _SEAM * near and seam < _FAR * far and float(grey[:, 0].std()) > 8
    return is_closed and poles < _POLE * float(grey[32:96].std(axis=1).mean())
