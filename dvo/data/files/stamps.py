"""Times of images: from a file, from their names, or from a rate."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.text import visible
from dvo.data.files.clock import Table, clock_of_names, clock_of_rows, is_number, read_table, refuse_lost_zeros
from dvo.data.files.files import MAX_NUMBER, is_file

NOMINAL_FPS = 30.0
RATES = (1e-5, 1e6)
"""Slowest and fastest images a second: one a day, and more than any camera takes."""

_LEAST = 5  # names
_UNEVEN = 4  # largest interval of names that count, usual ones
_COUNTS = 1e5  # usual interval of such names, at most
_SHORTEST = 2e-5  # seconds between the images of a list


def read_times(
    path: Path, count: int | None, notes: list[str] | None = None, images: Sequence[Path] = ()
) -> np.ndarray:
    """Read the times of a text or CSV file, one row per image: see :func:`dvo.data.files.clock.clock_of_rows`.

    ``#`` starts a comment; a first row of words is a header. Rows that name images are those of these images, whatever
    their order; of images that are not there they are left out, and a note says so.

    Args:
        path: the file.
        count: number of rows that there must be; None for any.
        notes: receives a sentence if the times are no plain seconds.
        images: that rows may name.

    Returns:
        ``(N,)`` float64 seconds, strictly increasing unless rows name the images.

    Raises:
        DvoError: missing or malformed file, no number where one is expected or one beyond
            :data:`dvo.data.files.files.MAX_NUMBER`, another number of rows, times that do not increase.
    """
    table = read_table(path, "give a file with one time per image", "times")
    named = _named(table, images)
    if named is not None:
        return _times_by_name(*named, path, images, notes)
    clock = clock_of_rows(table.rows, table.header)
    times = clock.seconds
    refuse_lost_zeros([row[clock.column] for row in table.rows if clock.column < len(row)], path)
    for row, value in enumerate(times.tolist()):
        if not abs(value) <= MAX_NUMBER:  # NaN fails too
            fields = table.rows[row]
            raise DvoError(
                f"{fields[min(clock.column, len(fields) - 1)][:40]!r} is no time",
                file=path,
                field=f"line {table.lines[row]}",
                remedy="put seconds first in each row",
            )
        if row and value <= times[row - 1]:
            raise DvoError(
                f"times must increase, but {value:.9g} follows {times[row - 1]:.9g}",
                file=path,
                field=f"line {table.lines[row]}",
                remedy="sort the rows, and remove duplicates together with their images",
            )
    if count is not None and len(times) != count:
        raise DvoError(
            f"{len(times)} rows for {count} images",
            file=path,
            field="times",
            remedy="give one row per image, or another file with --times",
        )
    if len(times) > 2 and (step := float(np.median(np.diff(times)))) < _SHORTEST:
        message = f"{1 / step:,.0f} images a second, as of times in days"
        raise DvoError(message, file=path, field="times", remedy="give seconds, or a header with the unit: 'time [ms]'")
    note = clock.note(str(path))
    if note is not None and notes is not None:
        notes.append(_with_remedy(note))
    return times


def _with_remedy(note: str) -> str:
    return f"{note} (a header such as 'time [s]' says what they are)"


def _named(table: Table, images: Sequence[Path]) -> tuple[Table, list[str], int] | None:
    """The table without the column that names images, that column, and its place; None if there is none.

    Numbers are names only if all images have one of them, beside another column.
    """
    width = min(map(len, table.rows), default=0)
    known = {image.name for image in images} | {image.stem for image in images if not image.stem.isdecimal()}
    numbers = {int(image.stem) if image.stem.isdecimal() else -1 for image in images}
    for k in range(width if width > 1 and images else 0):
        names = [PureWindowsPath(row[k]).name for row in table.rows]
        if all(name.isdecimal() and len(name) < 19 for name in names):
            names = [str(int(name)) for name in names]
            is_named = numbers <= set(map(int, names))
        else:
            found = [name for name in names if name in known and not is_number(name)]
            is_named = 2 * len(set(found)) >= len(images)
        if is_named and len(set(names)) == len(names):
            rows = [[*row[:k], *row[k + 1 :]] for row in table.rows]
            header = table.header
            header = [*header[:k], *header[k + 1 :]] if header and len(header) == len(table.rows[0]) else None
            return replace(table, rows=rows, header=header), names, k
    return None


def _times_by_name(
    table: Table, names: list[str], place: int, path: Path, images: Sequence[Path], notes: list[str] | None
) -> np.ndarray:
    rows = dict(zip(names, range(len(names)), strict=True))
    places = [
        next((rows[key] for key in (image.name, image.stem, _number(image.stem)) if key in rows), None)
        for image in images
    ]
    missing = [visible(image.name) for image, place in zip(images, places, strict=True) if place is None]
    if missing:
        shown = ", ".join(missing[:3]) + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
        raise DvoError(f"no row for {shown}", file=path, field="times", remedy="give a row for each image")
    order = sorted(range(len(names)), key=lambda row: _first_number(table.rows[row]))
    clock = clock_of_rows([table.rows[row] for row in order], table.header)
    seconds = np.empty(len(names))
    seconds[order] = clock.seconds
    bad = next((row for row in order if not abs(seconds[row]) <= MAX_NUMBER), None)  # NaN fails too
    if bad is not None:
        raise DvoError("no time beside the name", file=path, field=f"line {table.lines[bad]}",
                       remedy="give a name and seconds in each row")  # fmt: skip
    found = seconds[np.array(places, dtype=np.int64)]
    if notes is not None:
        if len(names) > len(images):
            others = f"{len(names) - len(images)} of the {len(names)} rows"
            notes.append(f"{others} of {path} name images that are not there")
        note = replace(clock, column=clock.column + (clock.column >= place)).note(str(path))
        if note is not None:
            notes.append(_with_remedy(note))
    return found


def _number(stem: str) -> str:
    return str(int(stem)) if stem.isdecimal() and len(stem) < 19 else stem


def _first_number(row: Sequence[str]) -> float:
    return next((float(field) for field in row if is_number(field)), 0.0)


def in_order(images: list[Path], times: np.ndarray) -> tuple[list[Path], np.ndarray]:
    """Images in the order of their times, which a list that names them may state in another one than their names.

    Args:
        images: ``N`` files.
        times: ``(N,)`` seconds.
    """
    order = np.argsort(times, kind="stable")
    return [images[k] for k in order], times[order]


def times_from_names(paths: list[Path], notes: list[str] | None = None) -> np.ndarray | None:
    """Read times from file names.

    Args:
        paths: ``N`` files.
        notes: receives a sentence if the times are no plain seconds or nanoseconds.

    Returns:
        ``(N,)`` float64 seconds if every stem is a stamp (``1305031102.175304``, ``left_1403636579763555584``,
        ``IMG_20240131_235959123``), see :func:`dvo.data.files.clock.clock_of_names`; else None.
    """
    clock = clock_of_names([re.sub(r"(?<=[0-9]{16})_[01]$", "", path.stem) for path in paths])
    if clock is None:
        return None
    note = clock.note("the file names") if clock.unit not in ("s", "ns") or clock.zeros else None
    if note is not None and notes is not None:
        notes.append(note)
    return clock.seconds


def without_order(paths: Sequence[Path]) -> str | None:
    """Note about names whose order is no order of time: words, and random numbers.

    Args:
        paths: files, in the order in which they are read.

    Returns:
        A sentence; None for names that count, in decimal or hexadecimal digits.
    """
    stems = [path.stem for path in paths]
    kinds = {re.sub(r"[0-9]+", "*", stem) for stem in stems}
    if len(stems) < _LEAST or 2 * len(kinds) <= len(stems):
        return None
    if all(re.fullmatch(r"[0-9a-fA-F]{1,15}", stem) for stem in stems) and len({len(stem) for stem in stems}) == 1:
        steps = np.diff(np.sort(np.array([int(stem, 16) for stem in stems], dtype=np.float64)))
        usual = float(np.median(steps))
        if usual <= _COUNTS and float(steps.max()) <= _UNEVEN * usual:
            return None
    first = ", ".join(visible(path.name) for path in paths[:2])
    return (
        f"the names do not tell in which order the images were taken: they are read in that of the names, {first}, ... "
        "(--times FILE with a name and a time in each row says otherwise)"
    )


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


def _beside(folder: Path, name: str) -> Path | None:
    """List of times beside images or one level up."""
    return next((place / name for place in (folder, folder.parent) if is_file(place / name)), None)


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
    ``timestamps.txt`` at the same places, ``fallback()``, ``fps``, and last an assumed rate, with a warning.

    Args:
        paths: the images, in order.
        folder: where ``times.txt`` is looked for, and in its parent.
        times: file that the user named.
        fps: rate that the user named.
        warnings: receives guesses and options that were not used, a sentence each.
        fallback: times that the data set offers, e.g. those of its ground truth.

    Returns:
        ``(len(paths),)`` float64 seconds; may hold duplicates when they come from names, and in another order than
        ``paths`` when a list names these (:func:`in_order`).

    Raises:
        DvoError: see :func:`read_times`; a rate that is not positive.
    """
    fps = checked_rate(fps)
    if times is not None:
        return read_times(times, len(paths), warnings, paths)
    found, origin = None, ""
    beside = _beside(folder, "times.txt")
    if beside is not None:
        found, origin = read_times(beside, len(paths), warnings, paths), str(beside)
    if found is None:
        found, origin = times_from_names(paths, warnings), "the file names"
    if found is None and (beside := _beside(folder, "timestamps.txt")) is not None:
        found, origin = read_times(beside, len(paths), warnings, paths), str(beside)
    if found is None:
        found, origin = fallback(), "the ground truth"
    if found is not None:
        if fps is not None:
            warnings.append(f"--fps was not used: the times come from {origin}")
        return found
    warnings += filter(None, [without_order(paths)])
    if fps is None:
        warnings.append(f"no times found: assuming {NOMINAL_FPS:g} frames a second (give --times FILE or --fps F)")
    return np.arange(len(paths)) / (fps or NOMINAL_FPS)
