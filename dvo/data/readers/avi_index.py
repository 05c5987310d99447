"""Indexes of AVI files that are not those of their frames: FFmpeg believes them, and leaves out or shuffles frames.

Both kinds are looked at: ``idx1`` at the end of the file, and ``indx`` of OpenDML (1996) at the head of each stream.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

_MOST_CHUNKS = 256
_LARGEST = 2**26  # bytes of an index
_LOOKED_AT = 64
_KINDS = (b"dc", b"db")  # of chunks of images, after the number of their stream


def is_misindexed(file: Path) -> bool:
    """True for an AVI whose index names images in another order than that in which they lie, or other places.

    Args:
        file: a video; False of another container, without an index, and of a file that is cut.
    """
    try:
        with file.open("rb") as stream:
            return any(_is_wrong(stream, places) for places in _indexes(stream))
    except (OSError, ValueError, OverflowError, struct.error):  # cut, or sizes that lead nowhere
        return False


def _is_wrong(stream: BinaryIO, places: list[tuple[bytes, int]]) -> bool:
    """True if the places of chunks do not increase, or if some of them hold no such chunk."""
    if any(later <= place for (_, place), (_, later) in pairwise(places)):
        return True
    some = sorted({round(k * (len(places) - 1) / (_LOOKED_AT - 1)) for k in range(_LOOKED_AT)}) if places else []
    return any(_read(stream, places[k][1], 4) != places[k][0] for k in some)


def _indexes(stream: BinaryIO) -> Iterator[list[tuple[bytes, int]]]:
    """Kind and place in the file of the chunks of images that an index names, of each index."""
    head = _read(stream, 0, 12)
    if head[:4] != b"RIFF" or head[8:] != b"AVI ":
        return
    movie = None
    for kind, at, length in _chunks(stream, 12, _size(stream)):
        if kind == b"LIST" and _read(stream, at, 4) == b"hdrl":
            for name, start, size in _chunks(stream, at + 4, at + length):
                if name == b"LIST" and _read(stream, start, 4) == b"strl":
                    parts = _chunks(stream, start + 4, start + size)
                    yield from (_of_stream(stream, *place) for part, *place in parts if part == b"indx")
        elif kind == b"LIST" and _read(stream, at, 4) == b"movi":
            movie = at
        elif kind == b"idx1" and movie is not None and length <= _LARGEST:
            entries = list(struct.iter_unpack("<4s3I", _read(stream, at, length // 16 * 16)))
            images = [(name, place) for name, _, place, size in entries if name[2:] in _KINDS and size]
            is_absolute = bool(images) and _read(stream, images[0][1], 4) == images[0][0]
            yield [(name, place if is_absolute else place + movie) for name, place in images]


def _of_stream(stream: BinaryIO, at: int, length: int) -> list[tuple[bytes, int]]:
    """Chunks of images that the index of a stream names, in the parts that it refers to."""
    _, _, kind, count, name = struct.unpack("<HBBI4s", _read(stream, at, 12))
    found: list[tuple[bytes, int]] = []
    if name[2:] not in _KINDS or kind != 0 or 24 + 16 * count > length:  # 0: an index of indexes
        return found
    for place, _, _ in struct.iter_unpack("<QII", _read(stream, at + 24, 16 * count)):
        _, _, kind, entries, name, base = struct.unpack("<HBBI4sQ", _read(stream, place + 8, 20))
        if kind == 1 and 8 * entries <= _LARGEST:
            parts = struct.iter_unpack("<II", _read(stream, place + 32, 8 * entries))
            found += [(name, base + start - 8) for start, size in parts if size & 0x7FFFFFFF]
    return found


def _chunks(stream: BinaryIO, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Kind, place of the content and its length of chunks that follow each other."""
    for _ in range(_MOST_CHUNKS):
        if at + 8 > end:
            return
        kind, length = struct.unpack("<4sI", _read(stream, at, 8))
        yield kind, at + 8, length
        at += 8 + length + length % 2


def _read(stream: BinaryIO, at: int, count: int) -> bytes:
    stream.seek(at)
    return stream.read(count)


def _size(stream: BinaryIO) -> int:
    return stream.seek(0, 2)
