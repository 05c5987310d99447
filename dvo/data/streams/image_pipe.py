"""Images of a pipe: JPEG and PNG files one after the other, as ``ffmpeg -f image2pipe`` writes them.

There is no header and nothing between the files; bytes that belong to neither format, such as the part headers of
``multipart/x-mixed-replace``, are passed over. The end of a file follows from its own structure: the chunks of a PNG,
the segments of a JPEG (so that a thumbnail inside it is not taken for an image).
"""

from __future__ import annotations

import io
import os
import re
import select
import stat
from collections.abc import Callable, Iterator
from typing import Any

from dvo.core.errors import DvoError

MAX_BYTES = 2**26
"""Largest image of a pipe, bytes."""

_START = re.compile(rb"\xff\xd8\xff|\x89PNG\r\n\x1a\n")
_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")  # a marker that ends the data of a JPEG scan
_NO_IMAGE_AFTER = 2**20  # bytes
_CHUNK = 2**16
_INTERVAL = 0.25  # seconds between two looks whether somebody has stopped the stream
_REMEDY = "write JPEG or PNG images one after the other, as ffmpeg -f image2pipe -c:v mjpeg - does"


def pipe_reader(file: Any, stopped: Callable[[], bool], name: str = "pipe") -> Callable[[], bytes]:
    """Function that reads what has arrived.

    A pipe is read by its descriptor, any other file by its own methods: what these decompress (``gzip``), decode
    (chunks of HTTP) or have in a buffer is not what its descriptor gives.

    Args:
        file: binary file; nothing of it has been read yet if it is a pipe.
        stopped: whether to end although the pipe is open.
        name: of the stream, for messages.

    Returns:
        Function that waits for bytes and returns them; none at the end. It raises a :class:`DvoError` where the file
        cannot be read: a damaged ``gzip``, a connection that breaks, a file that is not binary.
    """
    descriptor = _pipe_descriptor(file)
    take = getattr(file, "read1", file.read)  # what has arrived; read waits for all bytes

    def read() -> bytes:
        if stopped():
            return b""
        if descriptor is None:
            try:
                data = take(_CHUNK)
            except Exception as error:  # EOFError, zlib.error, HTTPException and others of the file's own kind
                reason = " ".join(str(error).split())[:200] or type(error).__name__
                raise DvoError(f"cannot be read ({reason})", file=name, remedy="check the stream") from error
            if not isinstance(data, bytes):
                message = f"reading gives {type(data).__name__}, not bytes"
                raise DvoError(message, file=name, remedy="give a binary file that waits for its data")
            return data
        # The descriptor, not the file: a thread that waits inside of sys.stdin would abort the end of the interpreter.
        while os.name != "nt" and not stopped():
            if select.select([descriptor], [], [], _INTERVAL)[0]:
                break
        return b"" if stopped() else os.read(descriptor, _CHUNK)

    return read


def _pipe_descriptor(file: Any) -> int | None:
    """Descriptor of a file of the system that may make its reader wait; None for every other one."""
    raw = file.raw if isinstance(file, io.BufferedReader) else file
    if not isinstance(raw, io.FileIO):
        return None
    descriptor = raw.fileno()
    return None if stat.S_ISREG(os.fstat(descriptor).st_mode) else descriptor


def split_images(read: Callable[[], bytes], name: str) -> Iterator[bytes]:
    """Cut a stream of bytes into the image files that it consists of.

    Args:
        read: waits for bytes and returns them; none at the end.
        name: of the stream, for messages.

    Yields:
        Bytes of each image, as soon as the last one has arrived. An image that is cut off by the end is left out.

    Raises:
        DvoError: a megabyte without an image, a stream that ends with bytes and without an image, or an image of more
            than :data:`MAX_BYTES`.
    """
    buffer = _Buffer(read, name)
    if not buffer.find_start():
        if buffer.data:
            raise DvoError("no JPEG or PNG image in what arrives", file=name, remedy=_REMEDY)
        return
    while buffer.find_start():
        try:
            end = _png_end(buffer) if buffer.data[0] == 0x89 else _jpeg_end(buffer)
        except ValueError:  # damaged: look for the next image behind the mark of this one
            del buffer.data[:2]
            continue
        if end is None:
            return
        image = bytes(buffer.data[:end])
        del buffer.data[:end]
        yield image


class _Buffer:
    def __init__(self, read: Callable[[], bytes], name: str) -> None:
        self.data, self.read, self.name = bytearray(), read, name

    def find_start(self) -> bool:
        """Drop what is before the next image; False at the end of the stream."""
        skipped = 0
        while True:
            found = _START.search(self.data)
            keep = found.start() if found else max(len(self.data) - 7, 0)  # a mark may have arrived in part
            skipped += keep
            del self.data[:keep]
            if found:
                return True
            if skipped > _NO_IMAGE_AFTER:
                raise DvoError("a megabyte without a JPEG or PNG image", file=self.name, remedy=_REMEDY)
            if not self.has(len(self.data) + 1):
                return False

    def has(self, count: int) -> bool:
        """Read until there are so many bytes; False if the stream ends before."""
        if count > MAX_BYTES:
            raise DvoError(f"an image of more than {MAX_BYTES // 2**20} MB", file=self.name, remedy=_REMEDY)
        while len(self.data) < count:
            more = self.read()
            if not more:
                return False
            self.data += more
        return True


def _png_end(buffer: _Buffer) -> int | None:
    """Position behind the PNG at the beginning of the buffer; None if the stream ends in it."""
    at = 8
    while buffer.has(at + 8):
        kind = bytes(buffer.data[at + 4 : at + 8])
        if not kind.isalpha():
            raise ValueError("no chunk")
        length = int.from_bytes(buffer.data[at : at + 4], "big")
        if length > MAX_BYTES:  # damaged: encoders write far smaller chunks
            raise ValueError("no length of a chunk")
        at += 12 + length
        if kind == b"IEND":
            return at if buffer.has(at) else None
    return None


def _jpeg_end(buffer: _Buffer) -> int | None:
    """Position behind the JPEG at the beginning of the buffer; None if the stream ends in it."""
    at = 2
    while buffer.has(at + 2):  # not more, or a live image would wait for the next one
        if buffer.data[at] != 0xFF:
            raise ValueError("no marker")
        marker = buffer.data[at + 1]
        if marker == 0xD9:
            return at + 2
        if marker == 0xFF:  # padding
            at += 1
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:  # markers without a segment
            at += 2
        elif not buffer.has(at + 4):
            return None
        else:
            at += 2 + int.from_bytes(buffer.data[at + 2 : at + 4], "big")
            if marker == 0xDA:
                found = _scan_end(buffer, at)
                if found is None:
                    return None
                at = found
    return None


def _scan_end(buffer: _Buffer, at: int) -> int | None:
    while True:
        found = _IN_SCAN.search(buffer.data, at)
        if found:
            return found.start()
        at = max(at, len(buffer.data) - 1)
        if not buffer.has(len(buffer.data) + 1):
            return None
