"""Two views of a scene in one image, as stereo cameras record them side by side or one above the other."""

from __future__ import annotations

import numpy as np

_SIZE = 48  # pixels of the longer side of a half
_ALIKE = 0.8  # least correlation of two halves that show the same
_BLACK = 16  # grey level of the bars of a letterbox, at most
_SHIFT = 0.15  # largest disparity, share of a half


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
