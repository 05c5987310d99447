"""Images and depth cropped and resampled to a wanted size, with the camera that belongs to the result."""

from __future__ import annotations

import numpy as np

from dvo.geometry.camera import Camera


def fit(image: np.ndarray, camera: Camera, width: int, height: int) -> tuple[np.ndarray, Camera]:
    """Cut the largest centred window of the wanted aspect and resample it by area.

    Args:
        image: ``(H, W, C)``.
        camera: camera of ``image``.
        width, height: wanted size in pixels.

    Returns:
        ``(height, width, C)`` image of the same type, and its camera.
    """
    import cv2

    scale = min(camera.width / width, camera.height / height)
    wide, high = min(round(width * scale), camera.width), min(round(height * scale), camera.height)
    left, top = (camera.width - wide) // 2, (camera.height - high) // 2
    window = image[top : top + high, left : left + wide]
    resized = cv2.resize(window, (width, height), interpolation=cv2.INTER_AREA)
    return resized, camera.cropped(left, top, wide, high).resized(width, height)


def fit_depth(depth: np.ndarray | None, camera: Camera, fitted: Camera) -> np.ndarray:
    """Depth as a camera of :func:`fit` sees it: that of the nearest pixel along each ray.

    Args:
        depth: ``(H, W)`` of ``camera``, any unit; None for none.
        camera: camera of the whole image.
        fitted: camera that :func:`fit` returned for it.

    Returns:
        ``(fitted.height, fitted.width)``, of the type of ``depth``; float32 nan without one.
    """
    if depth is None:
        return np.full((fitted.height, fitted.width), np.nan, np.float32)
    columns = (np.arange(fitted.width) - fitted.cx) / fitted.fx * camera.fx + camera.cx
    rows = (np.arange(fitted.height) - fitted.cy) / fitted.fy * camera.fy + camera.cy
    nearest = (np.clip(np.rint(x), 0, n - 1).astype(int) for x, n in zip((rows, columns), depth.shape, strict=True))
    return depth[np.ix_(*nearest)]
