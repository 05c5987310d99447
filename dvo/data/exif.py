"""Focal length that the EXIF data of a JPEG file state."""

from __future__ import annotations

import io
import struct
from pathlib import Path

_HEAD = 2**18  # bytes in which the EXIF segment begins and ends: it is at most 64 kB, and near the start
_EXIF_IFD, _FOCAL_35MM = 0x8769, 0xA405
_INTEGERS = {3: "H", 4: "I"}


def equivalent_focal(file: Path) -> float | None:
    """Read the focal length for 35 mm film (EXIF 2.3, tag 0xA405), which fixes the angle of view.

    Args:
        file: an image.

    Returns:
        Millimetres, for a diagonal of 43.27 mm; None if the file does not state it or is no JPEG.
    """
    try:
        with file.open("rb") as stream:
            data = stream.read(_HEAD)
        exif = _segment(data)
        return None if exif is None else _focal(exif)
    except (OSError, ValueError, struct.error):  # cut, or offsets that lead nowhere
        return None


def _segment(data: bytes) -> bytes | None:
    """TIFF structure in the EXIF segment of a JPEG file."""
    if not data.startswith(b"\xff\xd8"):
        return None
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] not in (0xD9, 0xDA):
        if data[at + 1] == 0xFF:  # padding
            at += 1
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return data[at + 10 : at + 2 + length]
        at += 2 + max(length, 2)
    return None


def _focal(tiff: bytes) -> float | None:
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return None
    (first,) = struct.unpack_from(f"{order}I", tiff, 4)
    inner = _value(tiff, order, first, _EXIF_IFD)
    millimetres = None if inner is None else _value(tiff, order, inner, _FOCAL_35MM)
    return float(millimetres) if millimetres else None  # 0 stands for unknown


def _value(tiff: bytes, order: str, at: int, wanted: int) -> int | None:
    """Integer of a tag in the directory at an offset."""
    stream = io.BytesIO(tiff)
    stream.seek(at)
    (count,) = struct.unpack(f"{order}H", stream.read(2))
    for _ in range(count):
        row = stream.read(12)
        tag, kind = struct.unpack_from(f"{order}HH", row)
        if tag == wanted:
            return int(struct.unpack_from(f"{order}{_INTEGERS[kind]}", row, 8)[0]) if kind in _INTEGERS else None
    return None
