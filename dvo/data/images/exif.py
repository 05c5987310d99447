"""Focal length and orientation that the EXIF data of a JPEG, PNG or WebP file state."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

_HEAD = 2**18  # bytes in which the EXIF segment begins and ends: it is at most 64 kB, and near the start
_MOST_CHUNKS = 4096
_EXIF_IFD, _FOCAL_35MM, _ORIENTATION, _FOCAL = 0x8769, 0xA405, 0x0112, 0x920A
_INTEGERS = {3: "H", 4: "I", 5: "I"}  # of a fraction the place


def equivalent_focal(file: Path) -> float | None:
    """Read the focal length for 35 mm film (EXIF 2.3, tag 0xA405), which fixes the angle of view.

    Args:
        file: an image.

    Returns:
        Millimetres, for a diagonal of 43.27 mm; None if the file does not state it or is of another format.
    """
    focal = _read(file, _focal)
    return float(focal) if focal else None  # 0 stands for unknown


def focal_length(file: Path) -> float | None:
    """Read the focal length of the lens (EXIF 2.3, tag 0x920A), which optical zoom changes.

    Args:
        file: an image.

    Returns:
        Millimetres; None if the file does not state it or is of another format.
    """

    def value(tiff: bytes, order: str, first: int) -> int | None:
        inner = _value(tiff, order, first, _EXIF_IFD)
        return None if inner is None else _value(tiff, order, inner, _FOCAL)

    found: list[float] = []

    def parts(tiff: bytes, order: str, first: int) -> int | None:
        at = value(tiff, order, first)
        if at is not None:
            above, below = struct.unpack_from(f"{order}II", tiff, at)
            found.extend([above / below] if below else [])
        return None

    _read(file, parts)
    return found[0] if found and found[0] > 0 else None


def orientation(file: Path) -> int:
    """Read how an image is turned for display (EXIF 2.3, tag 0x0112).

    Args:
        file: an image.

    Returns:
        1 (as stored) to 8; 1 if the file does not state it or is of another format.
    """
    found = _read(file, lambda tiff, order, first: _value(tiff, order, first, _ORIENTATION))
    return found if found is not None and 1 <= found <= 8 else 1


def _read(file: Path, value: Callable[[bytes, str, int], int | None]) -> int | None:
    """Value of a TIFF structure, its byte order and the offset of its first directory; None without one."""
    try:
        with file.open("rb") as stream:
            tiff = _structure(stream)
        order = {b"II": "<", b"MM": ">"}.get(b"" if tiff is None else tiff[:2])
        if tiff is None or order is None:
            return None
        return value(tiff, order, struct.unpack_from(f"{order}I", tiff, 4)[0])
    except (OSError, ValueError, struct.error):  # cut, or offsets that lead nowhere
        return None


def _structure(stream: BinaryIO) -> bytes | None:
    """TIFF structure of an image file."""
    head = stream.read(12)
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        return _chunk(stream, 8, ">I4s", b"eXIf")
    if head[:4] == b"RIFF" and head[8:] == b"WEBP":
        found = _chunk(stream, 12, "<4sI", b"EXIF")
        return None if found is None else found.removeprefix(b"Exif\0\0")
    return _segment(head + stream.read(_HEAD))


def _chunk(stream: BinaryIO, at: int, form: str, wanted: bytes) -> bytes | None:
    """Content of a chunk of a PNG or WebP file; the latter's have even lengths, the former's end in four bytes more."""
    for _ in range(_MOST_CHUNKS):
        stream.seek(at)
        head = stream.read(8)
        if len(head) < 8:
            return None
        one, other = struct.unpack(form, head)
        kind, length = (one, other) if isinstance(one, bytes) else (other, one)
        if kind == wanted:
            return stream.read(min(length, _HEAD))
        at += 8 + (length + length % 2 if form.startswith("<") else length + 4)
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


def _focal(tiff: bytes, order: str, first: int) -> int | None:
    inner = _value(tiff, order, first, _EXIF_IFD)
    return None if inner is None else _value(tiff, order, inner, _FOCAL_35MM)


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
