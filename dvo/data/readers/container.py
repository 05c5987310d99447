"""How the container of a video asks to show it: the part that is left after trimming, turned and mirrored frames.

QuickTime and MP4 (ISO/IEC 14496-12) and Matroska and WebM (RFC 9559) are read.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path

from dvo.data.files.boxes import boxes, read_head

_LARGEST = 2**26  # bytes of the index of a video
_MOST_BOXES = 256
_UPRIGHT = (1, 0, 0, 1)
_ORIENTATIONS = {
    _UPRIGHT: 1, (-1, 0, 0, 1): 2, (-1, 0, 0, -1): 3, (1, 0, 0, -1): 4, (0, 1, 1, 0): 5, (0, 1, -1, 0): 6,
    (0, -1, -1, 0): 7, (0, -1, 1, 0): 8,
}  # fmt: skip
"""EXIF's number of ``x' = a x + c y, y' = b x + d y`` by the signs of ``a b c d``."""
_BY_ROLL = {False: (1, 8, 3, 6), True: (2, 5, 4, 7)}  # EXIF's number by mirroring and quarter turns counter-clockwise
_HEAD = 2**20  # bytes in which the tracks of a Matroska file are looked for
_MATROSKA = b"\x1a\x45\xdf\xa3"
_SEGMENT, _TRACKS, _TRACK, _TRACK_TYPE, _VIDEO = 0x18538067, 0x1654AE6B, 0xAE, 0x83, 0xE0
_PROJECTION, _PROJECTION_TYPE, _YAW, _PITCH, _ROLL = 0x7670, 0x7671, 0x7673, 0x7674, 0x7675
_SPHERICAL_VIDEO = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")  # of the XML of Google's first version
_SAMPLE_ENTRY = 78  # bytes before the boxes of an entry of images
_DAMAGED = (OSError, ValueError, IndexError, KeyError, OverflowError, struct.error)  # cut, or sizes that lead nowhere


def shown_seconds(file: Path) -> float | None:
    """Duration that is shown of a video; phones and ffmpeg trim without removing the frames before.

    Args:
        file: a video.

    Returns:
        Seconds; None of another container than QuickTime's, or without an edit list.
    """
    try:
        edits = dict(boxes(dict(boxes(_video_track(file))).get(b"edts", b""))).get(b"elst")
        head = dict(boxes(_index(file) or b"")).get(b"mvhd", b"")
        scale = struct.unpack_from(">I", head, 20 if head[0] else 12)[0]
        return _length(edits) / scale if edits is not None and scale else None
    except _DAMAGED:
        return None


def orientation(file: Path) -> int | None:
    """Orientation of the frames of a video, as EXIF counts (:func:`dvo.data.images.orientation.oriented`).

    OpenCV turns frames by the angle of the matrix, and by a wrong one if that mirrors them too.

    Args:
        file: a video.

    Returns:
        1 to 8; None of another container, and of angles that are no multiples of 90 degrees.
    """
    try:
        with file.open("rb") as stream:
            is_matroska = stream.read(4) == _MATROSKA
        return _of_projection(file) if is_matroska else _of_matrices(file)
    except _DAMAGED:
        return None


def count_videos(file: Path) -> int:
    """Number of tracks of images, 1 of another container.

    Args:
        file: a video.
    """
    try:
        with file.open("rb") as stream:
            is_matroska = stream.read(4) == _MATROSKA
        if is_matroska:
            return max(1, len(_matroska_tracks(file)))
        return max(1, sum(kind == b"trak" and _is_video(track) for kind, track in boxes(_index(file) or b"")))
    except _DAMAGED:
        return 1


def is_whole(file: Path) -> bool:
    """True for a Matroska file that ends where it says: its number of frames may be that of longer sound.

    Args:
        file: a video.
    """
    try:
        with file.open("rb") as stream:
            data, size = stream.read(_HEAD), file.stat().st_size
        at = 0
        while data.startswith(_MATROSKA) and at < len(data):
            kind, after = _number(data, at, marker=True)
            length, start = _number(data, after)
            if kind == _SEGMENT:
                return start + length <= size
            at = start + length
    except _DAMAGED:
        return False
    return False


def is_sphere(file: Path) -> bool:
    """True for a video whose images show all around (equirectangular, cubes), by its head.

    Args:
        file: a video; False of another container.
    """
    try:
        with file.open("rb") as stream:
            if stream.read(4) == _MATROSKA:
                return any(_projection(file).get(_PROJECTION_TYPE, b""))
        track = list(boxes(_video_track(file)))
        tables = dict(track)
        for kind in (b"mdia", b"minf", b"stbl"):
            tables = dict(boxes(tables.get(kind, b"")))
        entries = boxes(tables.get(b"stsd", b""), 8)
        return any(kind == b"uuid" and content.startswith(_SPHERICAL_VIDEO) for kind, content in track) or any(
            kind == b"sv3d" for _, entry in entries for kind, _ in boxes(entry, _SAMPLE_ENTRY)
        )
    except _DAMAGED:
        return False


def _of_matrices(file: Path) -> int | None:
    """By the matrices of the track and, after it, of the whole."""
    head = dict(boxes(_video_track(file))).get(b"tkhd", b"")
    a, b, c, d = _matrix(head, 52 if head[0] else 40)
    whole = dict(boxes(_index(file) or b"")).get(b"mvhd", b"")
    e, f, g, h = _matrix(whole, 48 if whole[0] else 36)
    found = (a * e + b * g, a * f + b * h, c * e + d * g, c * f + d * h)
    least = 1e-3 * max(map(abs, found))
    return _ORIENTATIONS.get(tuple(0 if abs(x) <= least else int(math.copysign(1, x)) for x in found))  # type: ignore[arg-type]


def _matrix(head: bytes, at: int) -> tuple[float, ...]:
    """``a b c d`` of ``a b u c d v x y w``; zeros stand for the identity."""
    a, b, _, c, d = struct.unpack_from(">5i", head, at)
    return (a, b, c, d) if a or b or c or d else _UPRIGHT


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


def _video_track(file: Path) -> bytes:
    """Content of the first track of images; empty of another container."""
    tracks = (track for kind, track in boxes(_index(file) or b"") if kind == b"trak")
    return next((track for track in tracks if _is_video(track)), b"")


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


def _of_projection(file: Path) -> int | None:
    """By the angles of a flat projection of Matroska; mirrored is a yaw of 180 degrees."""
    projection = _projection(file)
    yaw, pitch, roll = (_float(projection.get(kind, b"")) for kind in (_YAW, _PITCH, _ROLL))
    if any(projection.get(_PROJECTION_TYPE, b"")) or pitch or abs(yaw) not in (0, 180) or roll % 90:
        return None
    return _BY_ROLL[yaw != 0][round(roll / 90) % 4]


def _projection(file: Path) -> dict[int, bytes]:
    """Elements of the projection of the first track of images of a Matroska file; none if its head has no tracks."""
    video = next(iter(_matroska_tracks(file)), {}).get(_VIDEO, b"")
    return dict(_elements(dict(_elements(video)).get(_PROJECTION, b"")))


def _matroska_tracks(file: Path) -> list[dict[int, bytes]]:
    """Elements of each track of images."""
    with file.open("rb") as stream:
        head = dict(_elements(stream.read(_HEAD)))
    entries = _elements(dict(_elements(head.get(_SEGMENT, b""))).get(_TRACKS, b""))
    tracks = [dict(_elements(track)) for kind, track in entries if kind == _TRACK]
    return [track for track in tracks if track.get(_TRACK_TYPE) == b"\x01"]


def _elements(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and content of elements that follow each other; the last one may be cut."""
    at = 0
    while at < len(data):
        kind, after = _number(data, at, marker=True)
        size, start = _number(data, after)
        content = data[start : start + size] if size != (1 << 7 * (start - after)) - 1 else data[start:]  # not stated
        yield kind, content
        at = start + len(content)


def _number(data: bytes, at: int, *, marker: bool = False) -> tuple[int, int]:
    """Number of a length that its leading zero bits tell, with or without the bit after them; and where it ends."""
    length = 9 - data[at].bit_length()
    if length > 8 or at + length > len(data):
        raise ValueError("no number")
    value = int.from_bytes(data[at : at + length], "big")
    return (value if marker else value & ((1 << 7 * length) - 1)), at + length


def _float(content: bytes) -> float:
    return float(struct.unpack({4: ">f", 8: ">d"}[len(content)], content)[0]) if content else 0.0
