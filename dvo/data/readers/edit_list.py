"""How a video in a QuickTime or MP4 container is shown: the part of it that is left after trimming, and mirroring."""

from __future__ import annotations

import struct
from pathlib import Path

from dvo.data.files.boxes import boxes, read_head

_LARGEST = 2**26  # bytes of the index of a video
_MOST_BOXES = 256


def shown_seconds(file: Path) -> float | None:
    """Duration that is shown of a video; phones and ffmpeg trim without removing the frames before.

    Args:
        file: a video.

    Returns:
        Seconds; None of another container, or without an edit list.
    """
    try:
        index = _index(file)
        if index is None:
            return None
        scale = 0
        for kind, box in boxes(index):
            if kind == b"mvhd":
                scale = struct.unpack_from(">I", box, 20 if box[0] else 12)[0]
        for kind, track in boxes(index):
            if kind == b"trak" and _is_video(track) and scale:
                edits = dict(boxes(dict(boxes(track)).get(b"edts", b""))).get(b"elst")
                return None if edits is None else _length(edits) / scale
    except (OSError, ValueError, IndexError, struct.error):  # cut, or sizes that lead nowhere
        return None
    return None


def is_mirrored(file: Path) -> bool:
    """True for a video whose frames the matrix of its track mirrors, as some front cameras write it.

    Args:
        file: a video; False of another container.
    """
    try:
        tracks = (track for kind, track in boxes(_index(file) or b"") if kind == b"trak" and _is_video(track))
        head = next((dict(boxes(track)).get(b"tkhd", b"") for track in tracks), b"")
        a, b, _, c, d = struct.unpack_from(">5i", head, 52 if head[0] else 40)
    except (OSError, ValueError, IndexError, struct.error):
        return False
    return a * d - b * c < 0


def _index(file: Path) -> bytes | None:
    """Content of the box ``moov``."""
    with file.open("rb") as stream:
        size, at = file.stat().st_size, 0
        for _ in range(_MOST_BOXES):
            if at + 8 > size:
                return None
            found = read_head(stream, at, size)
            if found is None or (at == 0 and not found[0].isalpha()):
                return None
            kind, head, length = found
            if kind == b"moov":
                return stream.read(length - head) if length <= _LARGEST else None
            at += length
    return None


def _is_video(track: bytes) -> bool:
    media = dict(boxes(dict(boxes(track)).get(b"mdia", b"")))
    return media.get(b"hdlr", b"")[8:12] == b"vide"


def _length(edits: bytes) -> int:
    """Units of the whole video that an edit list shows; pauses do not count."""
    form, total = (">Qq" if edits[0] else ">Ii"), 0
    (count,) = struct.unpack_from(">I", edits, 4)
    step = struct.calcsize(form) + 4
    for k in range(min(count, 2**16)):
        length, start = struct.unpack_from(form, edits, 8 + k * step)
        total += length if start >= 0 else 0
    return total
