"""Files within bounds: tables row by row, image files whole, and numbers that are times."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dvo.core.errors import DvoError

MAX_TABLE = 2**30
"""Largest table, bytes: some hours of inertial samples."""
MAX_LINE = 2**16
"""Longest row of a table, characters."""
MAX_IMAGE_FILE = 2**29
"""Largest image file, bytes."""
MAX_NUMBER = 1e12
"""Largest number of seconds or metres in a table: what is beyond cannot be either, and squares of it stay finite."""


def is_file(path: Path) -> bool:
    """True for a regular file, or a link to one; False for what cannot be looked up, such as too long a name.

    Args:
        path: any.
    """
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """True for a folder, or a link to one; False for what cannot be looked up.

    Args:
        path: any.
    """
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def exists(path: Path) -> bool:
    """True for a file of any kind or a link to one; False for what cannot be looked up.

    Args:
        path: any.
    """
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


@contextmanager
def lookups(path: Path) -> Iterator[None]:
    """Turn errors of the file system into one :class:`DvoError`.

    Args:
        path: for messages, where the error names none.

    Raises:
        DvoError: the block raised an ``OSError``.
    """
    try:
        yield
    except OSError as error:
        file, reason = error.filename or path, error.strerror or type(error).__name__
        raise DvoError(f"cannot be read ({reason})", file=file, remedy="check the path and the permissions") from None


def read_rows(path: Path, remedy: str, field: str | None = None) -> Iterator[tuple[int, list[str]]]:
    """Read a text or CSV table row by row.

    ``#`` begins a comment; blanks, commas and semicolons separate the fields. Rows without fields are left out.

    Args:
        path: UTF-8, with or without a byte order mark.
        remedy: for messages about the file as a whole.
        field: name of the table or the option, for the same messages.

    Yields:
        Number of the line, from 1, and the fields of a row.

    Raises:
        DvoError: no such file, no regular one, a larger one than :data:`MAX_TABLE`; a line that is longer than
            :data:`MAX_LINE` or no UTF-8.
    """
    for number, line in read_lines(path, remedy, field):
        fields = fields_of(line)
        if fields:
            yield number, fields


def fields_of(line: str) -> list[str]:
    """Fields of a row, without double quotes around them; see :func:`read_rows`.

    Args:
        line: the row.
    """
    return [word.strip('"') for word in line.split("#", 1)[0].replace(",", " ").replace(";", " ").split()]


def read_lines(
    path: Path, remedy: str, field: str | None = None, largest: int = MAX_TABLE
) -> Iterator[tuple[int, str]]:
    """Read a text file line by line; see :func:`read_rows`.

    Args:
        path: UTF-8, with or without a byte order mark.
        remedy: for messages about the file as a whole.
        field: name of the table or the option, for the same messages.
        largest: bytes of the file.

    Yields:
        Number of a line, from 1, and its text.

    Raises:
        DvoError: as :func:`read_rows`.
    """
    if not is_file(path):
        raise DvoError("no such file", file=path, field=field, remedy=remedy)
    with lookups(path), path.open(encoding="utf-8-sig", errors="surrogateescape") as file:
        if path.stat().st_size > largest:
            raise DvoError(f"larger than {largest // 2**20:,} MB", file=path, field=field, remedy=remedy)
        number = 0
        while line := file.readline(MAX_LINE + 1):
            number += 1
            if len(line) > MAX_LINE:
                message = f"longer than {MAX_LINE:,} characters"
                raise DvoError(message, file=path, field=f"line {number}", remedy="give one row a line")
            if not line.isascii() and any("\udc80" <= character <= "\udcff" for character in line):
                raise DvoError(
                    "not UTF-8 text", file=path, field=f"line {number}", remedy="save it with the encoding UTF-8"
                )
            yield number, line


def read_image_file(path: Path) -> bytes | None:
    """Read the bytes of an image file.

    Args:
        path: the file.

    Returns:
        All bytes; None for what is missing, no regular file, cannot be read, or is larger than
        :data:`MAX_IMAGE_FILE`.
    """
    try:
        if not is_file(path) or path.stat().st_size > MAX_IMAGE_FILE:
            return None
        return path.read_bytes()
    except OSError:
        return None


def parse_number(text: str) -> float:
    """Parse a decimal number of a table.

    Args:
        text: the number.

    Raises:
        ValueError: no number, not finite, or beyond :data:`MAX_NUMBER`.
    """
    value = float(text)
    if not abs(value) <= MAX_NUMBER:  # NaN fails too
        raise ValueError("out of bounds")
    return value


def parse_nanoseconds(text: str) -> int:
    """Parse an integer number of nanoseconds.

    Args:
        text: the number.

    Raises:
        ValueError: no integer, or one of more than 64 bits.
    """
    if len(text) > 20:
        raise ValueError("out of bounds")
    value = int(text)
    if not abs(value) < 2**63:
        raise ValueError("out of bounds")
    return value
