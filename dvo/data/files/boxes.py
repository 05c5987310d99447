"""Boxes of QuickTime and MP4 containers (ISO/IEC 14496-12, 4.2): a length, a kind of four letters, and content."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO


def read_head(stream: BinaryIO, at: int, end: int) -> tuple[bytes, int, int] | None:
    """Read the head of a box, and leave the stream at its content.

    Args:
        stream: of the file.
        at: where the box begins.
        end: of the box that it stands in, or of the file.

    Returns:
        Kind, bytes of the head, and bytes of the whole box; None for a length that leads nowhere.

    Raises:
        struct.error: the file ends within the head.
    """
    stream.seek(at)
    length, kind = struct.unpack(">I4s", stream.read(8))
    head = 8
    if length == 1:  # the length follows in 64 bits
        (length,) = struct.unpack(">Q", stream.read(8))
        head = 16
    length = end - at if length == 0 else length
    return (kind, head, length) if head <= length <= end - at else None


def boxes(data: bytes, at: int = 0) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of boxes that follow each other.

    Args:
        data: that they stand in.
        at: where the first begins.
    """
    while at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if not 8 <= length <= len(data) - at:
            return
        yield kind, data[at + 8 : at + length]
        at += length
