"""Times of images: from a file, from their names, or from a rate."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dvo.errors import DvoError

NOMINAL_FPS = 30.0
_NANOSECONDS = re.compile(r"\d{16,}")
_SECONDS = re.compile(r"\d+\.\d+")


def parse_stamp(text: str) -> float | None:
    """Parse a time stamp: a decimal number of seconds, or an integer of at least 16 digits (nanoseconds).

    Args:
        text: stem of a file name.

    Returns:
        Seconds; None for anything else. A frame number (``000123``) is no stamp, so that it never passes for seconds.
    """
    if _NANOSECONDS.fullmatch(text):
        return int(text) / 1e9
    return float(text) if _SECONDS.fullmatch(text) else None


def read_times(path: Path, count: int | None) -> np.ndarray:
    """Read the first column of a text or CSV file: seconds, one row per image (integers of 16 digits: nanoseconds).

    ``#`` starts a comment; a first row of words is a header.

    Args:
        path: the file.
        count: number of rows that there must be; None for any.

    Returns:
        ``(N,)`` float64 seconds, strictly increasing.

    Args:
        path: the file.
        count: number of images, or None if not known.

    Returns:
        ``(count,)`` float64, strictly increasing.

    Raises:
        DvoError: missing file, no number where one is expected, another number of rows, times that do not increase.
    """
    if not path.is_file():
        raise DvoError("no such file", file=path, field="times", remedy="give a file with one time per image")
    times: list[float] = []
    header_allowed = True
    for number, line in enumerate(path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), 1):
        fields = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        if not fields:
            continue
        try:
            value = int(fields[0]) / 1e9 if _NANOSECONDS.fullmatch(fields[0]) else float(fields[0])
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            if header_allowed:
                header_allowed = False
                continue
            raise DvoError(
                f"{fields[0]!r} is no time", file=path, field=f"line {number}", remedy="put seconds first in each row"
            )
        header_allowed = False
        if times and value <= times[-1]:
            raise DvoError(
                f"times must increase, but {value:.9g} follows {times[-1]:.9g}",
                file=path,
                field=f"line {number}",
                remedy="sort the rows, and remove duplicates together with their images",
            )
        times.append(value)
    if count is not None and len(times) != count:
        raise DvoError(
            f"{len(times)} rows for {count} images",
            file=path,
            field="times",
            remedy="give one row per image, or another file with --times",
        )
    return np.array(times, dtype=np.float64)


def times_from_names(paths: list[Path]) -> np.ndarray | None:
    """Read times from file names.

    Args:
        paths: ``N`` files.

    Returns:
        ``(N,)`` float64 seconds if every stem is a stamp (``1305031102.175304``, ``1403636579763555584[_0]``), else
        None.
    """
    times = [parse_stamp(re.sub(r"(?<=\d{16})_0$", "", path.stem)) for path in paths]
    if not paths or any(time is None for time in times):
        return None
    return np.array(times, dtype=np.float64)


def choose_times(
    paths: list[Path],
    folder: Path,
    *,
    times: Path | None,
    fps: float | None,
    warnings: list[str],
    fallback: Callable[[], np.ndarray | None] = lambda: None,
) -> np.ndarray:
    """Choose the times of the images of a folder.

    The first of these that there is: ``times``, ``times.txt`` beside the images or one level up, names that are stamps,
    ``fallback()``, ``fps``, and last an assumed rate, with a warning.

    Args:
        paths: the images, in order.
        folder: where ``times.txt`` is looked for, and in its parent.
        times: file that the user named.
        fps: rate that the user named.
        warnings: receives guesses and options that were not used, a sentence each.
        fallback: times that the data set offers, e.g. those of its ground truth.

    Returns:
        ``(len(paths),)`` float64 seconds; may hold duplicates when they come from names.

    Raises:
        DvoError: see :func:`read_times`; a rate that is not positive.
    """
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise DvoError(f"{fps:g} frames a second", field="fps", remedy="give a positive rate")
    if times is not None:
        return read_times(times, len(paths))
    found, origin = None, ""
    beside = next((path for path in (folder / "times.txt", folder.parent / "times.txt") if path.is_file()), None)
    if beside is not None:
        found, origin = read_times(beside, len(paths)), str(beside)
    if found is None:
        found, origin = times_from_names(paths), "the file names"
    if found is None:
        found, origin = fallback(), "the ground truth"
    if found is not None:
        if fps is not None:
            warnings.append(f"--fps was not used: the times come from {origin}")
        return found
    if fps is None:
        warnings.append(f"no times found: assuming {NOMINAL_FPS:g} frames a second (give --times FILE or --fps F)")
    return np.arange(len(paths)) / (fps or NOMINAL_FPS)
