"""Depth images: every encoding that the readers meet, to metres."""

from __future__ import annotations

import lzma
import zlib
from pathlib import Path
from typing import IO
from zipfile import BadZipFile, ZipFile

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration
from dvo.data.files.files import is_file
from dvo.data.images.image_header import MAX_PIXELS
from dvo.data.images.images import decode
from dvo.geometry.camera import Camera

_ASPECT = (
    0.02  # relative difference of the aspects of a depth image and its image up to which one is the other, resized
)


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
            :data:`dvo.data.images.image_header.MAX_PIXELS`.
    """
    depth = _read_array(path) if path.suffix in (".npy", ".npz") else _read_image(path, scale)
    if depth is None:
        return None
    if depth.ndim != 2:
        raise DvoError(f"array of shape {depth.shape}", file=path, field="depth", remedy="give one depth a pixel")
    with np.errstate(over="ignore"):
        metres = depth.astype(np.float32)
    return np.where((metres > 0) & np.isfinite(metres), metres, np.float32(np.nan))


def resized_depth(depth: np.ndarray, size: tuple[int, int], origin: str) -> np.ndarray:
    """Resize a depth image to the nearest pixel, where it is registered to an image of another size.

    Args:
        depth: ``(h, w)`` metres.
        size: width and height of the image.
        origin: of the image, for messages.

    Returns:
        ``(H, W)`` metres.

    Raises:
        DvoError: another aspect.
    """
    height, width = depth.shape
    if (width, height) == size:
        return depth
    if abs(width * size[1] / (height * size[0]) - 1) > _ASPECT:
        message = f"the depth image is {width}x{height}, the image {size[0]}x{size[1]}, of another aspect"
        raise DvoError(message, file=origin, field="depth", remedy="register the depth to the images")
    x = ((np.arange(size[0]) + 0.5) * width / size[0]).astype(int)
    y = ((np.arange(size[1]) + 0.5) * height / size[1]).astype(int)
    return depth[y[:, None], x]


def registered_depth(depth: np.ndarray, calibration: Calibration, camera: Camera) -> np.ndarray:
    """Resample a depth image to another camera with the same centre and axes, to the nearest pixel.

    Args:
        depth: ``(h, w)`` metres.
        calibration: of the depth camera.
        camera: of the image, without distortion.

    Returns:
        ``(H, W)`` metres, nan where the depth camera does not see.

    Raises:
        DvoError: a camera with lens distortion.
    """
    height, width = depth.shape
    if camera.model != "none" or calibration.model != "none":
        message = "depth can be registered between cameras without distortion only"
        raise DvoError(message, field="depth", remedy="undistort images and depth, or give registered depth")
    other = calibration.camera(width, height)
    x = np.rint((np.arange(camera.width) - camera.cx) / camera.fx * other.fx + other.cx).astype(int)
    y = np.rint((np.arange(camera.height) - camera.cy) / camera.fy * other.fy + other.cy).astype(int)
    found = depth[y.clip(0, height - 1)[:, None], x.clip(0, width - 1)].astype(np.float32)
    found[(y < 0) | (y >= height)] = np.nan
    found[:, (x < 0) | (x >= width)] = np.nan
    return found


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
