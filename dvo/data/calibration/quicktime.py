"""Focal length that the metadata of a video in a QuickTime or MP4 container state."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from dvo.data.files.boxes import boxes, read_head

_KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
_CONTAINERS = (b"moov", b"trak", b"udta")
_MOST_BOXES = 4096
_MOST_BYTES = 2**20  # of metadata
_NUMBERS = {(21, 1): ">b", (21, 2): ">h", (21, 4): ">i", (22, 1): ">B", (22, 2): ">H", (22, 4): ">I",
            (23, 4): ">f", (24, 8): ">d"}  # fmt: skip
_TEXT = 1


def equivalent_focal(file: Path) -> float | None:
    """Read the focal length for 35 mm film that cameras of Apple write into videos, for the file or for a track.

    Args:
        file: a video.

    Returns:
        Millimetres, for a diagonal of 43.27 mm; None if the file does not state it or is of another container.
    """
    try:
        with file.open("rb") as stream:
            if stream.read(8)[4:] not in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
                return None
            for data in _metadata(stream, file.stat().st_size):
                found = _number(data)
                if found is not None:
                    return found
    except (OSError, ValueError, OverflowError, struct.error):  # cut, or sizes that lead nowhere
        return None
    return None


def _metadata(stream: BinaryIO, size: int) -> Iterator[bytes]:
    """Contents of the boxes of metadata, from the beginning of the file on."""
    ranges = [(0, size)]
    for _ in range(_MOST_BOXES):
        while ranges and ranges[-1][0] + 8 > ranges[-1][1]:
            ranges.pop()
        if not ranges:
            return
        at, end = ranges.pop()
        found = read_head(stream, at, end)
        if found is None:
            return
        kind, head, length = found
        ranges.append((at + length, end))
        if kind in _CONTAINERS:
            ranges.append((at + head, at + length))
        elif kind == b"meta" and length <= _MOST_BYTES:
            yield stream.read(length - head)


def _number(meta: bytes) -> float | None:
    """Number of the key in a box of metadata; those of MP4 begin with a version, those of QuickTime do not."""
    parts = dict(boxes(meta, 0 if meta[4:8] == b"hdlr" else 4))
    keys = [name for _, name in boxes(parts.get(b"keys", b""), 8)]
    for index, item in boxes(parts.get(b"ilst", b"")):
        (position,) = struct.unpack(">I", index)
        if 1 <= position <= len(keys) and keys[position - 1] == _KEY:
            data = dict(boxes(item)).get(b"data", b"")
            (kind,) = struct.unpack_from(">I", data)
            return _decoded(kind, data[8:])
    return None


def _decoded(kind: int, value: bytes) -> float | None:
    if kind == _TEXT:
        return float(value.decode("ascii"))
    form = _NUMBERS.get((kind, len(value)))
    return None if form is None else float(struct.unpack(form, value)[0])
