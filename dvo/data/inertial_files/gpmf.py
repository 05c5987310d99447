"""GPMF, the telemetry of GoPro cameras, in the track ``gpmd`` of an MP4 file (github.com/gopro/gpmf-parser, README).

An element is a key of four letters, a type, the bytes of a sample, and a number of samples, in big-endian order; a
type of 0 holds further elements. A payload holds about a second of all streams of the camera.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.boxes import boxes, read_head
from dvo.data.files.files import is_file, lookups

_MOST_INDEX = 2**26  # bytes of the index of an MP4 file
_MOST_PAYLOAD = 2**24  # bytes of a payload
_MOST_PAYLOADS = 10**6
_MOST_DEPTH = 8
_NUMBERS = {"b": "i1", "B": "u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "f": ">f4", "d": ">f8", "j": ">i8",
            "J": ">u8"}  # fmt: skip


@dataclass(frozen=True)
class Element:
    """Element of a payload.

    Attributes:
        key: four letters.
        kind: type, a letter; empty for one that holds others.
        size: bytes of a sample.
        count: number of samples.
        data: their bytes.
    """

    key: str
    kind: str
    size: int
    count: int
    data: bytes

    def children(self) -> list[Element]:
        """Elements in it."""
        return list(elements(self.data)) if not self.kind else []

    def text(self) -> str:
        """Its text; degrees and squares are in Latin-1."""
        return self.data.decode("latin-1").split("\0")[0].strip()

    def numbers(self) -> np.ndarray:
        """Its numbers ``(count, C)`` float64; ``(0, 1)`` if it holds none of one type."""
        form = _NUMBERS.get(self.kind)
        if form is None or not self.size or self.size % np.dtype(form).itemsize:
            return np.zeros((0, 1))
        columns = self.size // np.dtype(form).itemsize
        return np.frombuffer(self.data, form).reshape(-1, columns).astype(np.float64)


def elements(data: bytes) -> Iterator[Element]:
    """Elements that follow each other.

    Args:
        data: of a payload, or of an element that holds others.

    Raises:
        ValueError: one that is longer than the data.
    """
    at = 0
    while at + 8 <= len(data):
        key, kind, size, count = struct.unpack_from(">4ssBH", data, at)
        length = size * count
        if key == b"\0\0\0\0":  # padding
            return
        if length > len(data) - at - 8:
            raise ValueError(f"element {key!r} is longer than its payload")
        name = key.decode("latin-1")
        yield Element(name, kind.decode("latin-1").strip("\0"), size, count, data[at + 8 : at + 8 + length])
        at += 8 + -(-length // 4) * 4


@dataclass(frozen=True)
class Payload:
    """Payload of a telemetry track.

    Attributes:
        start, duration: seconds in the video.
        elements: at the top: one ``DEVC`` for each device.
    """

    start: float
    duration: float
    elements: tuple[Element, ...]


def has_telemetry(file: Path) -> bool:
    """True for an MP4 or QuickTime file with a track of GPMF; its index alone is read.

    Args:
        file: any.
    """
    try:
        return _table_of(file) is not None
    except (OSError, ValueError, struct.error, DvoError):
        return False


def read_payloads(file: Path) -> list[Payload]:
    """Read the telemetry of a video.

    Args:
        file: MP4 or QuickTime.

    Returns:
        Payloads in order.

    Raises:
        DvoError: no telemetry in it, or damaged telemetry.
    """
    remedy = "give the file as the camera wrote it; editing and sending over the net remove telemetry"
    try:
        table = _table_of(file)
        if table is None:
            raise DvoError("no telemetry of GoPro in it", file=file, field="imu", remedy=remedy)
        found = []
        with lookups(file), file.open("rb") as stream:
            for number, (start, duration, at, length) in enumerate(table):
                stream.seek(at)
                data = stream.read(length)
                if len(data) < length:
                    raise ValueError(f"payload {number} is cut off")
                found.append(Payload(start, duration, tuple(elements(data))))
    except (ValueError, struct.error, IndexError) as error:
        reason = " ".join(str(error).split())[:100]
        message = f"the telemetry is damaged ({reason})"
        raise DvoError(message, file=file, field="imu", remedy="copy the file from the camera again, or --imu none") \
            from None  # fmt: skip
    return found


def settings_of(file: Path) -> dict[str, str]:
    """Settings of the camera for the whole video, of the box ``GPMF`` in ``udta``.

    Args:
        file: MP4 or QuickTime.

    Returns:
        Texts and single numbers by key, such as ``MINF``: HERO9 Black; empty for none.
    """
    try:
        index = _index_of(file)
        found: dict[str, str] = {}
        for kind, data in boxes(index or b""):
            if kind != b"udta":
                continue
            for name, content in boxes(data):
                if name == b"GPMF":
                    for element in _all(elements(content)):
                        numbers = element.numbers()
                        if element.kind == "c":
                            found[element.key] = element.text()
                        elif numbers.size == 1:
                            found[element.key] = f"{numbers.item():.6g}"
        return found
    except (OSError, ValueError, struct.error):
        return {}


def _all(found: Iterator[Element], depth: int = 0) -> Iterator[Element]:
    for element in found:
        if element.kind:
            yield element
        elif depth < _MOST_DEPTH:
            yield from _all(iter(element.children()), depth + 1)


def _index_of(file: Path) -> bytes | None:
    """Content of the box ``moov``; None for a file of another container."""
    if not is_file(file):
        return None
    with file.open("rb") as stream:
        end, at = file.stat().st_size, 0
        if stream.read(8)[4:] not in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
            return None
        for _ in range(4096):
            if at + 8 > end:
                return None
            head = read_head(stream, at, end)
            if head is None:
                return None
            kind, skip, length = head
            if kind == b"moov":
                return stream.read(length - skip) if length <= _MOST_INDEX else None
            at += length
    return None


def _table_of(file: Path) -> list[tuple[float, float, int, int]] | None:
    """Start and duration in seconds, place and bytes of each payload; None without telemetry."""
    index = _index_of(file)
    for track in (data for kind, data in boxes(index or b"") if kind == b"trak"):
        media = dict(boxes(dict(boxes(track)).get(b"mdia", b"")))
        table = dict(boxes(dict(boxes(media.get(b"minf", b""))).get(b"stbl", b"")))
        if table.get(b"stsd", b"")[12:16] == b"gpmd":
            return _samples(media.get(b"mdhd", b""), table)
    return None


def _samples(header: bytes, table: dict[bytes, bytes]) -> list[tuple[float, float, int, int]]:
    """Samples of a track (ISO/IEC 14496-12, 8.6 and 8.7)."""
    (scale,) = struct.unpack_from(">I", header, 20 if header[:1] == b"\1" else 12)
    same, count = struct.unpack_from(">II", table[b"stsz"], 4) if b"stsz" in table else (0, 0)
    if not scale or count > _MOST_PAYLOADS:
        raise ValueError("no table of its payloads")
    sizes = [same] * count if same else list(struct.unpack_from(f">{count}I", table[b"stsz"], 12))
    if max(sizes, default=0) > _MOST_PAYLOAD:
        raise ValueError("a payload is too large")
    wide = b"co64" in table
    raw = table.get(b"co64" if wide else b"stco", b"")
    (chunks,) = struct.unpack_from(">I", raw, 4)
    if chunks > _MOST_PAYLOADS:
        raise ValueError("too many chunks")
    places = struct.unpack_from(f">{chunks}{'Q' if wide else 'I'}", raw, 8)
    offsets = _offsets(places, table.get(b"stsc", b""), sizes)
    durations: list[int] = []
    (runs,) = struct.unpack_from(">I", table.get(b"stts", b""), 4)
    for k in range(min(runs, count)):
        times, ticks = struct.unpack_from(">II", table[b"stts"], 8 + 8 * k)
        durations += [ticks] * min(times, count - len(durations))
    if len(offsets) < count or len(durations) < count:
        raise ValueError("the table of its payloads is not whole")
    found, start = [], 0
    for at, length, ticks in zip(offsets, sizes, durations, strict=False):
        found.append((start / scale, ticks / scale, at, length))
        start += ticks
    return found


def _offsets(places: tuple[int, ...], table: bytes, sizes: list[int]) -> list[int]:
    """Place of each sample, of those of the chunks and the number of samples in each."""
    (runs,) = struct.unpack_from(">I", table, 4)
    rows = [struct.unpack_from(">III", table, 8 + 12 * k)[:2] for k in range(min(runs, len(places)))]
    offsets: list[int] = []
    for k, (first, inside) in enumerate(rows):
        last = rows[k + 1][0] if k + 1 < len(rows) else len(places) + 1
        for chunk in range(max(first, 1), min(last, len(places) + 1)):
            at = places[chunk - 1]
            for _ in range(inside):
                if len(offsets) == len(sizes):
                    return offsets
                offsets.append(at)
                at += sizes[len(offsets) - 1]
    return offsets
