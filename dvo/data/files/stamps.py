"""Times of images: from a file, from their names, or from a rate."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.files import is_file, is_nanoseconds, parse_nanoseconds, parse_number, read_rows

NOMINAL_FPS = 30.0
RATES = (1e-5, 1e6)
"""Slowest and fastest images a second: one a day, and more than any camera takes."""
_SECONDS = re.compile(r"[0-9]{1,12}\.[0-9]+")


def parse_stamp(text: str) -> float | None:
    """Parse a time stamp: a decimal number of seconds, or an integer of 16 to 19 digits (nanoseconds).

    Args:
        text: stem of a file name.

    Returns:
        Seconds; None for anything else. A frame number (``000123``) is no stamp, so that it never passes for seconds.
    """
    if is_nanoseconds(text):
        return parse_nanoseconds(text) / 1e9 if int(text) < 2**63 else None
    return float(text) if _SECONDS.fullmatch(text) else None


def read_times(path: Path, count: int | None) -> np.ndarray:
    """Read the first column of a text or CSV file: seconds, one row per image (integers of 16 digits: nanoseconds).

    ``#`` starts a comment; a first row of words is a header.

    Args:
        path: the file.
        count: number of rows that there must be; None for any.

    Returns:
        ``(N,)`` float64 seconds, strictly increasing.

    Raises:
        DvoError: missing or malformed file, no number where one is expected or one beyond
            :data:`dvo.data.files.files.MAX_NUMBER`, another number of rows, times that do not increase.
    """
    times: list[float] = []
    is_first = True
    for number, fields in read_rows(path, "give a file with one time per image", "times"):
        try:
            value = parse_nanoseconds(fields[0]) / 1e9 if is_nanoseconds(fields[0]) else parse_number(fields[0])
        except ValueError:
            if is_first and not _is_number(fields[0]):  # the names of the columns
                is_first = False
                continue
            raise DvoError(
                f"{fields[0][:40]!r} is no time",
                file=path,
                field=f"line {number}",
                remedy="put seconds first in each row",
            ) from None
        is_first = False
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


def _is_number(text: str) -> bool:
    """True also for what is not finite."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def times_from_names(paths: list[Path]) -> np.ndarray | None:
    """Read times from file names.

    Args:
        paths: ``N`` files.

    Returns:
        ``(N,)`` float64 seconds if every stem is a stamp (``1305031102.175304``, ``1403636579763555584[_0]``), else
        None.
    """
    times = [parse_stamp(re.sub(r"(?<=[0-9]{16})_0$", "", path.stem)) for path in paths]
    if not paths or any(time is None for time in times):
        return None
    return np.array(times, dtype=np.float64)


def checked_rate(fps: float | None, field: str = "fps") -> float | None:
    """Check frames a second.

    Args:
        fps: the user's; None if not given.
        field: name of the option, for messages.

    Returns:
        The rate.

    Raises:
        DvoError: no number, or one outside of :data:`RATES`.
    """
    if fps is None:
        return None
    try:
        rate = float(fps)
    except (TypeError, ValueError, OverflowError):
        rate = float("nan")
    if not RATES[0] <= rate <= RATES[1]:  # NaN fails too
        raise DvoError(f"{str(fps)[:40]} frames a second", field=field, remedy="give a positive rate, such as 30")
    return rate


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
    fps = checked_rate(fps)
    if times is not None:
        return read_times(times, len(paths))
    found, origin = None, ""
    beside = next((path for path in (folder / "times.txt", folder.parent / "times.txt") if is_file(path)), None)
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
