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
_LETTERS = {1: "u", 2: "u", 4: "f"}
_BAYER = re.compile(r"bayer_(rggb|bggr|gbrg|grbg)(8|16)")


def decode_message(message: Any, name: str, bits: int = 16) -> np.ndarray | None:
    """Decode an image.

    Args:
        message: deserialised; of any endianness, with or without padding of the rows.
        name: of the image, for messages.
        bits: that pixels of 16 bits use, see :func:`dvo.data.images.images.used_bits`.

    Returns:
        ``(H, W, 3)`` uint8 RGB, 16 bit divided by 257; None if the data is damaged or too short.

    Raises:
        DvoError: an encoding without brightness or colours, such as depth in float, or too large an image.
    """
    if not hasattr(message, "encoding"):
        image = decode_bytes(np.asarray(message.data).tobytes(), name)
        return None if image is None else to_rgb8(image, bits)
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
    return None if pixels is None else _rgb8(pixels, encoding, bayer, bits)


def raw_levels(message: Any, name: str) -> np.ndarray | None:
    """Pixels of 16 bits of a message, to find out how many bits they use.

    Args:
        message: deserialised image.
        name: of it, for messages.

    Returns:
        uint16; None for an image of another kind, or a damaged one.
    """
    if not hasattr(message, "encoding"):
        return decode_bytes(np.asarray(message.data).tobytes(), name)
    encoding = message.encoding.lower()
    channels = 1 if _BAYER.fullmatch(encoding) else _CHANNELS.get(encoding)
    if "16" not in encoding or channels is None:
        return None
    return _pixels(message, int(message.height), int(message.width), channels, 2)


def decode_depth(message: Any, name: str, scale: float) -> np.ndarray | None:
    """Decode a depth image: ``16UC1`` in units, ``32FC1`` in metres, or one of ``compressedDepth``.

    Args:
        message: deserialised ``sensor_msgs/Image`` or ``CompressedImage``.
        name: of the image, for messages.
        scale: units of a metre of integers.

    Returns:
        ``(H, W)`` float32 metres, nan where it is not known; None if the data is damaged or too short.

    Raises:
        DvoError: an encoding that is no depth, or too large an image.
    """
    if not hasattr(message, "encoding"):
        raw = _compressed_depth(message, name)
    else:
        encoding, height, width = message.encoding.lower(), int(message.height), int(message.width)
        if encoding not in ("16uc1", "mono16", "32fc1"):
            remedy = "give a topic of 16UC1 or 32FC1"
            raise DvoError(f"depth of the encoding {encoding[:40]!r}", file=name, field="--depth", remedy=remedy)
        if height * width > MAX_PIXELS:
            problem = f"image of {width}x{height} pixels, more than {MAX_PIXELS:,}"
            raise DvoError(problem, file=name, remedy="reduce the images")
        raw = _pixels(message, height, width, 1, 4 if encoding == "32fc1" else 2)
        raw = None if raw is None else raw[..., 0]
    if raw is None or raw.ndim != 2:
        return None
    metres = raw.astype(np.float32)
    if raw.dtype == np.uint16:
        metres = np.where(raw == np.iinfo(np.uint16).max, 0, metres / np.float32(scale))
    return np.where((metres > 0) & np.isfinite(metres), metres, np.float32(np.nan)).astype(np.float32)


def _compressed_depth(message: Any, name: str) -> np.ndarray | None:
    """Integers, or float metres of inverse depths that were quantised; 12 bytes stand before the PNG file."""
    data = np.asarray(message.data).tobytes()
    if data.startswith(b"\x89PNG"):
        return decode_bytes(data, name)
    image = decode_bytes(data[12:], name)
    if image is None or "32fc1" not in str(message.format).lower():
        return image
    a, b = np.frombuffer(data[4:12], "<f4")
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(image > 0, a / (image.astype(np.float32) - b), np.float32(0))


def _pixels(message: Any, height: int, width: int, channels: int, size: int) -> np.ndarray | None:
    """``(H, W, C)`` uint8, uint16 or, of four bytes, float32, of this machine's byte order."""
    data, row = np.asarray(message.data, dtype=np.uint8), width * channels * size
    step = int(message.step) or row
    if step < row or not row or len(data) < step * (height - 1) + row or height < 1:
        return None
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step * data.strides[0], data.strides[0]))
    order = ">" if message.is_bigendian else "<"
    typed = np.ascontiguousarray(rows).view(f"{order}{_LETTERS[size]}{size}").reshape(height, width, channels)
    return typed.astype({1: np.uint8, 2: np.uint16, 4: np.float32}[size], copy=False)


def _rgb8(pixels: np.ndarray, encoding: str, bayer: re.Match[str] | None, bits: int) -> np.ndarray:
    import cv2

    if bayer:
        code = getattr(cv2, f"COLOR_Bayer{bayer[1].upper()}2BGR")
        return to_rgb8(cv2.cvtColor(pixels, code), bits)
    if pixels.shape[2] == 2:
        is_uyvy = encoding in ("yuv422", "uyvy")
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_YUV2RGB_UYVY if is_uyvy else cv2.COLOR_YUV2RGB_YUYV))
    if encoding.startswith("rgb"):
        pixels = pixels[..., 2::-1]
    return to_rgb8(pixels, bits)
