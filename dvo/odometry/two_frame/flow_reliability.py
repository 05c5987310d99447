"""Reliability of the flow between two images, from the images alone.

Where an image has no texture, a network completes the flow from what is around it; the result is smooth, and wrong in
the same way over large parts of the image, so that no robust cost finds it out. Each pixel of a flow is weighted by the
smaller eigenvalue of the structure tensor around it (Shi and Tomasi, CVPR 1994), against a constant and against the
squared difference of the two images along the flow: their quotient is the squared displacement that the difference
stands for (Lucas and Kanade, IJCAI 1981).
"""

from __future__ import annotations

import cv2
import numpy as np

# Chosen on rendered sequences of families that no suite has, and on tartanair_v1_60 (validation).
_SPAN = 16  # side of the square that is averaged over, pixels of the image
_TEXTURE = 8.0  # eigenvalue at which a pixel counts half, squared grey levels per squared pixel
_DIFFERENCE = 0.5  # squared pixels; weight of the difference beside the eigenvalue
_LOCAL = 4.0  # standard deviation of the mean that is taken off, pixels: changes of exposure make no difference
_BEYOND = 50.0  # grey levels by which a pixel differs from one beyond the edge
_MIN_WEIGHT = 1e-3


def flow_weights(image_a: np.ndarray, image_b: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Weight the pixels of a flow by the texture around them and the likeness of the images along it.

    Args:
        image_a, image_b: ``(H, W, 3)`` uint8 RGB.
        flow: ``(2, h, w)`` from ``a`` to ``b``, pixels of a map that covers the image.

    Returns:
        ``(h, w)`` float64 in (0, 1]; the least where the flow is not finite.

    Example:
        >>> weights = flow_weights(before, after, flow)
        >>> pose_ab = refine_motion(torch.from_numpy(flow), [start], intrinsics, weights=torch.from_numpy(weights))
    """
    _, h, w = flow.shape
    height, width = image_a.shape[:2]
    a, b = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (image_a, image_b))
    gx, gy = (cv2.Sobel(a, cv2.CV_32F, *axes, ksize=3, scale=1 / 8) for axes in ((1, 0), (0, 1)))
    xx, yy, xy = (cv2.blur(product, (_SPAN, _SPAN)) for product in (gx * gx, gy * gy, gx * gy))
    texture = np.maximum((xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy * xy), 0)
    factors = np.array([width / w, height / h], np.float32)
    finite = np.isfinite(flow).all(0)
    pixels = cv2.resize(np.where(finite, flow, 0).astype(np.float32).transpose(1, 2, 0) * factors, (width, height))
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    a, b = (grey - cv2.GaussianBlur(grey, (0, 0), _LOCAL) for grey in (a, b))
    moved = cv2.remap(b, columns + pixels[..., 0], rows + pixels[..., 1], cv2.INTER_LINEAR, borderValue=_BEYOND)
    difference = cv2.blur((a - moved) ** 2, (_SPAN, _SPAN))
    weights = texture / (texture + _TEXTURE + _DIFFERENCE * difference)
    weights = cv2.resize(weights.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA).astype(np.float64)
    return np.where(finite, np.clip(weights, _MIN_WEIGHT, 1), _MIN_WEIGHT)
