"""Depth images: every encoding that the readers meet, to metres."""

from __future__ import annotations

import lzma
import zlib
from pathlib import Path
from typing import IO
from zipfile import BadZipFile, ZipFile

import numpy as np

from dvo.data.files import is_file
from dvo.data.image_header import MAX_PIXELS
from dvo.data.images import decode
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
        DvoError: an image of another encoding, of integers without ``scale``, or of more pixels than
            :data:`dvo.data.image_header.MAX_PIXELS`.
    """
    depth = _read_array(path) if path.suffix in (".npy", ".npz") else _read_image(path, scale)
    if depth is None:
        return None
    if depth.ndim != 2:
        raise DvoError(f"array of shape {depth.shape}", file=path, field="depth", remedy="give one depth a pixel")
    with np.errstate(over="ignore"):
        metres = depth.astype(np.float32)
    return np.where((metres > 0) & np.isfinite(metres), metres, np.float32(np.nan))


def _read_array(path: Path) -> np.ndarray | None:
    if not is_file(path):
        return None
    try:
        if path.suffix == ".npz":
            with ZipFile(path) as archive:
                if "depth.npy" not in archive.namelist():
                    raise DvoError("no array 'depth' in it", file=path, field="depth", remedy="name the array depth")
                with archive.open("depth.npy") as stream:
                    return _read_npy(stream, path)
        with path.open("rb") as stream:
            return _read_npy(stream, path)
    # damaged, encrypted (RuntimeError) or compressed by an unknown method (NotImplementedError)
    except (OSError, ValueError, EOFError, BadZipFile, RuntimeError, zlib.error, lzma.LZMAError):
        return None


def _read_npy(stream: IO[bytes], path: Path) -> np.ndarray | None:
    """Array of a ``.npy`` stream, its size taken from the header before; None if it is cut short."""
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, by_columns, dtype = read_header(stream)
    if not np.issubdtype(dtype, np.floating):
        raise DvoError(f"depth of type {dtype}", file=path, field="depth", remedy="store metres as float32")
    if len(shape) != 2:
        raise DvoError(f"array of shape {shape}", file=path, field="depth", remedy="give one depth a pixel")
    count = shape[0] * shape[1]
    if count > MAX_PIXELS:
        message = f"depth of {shape[1]}x{shape[0]} pixels, more than {MAX_PIXELS:,}"
        raise DvoError(message, file=path, field="depth", remedy="reduce the images")
    data = stream.read(count * dtype.itemsize)
    if len(data) < count * dtype.itemsize or not count:
        return None
    return np.frombuffer(data, dtype, count).reshape(shape, order="F" if by_columns else "C")


def _read_image(path: Path, scale: float | None) -> np.ndarray | None:
    raw = decode(path)
    if raw is None:
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
