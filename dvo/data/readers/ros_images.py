"""Images in messages of ROS: ``sensor_msgs/Image`` and ``sensor_msgs/CompressedImage``."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.images.image_header import MAX_PIXELS
from dvo.data.images.images import decode_bytes, to_rgb8

_CHANNELS = {
    "mono8": 1, "8uc1": 1, "rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4, "8uc4": 4,
    "mono16": 1, "16uc1": 1, "rgb16": 3, "bgr16": 3, "16uc3": 3, "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2,
}  # fmt: skip
_BAYER = re.compile(r"bayer_(rggb|bggr|gbrg|grbg)(8|16)")


def decode_message(message: Any, name: str) -> np.ndarray | None:
    """Decode an image.

    Args:
        message: deserialised; of any endianness, with or without padding of the rows.
        name: of the image, for messages.

    Returns:
        ``(H, W, 3)`` uint8 RGB, 16 bit divided by 257; None if the data is damaged or too short.

    Raises:
        DvoError: an encoding without brightness or colours, such as depth in float, or too large an image.
    """
    if not hasattr(message, "encoding"):
        image = decode_bytes(np.asarray(message.data).tobytes(), name)
        return None if image is None else to_rgb8(image)
    encoding, height, width = message.encoding.lower(), int(message.height), int(message.width)
    bayer = _BAYER.fullmatch(encoding)
    channels = 1 if bayer else _CHANNELS.get(encoding)
    if channels is None:
        remedy = "record mono8, rgb8, bgr8, mono16, a Bayer pattern, or YUV 4:2:2; or give another --topic"
        raise DvoError(f"images of the encoding {encoding[:40]!r}", file=name, remedy=remedy)
    if height * width > MAX_PIXELS:
        problem = f"image of {width}x{height} pixels, more than {MAX_PIXELS:,}"
        raise DvoError(problem, file=name, remedy="reduce the images")
    pixels = _pixels(message, height, width, channels, 2 if "16" in encoding else 1)
    return None if pixels is None else _rgb8(pixels, encoding, bayer)


def _pixels(message: Any, height: int, width: int, channels: int, size: int) -> np.ndarray | None:
    """``(H, W, C)`` uint8 or uint16 of this machine's byte order."""
    data, row = np.asarray(message.data, dtype=np.uint8), width * channels * size
    step = int(message.step) or row
    if step < row or not row or len(data) < step * (height - 1) + row or height < 1:
        return None
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step * data.strides[0], data.strides[0]))
    order = ">" if message.is_bigendian else "<"
    typed = np.ascontiguousarray(rows).view(f"{order}u{size}").reshape(height, width, channels)
    return typed.astype(np.uint16 if size == 2 else np.uint8, copy=False)


def _rgb8(pixels: np.ndarray, encoding: str, bayer: re.Match[str] | None) -> np.ndarray:
    import cv2

    if bayer:
        code = getattr(cv2, f"COLOR_Bayer{bayer[1].upper()}2BGR")
        return to_rgb8(cv2.cvtColor(pixels, code))
    if pixels.shape[2] == 2:
        is_uyvy = encoding in ("yuv422", "uyvy")
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_YUV2RGB_UYVY if is_uyvy else cv2.COLOR_YUV2RGB_YUYV))
    if encoding.startswith("rgb"):
        pixels = pixels[..., 2::-1]
    return to_rgb8(pixels)
