"""Lists of files with their times, in the layout of TUM RGB-D."""

from __future__ import annotations

from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.clock import in_seconds, is_time_name, parse_time, refuse_lost_zeros, unit_of
from dvo.data.files.files import is_file, read_lines


def listed_file(listing: Path, folder: Path, name: str, line: int) -> Path:
    """File that a list of files names.

    Links are followed when it is read; the name itself must not lead out of the folder. Backslashes separate folders,
    as on Windows, unless there is a file of that very name.

    Args:
        listing: the list, for messages.
        folder: that the names are relative to.
        name: as listed.
        line: number of its line.

    Returns:
        The file, which need not exist.

    Raises:
        DvoError: an absolute name, or one with ``..``.
    """
    outside = any(
        pure.is_absolute() or pure.drive or ".." in pure.parts for pure in (PurePosixPath(name), PureWindowsPath(name))
    )
    if outside or "\0" in name:
        raise DvoError(
            f"{name[:200]!r} is not a file of this folder",
            file=listing,
            field=f"line {line}",
            remedy="list names relative to the folder, without '..'",
        )
    path = folder / name
    return folder / name.replace("\\", "/") if "\\" in name and not is_file(path) else path


def listed_files(
    listing: Path, what: str = "images", folder: Path | None = None, column: int | None = None
) -> tuple[list[Path], np.ndarray]:
    """Files and times of a list in the layout of TUM RGB-D, such as ``rgb.txt``: ``timestamp filename`` a row.

    A comma may stand in place of the blank.

    Args:
        listing: text file; what follows a ``#`` is left out. A first row of words is a header.
        what: it lists, for messages.
        folder: that the names are relative to; that of the list by default.
        column: of the pairs of time and name in each row, as :func:`associated_columns` gives it; names then hold no
            blanks. None: a row is one pair.

    Returns:
        Files, which need not exist, and their times ``(N,)`` in seconds, sorted by time; of which unit they are is told
        by :func:`dvo.data.files.clock.unit_of`.

    Raises:
        DvoError: the file cannot be read, or a row that is none, with the number of its line.
    """
    times: list[int | float] = []
    files: list[Path] = []
    texts: list[str] = []
    for number, line in read_lines(listing, f"give a list of {what}"):
        fields = _pair(line.split("#")[0].strip(), column)
        if not fields:
            continue
        try:
            time, name = parse_time(fields[0]), fields[1].strip()
        except (ValueError, IndexError):
            if not times and len(fields) > 1 and is_time_name(fields[0]):
                continue  # names of the columns
            raise DvoError(
                "not 'timestamp filename'", file=listing, field=f"line {number}", remedy="correct the row"
            ) from None
        files.append(listed_file(listing, folder or listing.parent, name, number))
        times.append(time)
        texts.append(fields[0])
    refuse_lost_zeros(texts, listing)
    order = sorted(range(len(times)), key=lambda row: times[row])
    ordered = [times[row] for row in order]
    return [files[row] for row in order], in_seconds(ordered, unit_of(ordered))


def associated_columns(listing: Path) -> dict[str, int]:
    """Columns of a list of associated images, rows ``time file time file`` as TUM's ``associate.py`` writes them.

    Args:
        listing: the list.

    Returns:
        ``rgb`` and ``depth`` to the number of the pair of columns, by the folders or names of the files of the first
        row; those that are there.

    Raises:
        DvoError: the file cannot be read.
    """
    for _, line in read_lines(listing, "give a list of associated images"):
        fields = line.split("#")[0].replace(",", " ").split()
        if fields:
            found: dict[str, int] = {}
            for pair in range(len(fields) // 2):
                name = fields[2 * pair + 1].lower()
                kind = "depth" if "depth" in name else "rgb"
                found.setdefault(kind, pair)
            return found
    return {}


def _pair(text: str, column: int | None) -> list[str]:
    if column is not None:
        return text.replace(",", " ").split()[2 * column : 2 * column + 2]
    head = text.split(maxsplit=1)
    if head and "," in head[0]:
        return text.split(",", 1)
    return head
