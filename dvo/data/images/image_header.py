"""Size of an image by its header, before anything is decoded or allocated."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import BinaryIO

MAX_PIXELS = 64_000_000
"""Largest image that is decoded, pixels; 9,200 x 6,900 of a camera with 64 megapixels."""

_SEGMENTS = 4096  # of a JPEG file before its frame header
_PAGES = 8  # of a TIFF file that are looked at
_TIFF_HEADS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_TIFF_TYPES = {3: "H", 4: "I", 16: "Q"}


def image_size(source: Path | str | bytes) -> tuple[int, int] | None:
    """Width and height that the header of an image states.

    Args:
        source: file, or its bytes: PNG, JPEG, BMP, TIFF, WebP, or PNM (PBM, PGM, PPM, PAM).

    Returns:
        Width and height in pixels; None for another format, a cut header, or a file that cannot be read.
    """
    try:
        if isinstance(source, bytes):
            return _size(io.BytesIO(source))
        with Path(source).open("rb") as file:
            return _size(file)
    except (OSError, struct.error, ValueError, OverflowError, IndexError):  # cut, or offsets that lead nowhere
        return None


def holds_several(source: Path) -> bool:
    """True for a file of several images: pages of a TIFF, an animated PNG or WebP.

    Args:
        source: file; what is no such file, or cannot be read, holds one.
    """
    try:
        with source.open("rb") as file:
            head = file.read(64)
            if head[:4] in _TIFF_HEADS:
                return _has_second_page(file, head)
            return (head.startswith(b"\x89PNG") and b"acTL" in head) or (head[12:16] == b"VP8X" and bool(head[20] & 2))
    except (OSError, struct.error, ValueError, OverflowError):
        return False


def no_image(source: Path) -> str | None:
    """What a file is that has the name of an image and does not decode.

    Args:
        source: file.

    Returns:
        Words for people; None for what is not known.
    """
    try:
        with source.open("rb") as file:
            head = file.read(64)
    except OSError:
        return None
    if not head:
        return "empty"
    if head.startswith(b"version https://git-lfs"):
        return "a pointer of Git LFS (git lfs pull fetches the files)"
    if head.lstrip().lower().startswith((b"<!doctype", b"<html")):
        return "a web page"
    kinds = {b"heic": "HEIC", b"heix": "HEIC", b"mif1": "HEIC", b"msf1": "HEIC", b"avif": "AVIF", b"avis": "AVIF"}
    kind = kinds.get(head[8:12]) if head[4:8] == b"ftyp" else None
    return None if kind is None else f"{kind}, which is not read"


def white_value(source: Path) -> int | None:
    """The value of white that a PGM or PPM file states, where OpenCV leaves the pixels as they are stored.

    Args:
        source: file; only one whose name ends as theirs is looked into.
    """
    if source.suffix.lower() not in (".pgm", ".ppm", ".pnm"):
        return None
    try:
        with source.open("rb") as file:
            words = _pnm_words(file)
            value = _number(words[3])
    except (OSError, ValueError, IndexError):
        return None
    is_stored = words[0] in (b"P5", b"P6") or (value > 255 and words[0] in (b"P2", b"P3"))  # text of 8 bits is scaled
    return value if is_stored and 0 < value < 65535 and value != 255 else None


def _has_second_page(file: BinaryIO, head: bytes) -> bool:
    """True if another directory follows the first one that is no reduced copy or mask of it (tag 254)."""
    order, big = ("<" if head[:2] == b"II" else ">"), head[2:4] in (b"+\0", b"\0+")
    offset, counts, entry = (f"{order}Q", f"{order}Q", 20) if big else (f"{order}I", f"{order}H", 12)
    (at,) = struct.unpack_from(offset, head, 8 if big else 4)
    for number in range(_PAGES):
        if at == 0:
            return False
        file.seek(at)
        (count,) = struct.unpack(counts, file.read(struct.calcsize(counts)))
        rows = file.read(min(count, 1024) * entry)
        tags = {struct.unpack_from(f"{order}H", rows, k)[0]: rows[k : k + entry] for k in range(0, len(rows), entry)}
        kind = struct.unpack_from(f"{order}I", tags[254], entry - (8 if big else 4))[0] if 254 in tags else 0
        if number and not kind & 5:
            return True
        (at,) = struct.unpack(offset, file.read(struct.calcsize(offset)))
    return False


def _size(file: BinaryIO) -> tuple[int, int] | None:
    head = file.read(32)
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        return _pair(">II", head, 16)
    if head.startswith(b"\xff\xd8"):
        return _jpeg(file)
    if head.startswith(b"BM"):
        return _bmp(head)
    if head[:4] in _TIFF_HEADS:
        return _tiff(file, head)
    if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        return _webp(head)
    if len(head) > 2 and head[:1] == b"P" and head[1:2] in b"1234567" and head[2:3].isspace():
        return _pnm(file)
    return None


def _pair(form: str, data: bytes, at: int) -> tuple[int, int]:
    first, second = struct.unpack_from(form, data, at)
    return first, second


def _bmp(head: bytes) -> tuple[int, int]:
    if struct.unpack_from("<I", head, 14)[0] == 12:  # OS/2
        return _pair("<HH", head, 18)
    width, height = _pair("<ii", head, 18)  # a negative height: rows from top to bottom
    return abs(width), abs(height)


def _jpeg(file: BinaryIO) -> tuple[int, int] | None:
    file.seek(2)
    for _ in range(_SEGMENTS):
        byte = file.read(1)
        while byte and byte != b"\xff":
            byte = file.read(1)
        while byte == b"\xff":  # fill bytes
            byte = file.read(1)
        if not byte:
            return None
        marker = byte[0]
        if marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD8:  # without a length
            continue
        if marker in (0xD9, 0xDA):  # end of image or start of scan: no frame header
            return None
        (length,) = struct.unpack(">H", file.read(2))
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", file.read(5)[1:])
            return width, height
        file.seek(max(length - 2, 0), io.SEEK_CUR)
    return None


def _tiff(file: BinaryIO, head: bytes) -> tuple[int, int] | None:
    order, big = ("<" if head[:2] == b"II" else ">"), head[2:4] in (b"+\0", b"\0+")
    file.seek(struct.unpack_from(f"{order}{'Q' if big else 'I'}", head, 8 if big else 4)[0])
    (count,) = struct.unpack(f"{order}{'Q' if big else 'H'}", file.read(8 if big else 2))
    found: dict[int, int] = {}
    entry = 20 if big else 12
    for _ in range(min(count, 1024)):
        row = file.read(entry)
        tag, kind = struct.unpack_from(f"{order}HH", row)
        if tag in (256, 257):
            if kind not in _TIFF_TYPES:
                return None
            (found[tag],) = struct.unpack_from(f"{order}{_TIFF_TYPES[kind]}", row, entry - (8 if big else 4))
        if len(found) == 2:
            return found[256], found[257]
    return None


def _webp(head: bytes) -> tuple[int, int] | None:
    if head[12:16] == b"VP8 ":
        width, height = _pair("<HH", head, 26)
        return width & 0x3FFF, height & 0x3FFF
    if head[12:16] == b"VP8L":
        (bits,) = struct.unpack_from("<I", head, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if head[12:16] == b"VP8X" and len(head) >= 30:
        return int.from_bytes(head[24:27], "little") + 1, int.from_bytes(head[27:30], "little") + 1
    return None


def _pnm(file: BinaryIO) -> tuple[int, int] | None:
    words = _pnm_words(file)
    if words[0] == b"P7":  # PAM: keys with values
        return _number(words[words.index(b"WIDTH") + 1]), _number(words[words.index(b"HEIGHT") + 1])
    if words[0] not in (b"P1", b"P4") and len(words) < 4:  # without the largest value, the height may be cut
        return None
    return _number(words[1]), _number(words[2])


def _pnm_words(file: BinaryIO) -> list[bytes]:
    file.seek(0)
    lines = [line.split(b"#")[0] for line in file.read(4096).splitlines()]
    return b" ".join(lines).split()


def _number(word: bytes) -> int:
    if not word.isdigit():
        raise ValueError("no number")
    return int(word[:18])  # longer ones are beyond any bound too
