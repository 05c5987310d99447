"""Times as files and names state them, to seconds: which column holds them, and in which unit.

One rule for all readers. A header that names the column and its unit is believed. Otherwise the unit is the one in
which the numbers are dates of this age (seconds since 1970) with usual intervals, or else the one in which the interval
from one to the next is that of a camera.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.files import MAX_NUMBER, fields_of, read_lines

PARTS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""Units of time, each by how many make a second."""
NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds", "date": "dates"}

_EPOCH = (5e8, 5e9)  # seconds since 1970: years 1985 to 2128
_USUAL = (1e-5, 10.0)  # seconds between images or poses on such a clock
_DECIMAL_SECONDS = 8.0  # interval of decimal numbers from which they are milliseconds: 125 images a second
_WHOLE_SECONDS = 5.0  # of whole numbers that do not all have the same interval
_POSE_SECONDS = 1000.0  # of poses, which may be those of keyframes
_EVEN = 0.25  # share of the usual interval that a camera keeps
_SLOWEST = 2.0  # seconds: an interval above it is one of a finer unit
_COUNTER = 10.0  # largest interval of numbers that count images
_LEAST = 8  # times that show a pattern
_SHORTEST = 1e-3  # seconds between images
_DIGITS = 19  # of an integer of 64 bits
_TICKS = 10**7  # a second, of Windows and .NET
_TICK_EPOCHS = (11_644_473_600, 62_135_596_800)  # seconds from the years 1601 and 1 to 1970

_DATE = re.compile(
    r"(?<![0-9])((?:19|20)[0-9]{2})([-_.:/]?)(0[1-9]|1[0-2])\2(0[1-9]|[12][0-9]|3[01])[T _.-]{0,3}"
    r"([01][0-9]|2[0-3])([-_.:h]?)([0-5][0-9])[-_.:m]?([0-5][0-9]|60)"
    r"(?:[.,]([0-9]{1,9})|[-_:s]?([0-9]{3}|[0-9]{6}|[0-9]{9}))?(?![0-9])"
    r"(?:( ?[-+][01][0-9]:[0-5][0-9]|(?:\+| \+| -)[01][0-9][0-5][0-9])(?![0-9:]))?"  # names of images end in -0001
)
_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?")
_UNIT = re.compile(r"[\[(]\s*([a-zµμ]+)\s*[\])]")
_SPELLED = {
    "s": "s", "sec": "s", "secs": "s", "second": "s", "seconds": "s",
    "ms": "ms", "msec": "ms", "msecs": "ms", "millis": "ms", "millisecond": "ms", "milliseconds": "ms",
    "us": "us", "µs": "us", "μs": "us", "usec": "us", "usecs": "us", "micros": "us", "microsecond": "us",
    "microseconds": "us", "ns": "ns", "nsec": "ns", "nsecs": "ns", "nanos": "ns", "nanosec": "ns", "nanosecs": "ns",
    "nanosecond": "ns", "nanoseconds": "ns",
}  # fmt: skip
_TIMES = {"time", "times", "timestamp", "timestamps", "stamp", "stamps", "ts", "t", "date", "datetime"}


@dataclass(frozen=True)
class Clock:
    """Times of rows.

    Attributes:
        seconds: ``(N,)`` float64; NaN of a row that holds no time.
        unit: of the numbers, a key of :data:`NAMES`.
        column: of a table that they stand in, from 0.
        zeros: fractions of seconds were written without their leading zeros.
    """

    seconds: np.ndarray
    unit: str
    column: int = 0
    zeros: bool = False

    def note(self, origin: str) -> str | None:
        """Sentence about an interpretation that a person should see; None for plain seconds.

        Args:
            origin: what the times come from.
        """
        where = f", column {self.column + 1}" if self.column else ""
        if self.zeros:
            return f"fractions of seconds of {origin} have lost their leading zeros, and are read with them"
        if self.unit == "s" and not where:
            return None
        text = f"times of {origin}{where} are taken for {NAMES[self.unit]}"
        times = self.seconds[np.isfinite(self.seconds)]
        if len(times) > 1 and times[-1] > times[0]:
            text += f": {times[-1] - times[0]:.6g} s, {(len(times) - 1) / (times[-1] - times[0]):.4g} a second"
        return text


@dataclass(frozen=True)
class Table:
    """Rows of a text or CSV file.

    Attributes:
        rows: fields of each.
        lines: their numbers, from 1.
        header: names of the columns: a first row of words, or else the last comment before the rows if it has as many
            parts as the first row; None for none.
        is_comment: the header is a comment, which need not be one.
    """

    rows: list[list[str]]
    lines: list[int]
    header: list[str] | None = None
    is_comment: bool = False


def read_table(path: Path, remedy: str, field: str | None = None) -> Table:
    """Read a table with its header.

    Args:
        path: see :func:`dvo.data.files.files.read_rows`.
        remedy, field: for messages.

    Raises:
        DvoError: as :func:`dvo.data.files.files.read_rows`.
    """
    rows: list[list[str]] = []
    lines: list[int] = []
    header: list[str] | None = None
    is_comment = True
    for number, line in read_lines(path, remedy, field):
        fields = fields_of(line)
        if fields and not rows and is_comment and _is_header(fields):
            header, is_comment = header_cells(line), False
        elif fields:
            rows.append(fields)
            lines.append(number)
        elif not rows and is_comment and line.strip():
            header = header_cells(line)
    if header and rows and header[0] == "" and len(header) > len(rows[0]):
        header = header[1:]
    if not rows or (header is not None and is_comment and len(header) != len(rows[0])):
        header = None
    return Table(rows, lines, header, is_comment)


def _is_header(fields: Sequence[str]) -> bool:
    """True for words alone; ``nan`` and numbers out of bounds are none."""
    return not any(is_number(field) for field in fields) and parse_date(" ".join(fields)) is None


def parse_time(text: str) -> int | float:
    """Parse a number of any unit of time, integers exactly; ticks of Windows and .NET become nanoseconds since 1970.

    Args:
        text: decimal number.

    Raises:
        ValueError: no number, not finite, or one that is no time in any unit.
    """
    if len(text) <= _DIGITS + 1 and text.removeprefix("-").isascii() and text.removeprefix("-").isdigit():
        whole = int(text)
        for epoch in _TICK_EPOCHS:  # as nanoseconds they would be dates of 1974 and 1990
            if _is_epoch(whole / _TICKS - epoch, 1):
                return 100 * (whole - epoch * _TICKS)
        if abs(whole) < 2**63:
            return whole
        raise ValueError("out of bounds")
    value = float(text)
    if not abs(value) <= MAX_NUMBER and not any(_is_epoch(value, parts) for parts in PARTS.values()):  # NaN too
        raise ValueError("out of bounds")
    return value


def is_number(text: str) -> bool:
    """True also for what is not finite.

    Args:
        text: any.
    """
    try:
        float(text)
    except ValueError:
        return False
    return True


def unit_of(values: Sequence[int | float], *, poses: bool = False) -> str:
    """Unit of numbers that are times, in their order.

    Args:
        values: the numbers; those with a decimal point are float.
        poses: of poses, whose intervals may be longer than those of images.

    Returns:
        Key of :data:`PARTS`.
    """
    numbers = np.array(values, dtype=np.float64)
    steps = np.abs(np.diff(numbers))
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) else None
    size = float(np.median(np.abs(numbers))) if len(numbers) else 0.0
    for unit, parts in PARTS.items():
        if _is_epoch(size, parts) and (step is None or _USUAL[0] <= step / parts <= _USUAL[1]):
            return unit
    whole = all(isinstance(value, int) for value in values)
    if step is None:
        return "ns" if whole and size > MAX_NUMBER else "s"
    if poses:
        longest = _POSE_SECONDS if whole or (numbers % 1 == 0).all() else np.inf
    elif not whole:
        longest = np.inf if _is_epoch(size, 1) else _DECIMAL_SECONDS
    else:
        longest = _WHOLE_SECONDS if (steps == steps[0]).all() else _SLOWEST
    is_even = float(np.quantile(steps, 0.1)) >= _EVEN * step  # frames that are dropped make intervals longer only
    if step < longest or (step < _POSE_SECONDS and not is_even):
        return "s"
    return next((unit for unit in ("ms", "us") if step / PARTS[unit] < _SLOWEST), "ns")


def with_zeros(texts: Sequence[str]) -> list[float] | None:
    """Seconds since 1970 of texts ``seconds.nanoseconds`` without the zeros that nanoseconds begin with.

    Programs that put a point between two numbers write 7.000000003 as 7.3. Such times are uneven, and even with zeros.

    Args:
        texts: numbers, in any order.

    Returns:
        None for decimal numbers as they should be.
    """
    parts = [text.split(".") for text in texts]
    if len(texts) < _LEAST or not all(len(part) == 2 and all(map(str.isdecimal, part)) for part in parts):
        return None
    digits = max(len(part[1]) for part in parts)
    if digits not in (6, 9) or not all(len(part[0]) < _DIGITS and _is_epoch(int(part[0]), 1) for part in parts):
        return None
    padded = [int(whole) + int(rest) / 10**digits for whole, rest in parts]
    if padded == (plain := [float(text) for text in texts]):
        return None
    uneven, even = (np.diff(np.sort(values)) for values in (plain, padded))
    usual = float(np.median(even))
    is_even = (even > 0.5 * usual).all() and float(np.quantile(even, 0.9)) < 2 * usual
    return padded if is_even and even.std() < 0.5 * uneven.std() else None


def refuse_lost_zeros(texts: Sequence[str], file: Path) -> None:
    """Refuse times of a file whose fractions have lost their leading zeros, see :func:`with_zeros`.

    Args:
        texts: the times.
        file: that they come from.

    Raises:
        DvoError: they have.
    """
    if with_zeros(texts) is not None:
        message = "fractions of seconds that have lost their leading zeros, such as 7.3 for 7.000000003"
        raise DvoError(message, file=file, field="times", remedy="write nanoseconds with nine digits")


def unit_of_dates(values: Sequence[int | float] | np.ndarray) -> str | None:
    """Unit in which numbers are dates of this age (since 1970); None for other numbers.

    Args:
        values: the numbers.
    """
    size = float(np.median(np.abs(np.array(values, dtype=np.float64)))) if len(values) else 0.0
    return next((unit for unit, parts in PARTS.items() if _is_epoch(size, parts)), None)


def in_seconds(values: Sequence[int | float], unit: str) -> np.ndarray:
    """Seconds of numbers in a unit.

    Args:
        values: the numbers; integers are divided exactly.
        unit: key of :data:`PARTS`.

    Returns:
        ``(N,)`` float64.
    """
    return np.array([value / PARTS[unit] for value in values], dtype=np.float64)


def parse_date(text: str) -> float | None:
    """Seconds since 1970 (UTC) of the date and time in a text, such as ``IMG_20240131_235959123``.

    Args:
        text: any; year, month, day, hour, minute and second, and perhaps a fraction, and hours and minutes from UTC.

    Returns:
        None if there is none.
    """
    found = _DATE.search(text)
    if found is None:
        return None
    year, month, day, hour, minute, second = (int(found[k]) for k in (1, 3, 4, 5, 7, 8))
    try:
        moment = datetime(year, month, day, hour, minute, min(second, 59), tzinfo=UTC).timestamp()
    except ValueError:  # 31 April
        return None
    fraction = found[9] or found[10]
    if found[11]:
        sign, digits = found[11].strip()[0], found[11].strip()[1:].replace(":", "")
        moment -= (60 * int(digits[:2]) + int(digits[2:])) * (-60 if sign == "-" else 60)
    return moment + (second == 60) + (int(fraction) / 10 ** len(fraction) if fraction else 0.0)


def clock_of_rows(rows: Sequence[Sequence[str]], header: Sequence[str] | None = None) -> Clock:
    """Times of a table: those of the column that a header names, else of the first that can be times.

    The first column is passed over if it counts rows or holds words, and another one increases strictly, so that
    ``number time exposure`` and ``name time`` are read. Seconds and nanoseconds may stand in two columns.

    Args:
        rows: fields of each row.
        header: names of the columns; None for none.

    Returns:
        The times; NaN for a row without a number in that column.
    """
    dates = [parse_date(" ".join(row[:2])) if row and not _is_value(row[0]) else None for row in rows]
    if rows and all(date is not None for date in dates):
        return Clock(np.array(dates, dtype=np.float64), "date")
    width = min((len(row) for row in rows), default=0)
    columns = [[_parsed(row[k]) for row in rows] for k in range(width)]
    named = None if header is None or len(header) != width else named_times(header)
    if named is not None:
        column, unit, rest = named
        if rest is not None:
            return _two(columns, column, rest, parts_of(header or (), rest))
        values = _known(columns[column])
        return _clock(columns[column], unit or unit_of(values), column)
    column = _time_column(columns)
    parts = _parts_of_rest(columns)
    if parts is not None:
        return _two(columns, 0, 1, parts)
    return _clock(columns[column] if columns else [None] * len(rows), None, column)


def clock_of_names(stems: Sequence[str]) -> Clock | None:
    """Times that names of files state.

    Names are dates, or they hold one number that is a time: one with a decimal point, one that is a date of this age in
    some unit, an integer of 16 digits, or one that increases by thousands. A number of a frame is no time.

    Args:
        stems: names without extension, in any order.

    Returns:
        None if they state none, or if most names share their time with another one (dates to the second).
    """
    if not stems:
        return None
    dates = [parse_date(stem) for stem in stems]
    if all(date is not None for date in dates):
        found = Clock(np.array(dates, dtype=np.float64), "date")
        return found if 2 * len(set(dates)) > len(dates) else None
    fields = [_NUMBER.findall(stem) for stem in stems]
    shapes = {_NUMBER.sub("#", stem) for stem in stems}
    if not all(stem.isascii() for stem in stems) or len(shapes) != 1:
        return None
    varying = [k for k in range(len(fields[0])) if len({row[k] for row in fields}) > 1] or [0][: len(fields[0])]
    if len(varying) == 1 and varying[0]:
        pair = [varying[0] - 1, varying[0]]
        rows = sorted(tuple(_parsed(row[k]) or 0 for k in pair) for row in fields)
        varying = pair if _parts_of_rest(list(zip(*rows, strict=True))) else varying  # in one second
    columns = [[_parsed(row[k]) for row in fields] for k in varying]
    if not columns or any(value is None for column in columns for value in column):
        return None
    order = sorted(range(len(stems)), key=lambda i: tuple(column[i] for column in columns))
    ordered = [[column[i] for i in order] for column in columns]
    parts = _parts_of_rest(ordered)
    if parts is not None:
        return Clock(_two(columns, 0, 1, parts).seconds, "s")
    if len(columns) > 2:
        return None
    chosen = _time_column(ordered)
    mended = with_zeros([row[varying[chosen]] for row in fields])
    if mended is not None:
        return Clock(np.array(mended), "s", zeros=True)
    values = [value for value in ordered[chosen] if value is not None]
    unit = _unit_of_names(values, shapes == {"#"})
    return None if unit is None else Clock(_seconds(columns[chosen], unit), unit)


def header_cells(line: str) -> list[str]:
    """Names of the columns in a line, a unit in brackets with its name.

    Args:
        line: with or without the mark of a comment.
    """
    text = re.sub(r"\s+(?=[\[(])", "", line.strip().lstrip("#%").split("#", 1)[0].strip())
    cells = re.split(r"[,;\t]", text) if re.search(r"[,;\t]", text) else text.split()
    names = [cell.strip().strip('"').strip() for cell in cells]
    return names[:1] + [name for name in names[1:] if name]  # the first, of the numbers of rows, may be empty


def unit_of_name(name: str) -> str | None:
    """Unit that the name of a column states, such as ``time [ms]`` or ``stamp_ns``; None for none.

    Args:
        name: of a column.
    """
    text = name.lower()
    bracket = _UNIT.search(text)
    if bracket is not None:
        return _SPELLED.get(bracket[1])
    words = re.split(r"[^a-zµμ]+", text)
    return next((_SPELLED[word] for word in reversed(words) if word in _SPELLED), None)


def named_times(header: Sequence[str]) -> tuple[int, str | None, int | None] | None:
    """Columns of a table that hold times.

    Args:
        header: names of the columns.

    Returns:
        Column of the times, their unit if it is stated, and the column of nano-, micro- or milliseconds beside seconds
        (:func:`parts_of`), None for none; None if no name is that of times.
    """
    found = [k for k, name in enumerate(header) if is_time_name(name)]
    found.sort(key=lambda k: not {"header", "stamp"} <= set(_words(header[k])))  # of ROS, before that of arrival
    if not found:
        return None
    units = [unit_of_name(header[k]) for k in found]
    is_whole = units[0] == "s" and not set(_words(header[found[0]])) & {"time", "timestamp"}
    if len(found) > 1 and is_whole and units[1] in ("ns", "us", "ms"):
        return found[0], None, found[1]
    return found[0], units[0], None


def parts_of(header: Sequence[str], column: int) -> int:
    """How many of the unit of a column make a second.

    Args:
        header: names of the columns.
        column: one whose name states its unit.
    """
    return PARTS[unit_of_name(header[column]) or "ns"]


def is_time_name(name: str) -> bool:
    """True for the name of a column of times.

    Args:
        name: of a column.
    """
    words = set(re.split(r"[^a-zµμ]+", _UNIT.sub("", name.lower())))
    return bool(words & _TIMES or words & set(_SPELLED)) and not words & {"exposure", "exp", "duration"}


def _is_epoch(value: float, parts: int) -> bool:
    return _EPOCH[0] * parts <= value < _EPOCH[1] * parts


def _is_value(text: str) -> bool:
    return _parsed(text) is not None


def _parsed(text: str) -> int | float | None:
    try:
        return parse_time(text)
    except ValueError:
        return None


def _known(column: Sequence[int | float | None]) -> list[int | float]:
    return [value for value in column if value is not None]


def _seconds(column: Sequence[int | float | None], unit: str) -> np.ndarray:
    return np.array([np.nan if value is None else value / PARTS[unit] for value in column], dtype=np.float64)


def _clock(column: Sequence[int | float | None], unit: str | None, number: int) -> Clock:
    unit = unit or unit_of(_known(column))
    return Clock(_seconds(column, unit), unit, number)


def _two(columns: Sequence[Sequence[int | float | None]], whole: int, rest: int, parts: int) -> Clock:
    """Times of a column of seconds and one of parts of them."""
    pairs, factor = zip(columns[whole], columns[rest], strict=True), 10**9 // parts
    joined = [None if a is None or b is None else int(a) * 10**9 + int(b) * factor for a, b in pairs]
    return Clock(_seconds(joined, "ns"), "s", whole)


def _words(name: str) -> list[str]:
    return re.split(r"[^a-z]+", name.lower())


def _increases(column: Sequence[int | float | None]) -> bool:
    values = _known(column)
    return len(values) == len(column) > 1 and all(a < b for a, b in zip(values, values[1:], strict=False))


def _counts(column: Sequence[int | float | None]) -> bool:
    """True for whole numbers that count rows."""
    values = _known(column)
    if len(values) < len(column) or not all(isinstance(value, int) for value in values):
        return False
    if len(values) < 2:
        return values[0] < 10**6 if values else False
    return 0 < float(np.median(np.diff(np.array(values, dtype=np.float64)))) <= _COUNTER


def _time_column(columns: Sequence[Sequence[int | float | None]]) -> int:
    if not columns or not (_counts(columns[0]) or all(value is None for value in columns[0])):
        return 0
    for k, column in enumerate(columns[1:], 1):
        if len(column) == 1 and column[0] is not None and any(_is_epoch(column[0], p) for p in PARTS.values()):
            return k
        if _increases(column) and not _counts(column):
            return k
    return 0


def _parts_of_rest(columns: Sequence[Sequence[int | float | None]]) -> int | None:
    """Parts of a second in a column behind one of whole seconds since 1970; None for other columns.

    Nanoseconds, microseconds or milliseconds by the largest one. A number that counts the images of a second, or all of
    them, is none.
    """
    if len(columns) < 2 or len(columns[0]) < 2:
        return None
    whole, rest = columns[:2]
    if not all(isinstance(value, int) and _is_epoch(value, 1) for value in whole):
        return None
    if not all(isinstance(value, int) and 0 <= value < 10**9 for value in rest):
        return None
    pairs = [(int(a or 0), int(b or 0)) for a, b in zip(whole, rest, strict=True)]
    if not len(set(pairs)) == len(pairs) > len(set(whole)):
        return None
    high = max(b for _, b in pairs)
    parts = PARTS["ns" if high > 10**6 else "us" if high >= 10**3 else "ms"]
    if parts == PARTS["ns"]:
        return parts
    steps = [second[1] - first[1] for first, second in zip(pairs, pairs[1:], strict=False) if first[0] == second[0]]
    begins_anew = any(second[1] < first[1] for first, second in zip(pairs, pairs[1:], strict=False))
    is_even = float(np.median(steps)) >= max(2.0, _SHORTEST * parts)
    return parts if is_even and (begins_anew or 2 * high >= parts) else None


def _unit_of_names(values: Sequence[int | float], bare: bool) -> str | None:
    """Unit of numbers in names, in increasing order; None for numbers of frames."""
    unit = unit_of(values)
    numbers = in_seconds(values, unit)
    if any(isinstance(value, float) for value in values):
        if not all(isinstance(value, float) for value in values):
            return None
        fastest = len(numbers) > 1 and float(np.median(np.diff(numbers))) >= 1e-3
        return unit if bare or fastest else None
    if any(_is_epoch(float(np.median(values)), parts) for parts in PARTS.values()):
        return unit if unit != "s" or min(values) >= 10**9 else None
    if min(values) >= 10**15:
        return "ns" if unit == "s" else unit
    steps = np.diff(np.array(values, dtype=np.float64))
    return unit if len(steps) and float(np.median(steps)) >= 1000 * _SLOWEST else None
