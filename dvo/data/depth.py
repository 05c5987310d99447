"""Depth images: every encoding that the readers meet, to metres."""

from __future__ import annotations

import zlib
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from dvo.data.images import is_complete
from dvo.errors import DvoError


def read_depth(path: Path, scale: float | None = None) -> np.ndarray | None:
    """Read a depth image.

    The encoding follows from the file: ``.npy``, ``.npz`` (key ``depth``) and images of floats hold metres (TartanAir
    v1); 8-bit images of four channels hold the bytes of one little-endian float32 a pixel, metres (TartanAir v2);
    16-bit images hold integers of ``1 / scale`` metres (TUM RGB-D: 5000; most others write millimetres: 1000).

    Args:
        path: depth image.
        scale: units of a metre in an image of integers.

    Returns:
        ``(H, W)`` float32 metres, nan where the depth is not known: 0, negative, not finite, and the largest value of
        an integer type. None if the file is missing, corrupt or cut short.

    Raises:
        DvoError: an image of another encoding, or of integers without ``scale``.
    """
    depth = _read_array(path) if path.suffix in (".npy", ".npz") else _read_image(path, scale)
    if depth is None:
        return None
    if depth.ndim != 2:
        raise DvoError(f"array of shape {depth.shape}", file=path, field="depth", remedy="give one depth a pixel")
    return np.where((depth > 0) & np.isfinite(depth), depth, np.nan).astype(np.float32)


def _read_array(path: Path) -> np.ndarray | None:
    try:
        if path.suffix == ".npz":
            with np.load(path) as archive:
                depth = archive["depth"]
        else:
            depth = np.load(path)
    except KeyError:
        raise DvoError("no array 'depth' in it", file=path, field="depth", remedy="name the array depth") from None
    except (OSError, ValueError, EOFError, BadZipFile, zlib.error):
        return None
    if not np.issubdtype(depth.dtype, np.floating):
        raise DvoError(f"depth of type {depth.dtype}", file=path, field="depth", remedy="store metres as float32")
    return depth


def _read_image(path: Path, scale: float | None) -> np.ndarray | None:
    import cv2

    try:
        data = path.read_bytes()
    except OSError:
        return None
    if not is_complete(data):
        return None
    try:
        raw = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if raw is None or raw.size == 0:
        return None
    if raw.dtype == np.uint8 and raw.shape[2:] == (4,):
        return np.ascontiguousarray(raw).view("<f4")[..., 0]
    if raw.dtype == np.float32:
        return raw
    if raw.dtype != np.uint16:
        raise DvoError(
            f"pixels of type {raw.dtype} and shape {raw.shape} are no depth",
            file=path,
            field="depth",
            remedy="store 16-bit integers, or float32 metres",
        )
    if scale is None:
        raise DvoError(
            "integers without a unit",
            file=path,
            field="depth_scale",
            remedy="state the units of a metre (1000 for millimetres) in the calibration",
        )
    return np.where(raw == np.iinfo(np.uint16).max, 0.0, raw / scale)
