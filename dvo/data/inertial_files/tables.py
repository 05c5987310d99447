"""Inertial samples of text tables: EuRoC and TUM-VI, the usual applications of phones, and any table with a header that
names time, gyroscope and accelerometer.

The header decides which column is which, and the units if it states them. A unit of time that is not stated is the one
in which the samples come at the rate of an inertial sensor; one of the accelerometer the one in which the median of its
norm is that of gravity; one of the gyroscope the one in which gravity turns in the accelerometer as it says.
"""

from __future__ import annotations

import contextlib
import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.clock import NAMES, PARTS, is_number, parse_date, parse_time, unit_of_dates, unit_of_name
from dvo.data.files.files import MAX_NUMBER, is_file, read_lines
from dvo.data.inertial import InertialSamples
from dvo.data.inertial_files.columns import (
    NAMED,
    RATE_UNITS,
    Columns,
    columns_of,
    first_instance,
    time_columns,
    with_units,
    without_gravity,
)
from dvo.data.inertial_files.readings import REMEDY as JSON_REMEDY
from dvo.data.inertial_files.readings import SENSOR_LOGGER, Readings, by_sensor, read_json
from dvo.data.inertial_files.tidy import GRAVITY_RANGE, STANDARD_GRAVITY, check_gravity, joined, tidy

RATES = (15.0, 5000.0)
"""Samples a second of an inertial sensor; the units of time differ by more than the ratio."""
SLOW = 1.0
"""Samples a second from which slower ones are those of a logger, and not of another unit."""
TURN_RATIO = (0.13, 7.5)
"""Turn of gravity over that of the gyroscope: half way to another unit."""
REMEDY = (
    "give a table whose header names time, gyroscope and accelerometer with their units, such as "
    "'time [ns], gx [rad/s], gy [rad/s], gz [rad/s], ax [m/s^2], ay [m/s^2], az [m/s^2]'"
)

_APPLE = re.compile(r"alpha_[xyz]$|accelerometerAcceleration[XYZ]")  # Stray Scanner, SensorLog: g at rest points down
_PARTNERS = ("TotalAcceleration", "AccelerometerUncalibrated", "Accelerometer")  # of Sensor Logger, in this order
_XSENS = {"0.1 ms": 10**4, "us": 10**6}  # units of SampleTimeFine, of MT and of DOT
_SMOOTH = 0.2  # seconds over which gravity is averaged where it is compared with the gyroscope
_TELLS = 0.3  # share of the change of gravity that the gyroscope explains
_FASTEST = 20.0  # rad/s: numbers of the gyroscope that exceed it are degrees
_PREAMBLE = 100  # lines among which the header is
_FEWEST_NUMBERS = 3  # in the first row of samples
_BRIEF = 2.0  # seconds: a recording that would be shorter is rather one of a slower logger in another unit
_REPEATS = 0.3  # share of repeated times that is told beside a wrong rate
_NO_GRAVITY = "record the accelerometer with gravity (TotalAcceleration), or Gravity too, not the linear acceleration"


@dataclass(frozen=True)
class _Sensor:
    """Samples of one sensor as they stand in a file.

    Attributes:
        times: ``(K,)`` seconds.
        values: ``(K, 3)`` in the unit of the file; NaN for what is not finite or out of bounds.
        factor: of the stated unit to the standard one; None for none.
    """

    times: np.ndarray
    values: np.ndarray
    factor: float | None

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", np.where(np.abs(self.values) <= MAX_NUMBER, self.values, np.nan))


@dataclass(frozen=True)
class _Text:
    """Rows of numbers of a text file.

    Attributes:
        header: names of the columns; empty for none.
        table: ``(K, C)`` float64, NaN for what is no number.
        rows: the same as text, for times.
        notes: repairs.
    """

    header: list[str]
    table: np.ndarray
    rows: list[list[str]]
    notes: list[str]


def read_inertial_table(path: Path, *, rough: bool = False) -> InertialSamples:
    """Read inertial samples of a text file; where it holds one sensor, those of the other from the file beside it.

    Args:
        path: ``.csv`` or ``.txt`` with a row for each time or each reading, ``.json`` of Sensor Logger, ``.jsonl`` of
            Spectacular AI, or a folder with a file for each sensor.
        rough: as they stand, for a check: neither sorted nor refused, and numbers whose unit is not stated or clear are
            left as they are.

    Raises:
        DvoError: no such file; a table in which the columns, or the units, are not clear; an accelerometer from which
            gravity was removed; see :func:`dvo.data.inertial_files.tidy.tidy`.
    """
    if path.is_dir():
        path = _in_folder(path)
    if path.suffix.lower() == ".jsonl":
        sensors, notes = _json_lines(path), list[str]()
        where = path.name
    else:
        sensors, notes = _of_text(path, rough)
        where = path.name
        if len(sensors) == 1:
            partner = _partner(path, next(iter(sensors)))
            others, more = _of_text(partner, rough)
            where, notes = f"{path.name} and {partner.name}", [*notes, *more]
            sensors |= {name: sensor for name, sensor in others.items() if name not in sensors}
    for name in ("gyro", "accel"):
        if name not in sensors:
            raise DvoError(f"no columns of the {_noun(name)}", file=path, field=name, remedy=REMEDY)
        if not np.isfinite(sensors[name].values).all(axis=1).any():
            raise DvoError(f"no row with three numbers of the {_noun(name)}", file=path, field=name, remedy=REMEDY)
    gyro, accel = sensors["gyro"], sensors["accel"]
    if rough:
        force, rate = accel.factor or 1.0, gyro.factor or 1.0
        with contextlib.suppress(DvoError):
            force, _ = _force_unit(accel, path)
            rate, _ = _rate_unit(gyro, replace(accel, values=accel.values * force), path)
    else:
        force, told = _force_unit(accel, path)
        notes += told
        rate, told = _rate_unit(gyro, replace(accel, values=accel.values * force), path)
        notes += told
    values = accel.values * force
    if gyro.times is accel.times:
        samples = tidy(gyro.times, gyro.values * rate, values, path, where, rough=rough)
    else:
        samples = joined(gyro.times, gyro.values * rate, accel.times, values, path, where, rough=rough)
    if rough:
        return samples
    check_gravity(samples, path, "give the accelerometer with gravity in m/s^2, or its unit in the header")
    return replace(samples, notes=(*notes, *samples.notes))


def _noun(sensor: str) -> str:
    return "gyroscope" if sensor == "gyro" else "accelerometer"


def _in_folder(folder: Path) -> Path:
    """File of the gyroscope in a folder, or the one of both sensors."""
    names = sorted(child for child in folder.iterdir() if child.suffix.lower() in (".csv", ".txt", ".jsonl"))
    gyros = [name for name in names if re.search(r"gyr", name.stem, re.IGNORECASE)]
    calibrated = [name for name in gyros if "uncal" not in name.stem.lower()] or gyros
    whole = [name for name in names if name.stem.lower() in ("imu", "gyro_accel", "data")]
    found = whole or calibrated
    if len(found) != 1:
        what = "several files of a gyroscope" if found else "no file of a gyroscope"
        raise DvoError(f"{what} in it", file=folder, field="imu", remedy="give the file to --imu")
    return found[0]


def _partner(path: Path, sensor: str) -> Path:
    """File of the accelerometer beside that of the gyroscope, or the other way round."""
    words = {"gyro": r"gyroscope|gyrometer|gyro|gyr", "accel": r"accelerometer|acceleration|accel|accl|acce|acc"}
    other = "accel" if sensor == "gyro" else "gyro"
    shape = re.sub(words[sensor], "*", path.stem, count=1, flags=re.IGNORECASE).lower()
    there = sorted(child for child in path.parent.iterdir() if child.suffix.lower() == path.suffix.lower())
    names = _PARTNERS if other == "accel" else ("Gyroscope",)
    preferred = [child for name in names for child in there if child.stem == name]
    found = [child for child in there if re.sub(words[other], "*", child.stem, count=1, flags=re.IGNORECASE).lower()
             == shape and child != path and re.search(words[other], child.stem, re.IGNORECASE)]  # fmt: skip
    if preferred and path.stem in ("Gyroscope", *_PARTNERS):
        found = preferred[:1]
    if len(found) != 1:
        what = "several files" if found else "no file"
        message = f"only the {_noun(sensor)} in it, and {what} of the {_noun(other)} beside it"
        linear = [] if found or other != "accel" else [*without_gravity(_text(path).header)[:1], *_linear(there)]
        if linear:
            message = f"gravity was removed from {linear[0]}, and there is no other accelerometer"
            raise DvoError(message, file=path, field=other, remedy=_NO_GRAVITY)
        raise DvoError(message, file=path, field=other, remedy=REMEDY)
    return found[0]


def _linear(files: Sequence[Path]) -> list[str]:
    """Names of files of an accelerometer without gravity."""
    return [file.name for file in files if re.search(r"(lin|user).*acc", file.stem, re.IGNORECASE)]


def _text(path: Path) -> _Text:
    """Rows of a text file, their cells apart by commas, semicolons or tabs, or else by blanks."""
    lines = [line.strip("\r\n ") for _, line in read_lines(path, REMEDY, "imu") if line.strip()]
    if lines and re.fullmatch(r"sep=.", lines[0]):  # told to a spreadsheet
        lines = lines[1:]
    marks = ("#", "%", "//")
    comments = [line.lstrip("#%/ ") for line in lines if line.startswith(marks)]
    rows = [line for line in lines if not line.startswith(marks)]
    if not rows:
        raise DvoError("no rows in it", file=path, field="imu", remedy=REMEDY)
    mark = next((mark for mark in ("\t", ";", ",") if mark in rows[-1]), None)

    def cells(line: str) -> list[str]:
        if mark and '"' in line:  # a mark within quotes is none
            return [cell.strip() for cell in next(csv.reader([line], delimiter=mark, skipinitialspace=True))]
        return [cell.strip().strip('"') for cell in (line.split(mark) if mark else line.split())]

    def names(line: str) -> list[str]:
        if mark and mark in line:
            return cells(line)
        return [cell for cell in re.split(r"[,;\t]\s*|\s{2,}|\s(?![\[(])", line) if cell]

    header: list[str] = []
    notes: list[str] = []
    above = _header_lines([cells(row) for row in rows[:_PREAMBLE]])
    if above:
        header = names(rows[above[0]])
        if len(above) > 1:  # units have a line of their own
            header = with_units(header, cells(rows[above[1]]))
        if above[0]:
            notes.append(f"{path.name}: {above[0]} line{'s' * (above[0] > 1)} above the header not read")
        rows = rows[above[-1] + 1 :]
    elif comments:
        header = names(comments[-1])
    texts = [cells(row) for row in rows]
    if texts and all(len(row) > 1 and not row[-1] and len(row) in (len(header) + 1, len(texts[0])) for row in texts) \
            and len(texts[0]) != len(header):  # fmt: skip
        texts = [row[:-1] for row in texts]
    width = len(header) or max(map(len, texts), default=0)
    if header and texts and len(header) != max(map(len, texts)):
        message = f"the header has {len(header)} columns, the rows have {max(map(len, texts))}"
        raise DvoError(message, file=path, field="header", remedy=REMEDY)
    short = next((k for k, row in enumerate(texts[:-1]) if len(row) != width), None)
    if short is not None:
        message = f"row {short + 1} has {len(texts[short])} columns, not {width}"
        raise DvoError(message, file=path, field="rows", remedy="correct the row")
    if texts and len(texts[-1]) != width:  # a recording that was cut off
        texts = texts[:-1]
        notes.append(f"{path.name}: the last row is not whole and was dropped")
    if mark and any("," in cell for row in texts for cell in row):  # decimal commas
        texts = [[cell if "." in cell else cell.replace(",", ".") for cell in row] for row in texts]
    table = np.array([[_float(cell) for cell in row] for row in texts], dtype=np.float64).reshape(-1, width)
    return _Text(header, table, texts, notes)


def _header_lines(rows: Sequence[Sequence[str]]) -> list[int]:
    """Numbers of the line that names the columns, and of the one behind it that has their units, if there is one; empty
    if numbers begin at once."""
    numbers = [sum(is_number(cell.replace(",", ".")) for cell in row) for row in rows]
    first = next((k for k, count in enumerate(numbers) if count >= _FEWEST_NUMBERS), len(rows))
    words = [k for k in range(first) if not numbers[k]]
    if not words:
        return []
    last = words[-1]
    if last - 1 in words and len(rows[last]) == len(rows[last - 1]) and with_units(rows[last - 1], rows[last]):
        return [last - 1, last]
    return [last]


def _float(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _of_text(path: Path, rough: bool) -> tuple[dict[str, _Sensor], list[str]]:
    """Sensors in a text file, and notes."""
    about: dict[str, str] = {}
    if path.suffix.lower() == ".json":
        header, rows, about = read_json(path)
        parts, text = by_sensor(header, rows), _Text(header, np.zeros((0, 0)), rows, [])
        if not parts:
            message = "no readings of a gyroscope or an accelerometer with x, y and z"
            raise DvoError(message, file=path, field="sensor", remedy=JSON_REMEDY)
    else:
        text = _text(path)
        parts = by_sensor(text.header, text.rows)
        if not len(text.table):
            raise DvoError("no rows in it", file=path, field="imu", remedy=REMEDY)
    is_logger, is_long = SENSOR_LOGGER in text.header, bool(parts)
    if is_logger and not is_long:
        about = _metadata(path)
        if path.stem == "Accelerometer":
            files = [("Accelerometer", text)]
            files += [("Gravity", _text(file)) for file in (path.with_name("Gravity.csv"),) if is_file(file)]
            parts = [Readings.of(name, one.header, one.rows) for name, one in files]
    found, notes = _of_readings(parts, path, rough) if parts else _of_columns(text, path, rough)
    notes = [*text.notes, *notes] if parts else notes
    if len(found) < 2 and is_long:
        missing = "accelerometer" if "gyro" in found else "gyroscope"
        there = ", ".join(part.name for part in parts)[:100]
        raise DvoError(f"no readings of the {missing}, but of {there}", file=path, field="sensor", remedy=REMEDY)
    if is_logger and "accel" in found:
        if about.get("platform", "").lower() == "ios" and about.get("standardisation", "").lower() != "true":
            found["accel"] = replace(found["accel"], values=-found["accel"].values)
            notes.append(f"{path.name}: the sign of the accelerometer is Apple's and was changed")
        elif "platform" not in about and (parts or path.stem == "AccelerometerUncalibrated"):
            told = "the sign of the accelerometer is taken for Android's (dvo imu check compares it with the camera)"
            notes.append(f"{path.name}: no platform is stated: {told}")
    return found, notes


def _metadata(path: Path) -> dict[str, str]:
    """What Sensor Logger tells of a recording beside its files: names and values."""
    file = path.with_name("Metadata.csv")
    lines = [line for _, line in read_lines(file, REMEDY, "imu")] if is_file(file) else []
    return {name.strip(): value.strip() for row in list(csv.DictReader(lines))[:1] for name, value in row.items()
            if isinstance(name, str) and isinstance(value, str)}  # fmt: skip


def _of_readings(parts: Sequence[Readings], path: Path, rough: bool) -> tuple[dict[str, _Sensor], list[str]]:
    """Sensors that have rows of their own, and notes."""

    def of(part: Readings) -> tuple[_Sensor, list[str]]:
        table = np.array([[_float(cell) for cell in row] for row in part.rows], dtype=np.float64)
        sensors, told = _of_columns(_Text(part.header, table, part.rows, []), path, rough)
        return next(iter(sensors.values())), told

    found: dict[str, _Sensor] = {}
    notes = []
    kinds = {kind: sorted((part for part in parts if part.kind == kind), key=lambda part: part.rank)
             for kind in ("gyro", "accel", "linear", "gravity")}  # fmt: skip
    for kind in ("gyro", "accel"):
        if kinds[kind]:
            first, *others = kinds[kind]
            found[kind], told = of(first)
            notes += told
            if others:
                rivals = ", ".join(part.name for part in others)
                notes.append(f"{path.name}: {first.name} is taken for the {_noun(kind)}, not {rivals}"[:200])
    if kinds["linear"] and not kinds["accel"]:
        name = kinds["linear"][0].name
        if not kinds["gravity"]:
            raise DvoError(f"gravity was removed from {name}", file=path, field="accel", remedy=_NO_GRAVITY)
        (moved, told), (down, _) = of(kinds["linear"][0]), of(kinds["gravity"][0])
        times, values = _ordered(down.times, down.values)
        at = [np.interp(moved.times, times, column, np.nan, np.nan) for column in values.T]
        found["accel"] = replace(moved, values=moved.values + np.stack(at, axis=1))
        notes += [*told, f"{path.name}: the accelerometer is the sum of {name} and {kinds['gravity'][0].name}"]
    return found, list(dict.fromkeys(notes))


def _of_columns(text: _Text, path: Path, rough: bool) -> tuple[dict[str, _Sensor], list[str]]:
    """Sensors in the columns of a table, and notes."""
    if not text.header:
        return _unnamed(text, path, rough)
    kept, note = first_instance(text.header, text.rows)
    if kept is not None:
        text = replace(text, table=text.table[kept], rows=[text.rows[k] for k in kept])
        text.notes.append(f"{path.name}: {note}")
    columns = columns_of(text.header, path)
    if not columns and (linear := without_gravity(text.header)):
        raise DvoError(f"gravity was removed from {linear[0]}", file=path, field="accel", remedy=_NO_GRAVITY)
    if not columns:
        raise DvoError("no columns of a gyroscope or an accelerometer", file=path, field="header", remedy=REMEDY)
    clocks, notes = _times(text, columns, path, rough)
    found = {name: _Sensor(clocks[name], text.table[:, one.places], one.factor) for name, one in columns.items()}
    for name, one in columns.items():
        if one.rivals:
            taken = text.header[one.places[0]]
            notes.append(f"{path.name}: {taken} is taken for the {_noun(name)}, not {', '.join(one.rivals)}"[:200])
    if "accel" in found and any(_APPLE.match(name) for name in text.header):
        found["accel"] = replace(found["accel"], values=-found["accel"].values)
        notes.append(f"{path.name}: the sign of the accelerometer is Apple's and was changed")
    return _apart(found), [*text.notes, *notes]


def _apart(found: dict[str, _Sensor]) -> dict[str, _Sensor]:
    """The sensors, each at the rows that it has, where they take turns in the rows of a table."""
    rows = {name: np.isfinite(sensor.values).all(axis=1) for name, sensor in found.items()}
    if len(found) < 2 or 2 * (rows["gyro"] & rows["accel"]).sum() >= min(part.sum() for part in rows.values()):
        return found
    return {name: replace(one, times=one.times[rows[name]], values=one.values[rows[name]])
            for name, one in found.items()}  # fmt: skip


def _times(
    text: _Text, columns: dict[str, Columns], path: Path, rough: bool
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Seconds of the rows for each sensor; the same array for those with one column of times."""
    places, passed = time_columns(text.header, text.rows, columns)
    if not places:
        raise DvoError("no column of times", file=path, field="time", remedy=REMEDY)
    known: dict[int | tuple[int, int], np.ndarray] = {}
    notes = [f"{path.name}: {passed}"] if passed else []
    for place in places.values():
        if place in known:
            continue
        if isinstance(place, tuple):
            seconds, nanos = text.table[:, place[0]], text.table[:, place[1]]
            whole = np.isfinite(seconds) & np.isfinite(nanos)
            cells = [str(int(s) * PARTS["ns"] + int(n)) if ok else "" for s, n, ok in
                     zip(seconds, nanos, whole, strict=True)]  # fmt: skip
            known[place], _ = _in_seconds(cells, "ns", path, rough=rough)
            continue
        name, cells = text.header[place], [row[place] for row in text.rows]
        units = _XSENS if name.strip().lower() == "sampletimefine" else PARTS
        known[place], told = _in_seconds(cells, unit_of_name(name), path, units, rough=rough)
        notes += told
    return {name: known[place] for name, place in places.items()}, notes


def _in_seconds(
    cells: Sequence[str], unit: str | None, path: Path, units: Mapping[str, int] = PARTS, *, rough: bool = False
) -> tuple[np.ndarray, list[str]]:
    """Seconds of times as text; a cell that holds no number is NaN."""
    values: list[int | float | None] = []
    for cell in cells:
        try:
            values.append(parse_time(cell))
        except ValueError:
            values.append(None)
    known = [value for value in values if value is not None]
    if 2 * len(known) <= len(values):
        dates = [parse_date(cell) for cell in cells]
        if 2 * sum(date is not None for date in dates) <= len(dates):
            message = f"times that are neither numbers nor dates, such as {cells[0][:40]}"
            remedy = "give times in seconds to the millisecond, or finer, or dates such as 2024-05-01T12:00:00.123Z"
            raise DvoError(message, file=path, field="time", remedy=remedy)
        values, known, unit = list(dates), [date for date in dates if date is not None], "s"
        units = PARTS
    clock = _Clock.of(known, units)
    notes = []
    if unit is None:
        unit = clock.unit(path, rough=rough)
        if unit != "s":
            notes.append(f"{path.name}: times are taken for {NAMES.get(unit, unit)}")
    if not rough:
        clock.check_rate(unit, path)
    parts = units[unit]
    return np.array([math.nan if value is None else value / parts for value in values]), notes


@dataclass(frozen=True)
class _Clock:
    """Numbers that are times, in one of several units.

    Attributes:
        count: of all.
        order: ``(U,)`` each number once, increasing.
        units: numbers to a second, by name.
    """

    count: int
    order: np.ndarray
    units: Mapping[str, int]

    @staticmethod
    def of(values: Sequence[int | float], units: Mapping[str, int]) -> _Clock:
        return _Clock(len(values), np.unique(np.array([float(value) for value in values])), units)

    def rates(self) -> dict[str, float]:
        """Numbers a second by the median of the intervals, for each unit; infinite if all are one."""
        steps = np.diff(self.order)
        step = float(np.median(steps)) if len(steps) else 0.0
        return {name: parts / step if step > 0 else math.inf for name, parts in self.units.items()}

    def unit(self, path: Path, *, rough: bool) -> str:
        """Unit in which the samples come at the rate of an inertial sensor.

        Another one, in which they are as slow as some loggers, must not be as likely: in it they are dates, or in the
        first one the recording would be over at once.
        """
        rates = self.rates()
        dates = unit_of_dates(self.order) if self.units is PARTS else None
        fit = next((name for name, rate in rates.items() if RATES[0] <= rate <= RATES[1]), None)
        slow = next((name for name, rate in rates.items() if SLOW <= rate < RATES[0]), None)
        is_brief = fit is not None and self.order[-1] - self.order[0] < _BRIEF * self.units[fit]
        if fit is not None and (slow is None or (slow != dates and not is_brief)):
            return fit
        if rough:
            return slow or dates or next(iter(self.units))
        if slow is None:
            if len(self.order) < 2:
                self.check_rate("s", path)
            step = float(np.median(np.diff(self.order)))
            message = f"the unit of the times is not clear: one is {step:.6g} after the other"
            raise DvoError(message, file=path, field="time", remedy="name it in the header, such as 'time [ns]'")
        message = f"{rates[slow]:.4g} samples a second, if the unit of the times is {slow}"
        remedy = f"record at 100 to 400 a second, or name the unit in the header, such as 'time [{slow}]'"
        if fit is not None:
            both = f"{rates[slow]:.4g} samples a second in {slow}, {rates[fit]:.4g} in {fit}"
            message = f"the unit of the times is not clear: {both}"
            remedy = f"name it in the header, such as 'time [{fit}]'"
        raise DvoError(message, file=path, field="time", remedy=remedy)

    def check_rate(self, unit: str, path: Path) -> None:
        """Refuse times that are not those of an inertial sensor."""
        if self.count > 1 and len(self.order) < 2:
            message = f"times that do not increase: all {self.count} are {self.order[0]:.10g}"
            raise DvoError(message, file=path, field="time", remedy="write them with more digits")
        if len(self.order) < 2:
            raise DvoError(f"{self.count} sample", file=path, field="time", remedy="record for longer")
        rate = self.rates()[unit]
        if RATES[0] <= rate <= RATES[1]:
            return
        message = f"{rate:.4g} samples a second"
        remedy = f"give {RATES[0]:g} to {RATES[1]:g} a second, and the unit of the times in the header"
        mean = self.units[unit] * (len(self.order) - 1) / float(self.order[-1] - self.order[0])
        repeated = 1 - len(self.order) / self.count
        if rate > RATES[1] and RATES[0] <= mean <= RATES[1]:
            message = f"samples come in bursts: {mean:.4g} a second, but most are {1 / rate:.2g} s after the one before"
            remedy = "write the stamps of the sensor, not those of arrival"
        elif repeated > _REPEATS:
            message += f": {100 * repeated:.0f} % of the rows have the time of another one"
            remedy = "write times of the sensor, with more digits"
        raise DvoError(message, file=path, field="time", remedy=remedy)


def _unnamed(text: _Text, path: Path, rough: bool) -> tuple[dict[str, _Sensor], list[str]]:
    """Sensors of a file without a header: time and six numbers, the three with gravity in it being the accelerometer;
    or time and three numbers, the time first or last, in a file whose name tells the sensor."""
    width = text.table.shape[1]
    increasing = [k for k in (0, width - 1) if (np.diff(text.table[:, k]) > 0).mean() > 0.95] if len(text.rows) > 1 \
        else []  # fmt: skip
    sensor = next((kind for pattern, kind in NAMED if pattern.search(path.stem)), None)
    if len(increasing) != 1 or not (width == 7 or (width == 4 and sensor)):
        message = f"{width} columns without a header, which do not tell what they are"
        raise DvoError(message, file=path, field="header", remedy=REMEDY)
    times, notes = _in_seconds([row[increasing[0]] for row in text.rows], None, path, rough=rough)
    rest = [k for k in range(width) if k != increasing[0]]
    if width == 4:
        return {str(sensor): _Sensor(times, text.table[:, rest], None)}, [*text.notes, *notes]
    first, second = text.table[:, rest[:3]], text.table[:, rest[3:]]
    sizes = [float(np.nanmedian(np.linalg.norm(part, axis=1))) for part in (first, second)]
    with_gravity = [GRAVITY_RANGE[0] <= size <= GRAVITY_RANGE[1] for size in sizes]
    if sum(with_gravity) != 1:
        message = f"no header, and medians of the norms {sizes[0]:.3g} and {sizes[1]:.3g} do not tell the accelerometer"
        raise DvoError(message, file=path, field="header", remedy=REMEDY)
    gyro, accel = (second, first) if with_gravity[0] else (first, second)
    order = "accelerometer, gyroscope" if with_gravity[0] else "gyroscope, accelerometer"
    notes.append(f"{path.name} has no header: columns are taken for {order}")
    return {"gyro": _Sensor(times, gyro, None), "accel": _Sensor(times, accel, 1.0)}, [*text.notes, *notes]


def _force_unit(accel: _Sensor, path: Path) -> tuple[float, list[str]]:
    """Factor to m/s^2, and a note if it is a guess."""
    if accel.factor is not None:
        return accel.factor, []
    size = float(np.nanmedian(np.linalg.norm(accel.values, axis=1)))
    fit = [(name, factor) for name, factor in (("m/s^2", 1.0), ("g", STANDARD_GRAVITY), ("mg", STANDARD_GRAVITY / 1e3))
           if 0.75 <= size * factor / STANDARD_GRAVITY <= 1.3]  # fmt: skip
    if len(fit) != 1:
        what = "gravity was removed from it, or its unit is not clear"
        remedy = "give the accelerometer with gravity, and its unit in the header, such as 'ax [m/s^2]'"
        raise DvoError(
            f"the median of the accelerometer is {size:.4g}: {what}", file=path, field="accel", remedy=remedy
        )
    name, factor = fit[0]
    return factor, [f"{path.name}: the accelerometer is taken for {name} (its median is {size:.4g})"]


def _rate_unit(gyro: _Sensor, accel: _Sensor, path: Path) -> tuple[float, list[str]]:
    """Factor to rad/s, and a note if it is a guess, or if gravity turns otherwise."""
    ratio = turn_of_gravity(gyro.times, gyro.values, accel.times, accel.values)
    if gyro.factor is not None:
        if ratio is None or TURN_RATIO[0] <= ratio / gyro.factor <= TURN_RATIO[1]:
            return gyro.factor, []
        note = f"the stated unit of the gyroscope does not fit: gravity turns {ratio / gyro.factor:.3g} times as fast"
        return gyro.factor, [f"{path.name}: {note}; see dvo imu check"]
    name, reason = "rad/s", "the usual unit"
    if ratio is not None:
        name = "rad/s" if ratio > 0.13 else "deg/s"  # half way between 1 and pi / 180
        reason = "as gravity turns"
        if not TURN_RATIO[0] <= ratio / RATE_UNITS[name] <= TURN_RATIO[1]:
            message = f"the gyroscope is neither in rad/s nor in deg/s: gravity turns {ratio:.3g} times as fast"
            remedy = "name its unit in the header, such as 'gx [rad/s]'; counts of the sensor are none"
            raise DvoError(message, file=path, field="gyro", remedy=remedy)
    elif np.nanquantile(np.abs(gyro.values), 0.99) > _FASTEST:
        name, reason = "deg/s", "numbers too large for rad/s"
    return RATE_UNITS[name], [f"{path.name}: the gyroscope is taken for {name} ({reason})"]


def turn_of_gravity(
    gyro_times: np.ndarray, gyro: np.ndarray, accel_times: np.ndarray, accel: np.ndarray
) -> float | None:
    """Rate at which gravity turns in the accelerometer over the rate of the gyroscope (``da/dt = -w x a`` of a sensor
    that turns in place).

    Args:
        gyro_times: ``(K,)`` seconds, in any order.
        gyro: ``(K, 3)`` in the unit in question.
        accel_times: ``(L,)`` seconds, in any order.
        accel: ``(L, 3)`` in any unit, with gravity.

    Returns:
        1 for rad/s; None where too little of the one is explained by the other.
    """
    (a_times, a), (w_times, w) = _ordered(accel_times, accel), _ordered(gyro_times, gyro)
    if not len(a_times) or not len(w_times):
        return None
    start, end = max(a_times[0], w_times[0]), min(a_times[-1], w_times[-1])
    if not 10 * _SMOOTH <= end - start <= _SMOOTH * len(w_times):  # too short, or gaps alone
        return None
    edges = np.arange(start, end, _SMOOTH)
    means = [np.stack([_means(times, values[:, k], edges) for k in range(3)], axis=1)
             for times, values in ((a_times, a), (w_times, w))]  # fmt: skip
    forces, rates = means
    change = (forces[2:] - forces[:-2]) / (2 * _SMOOTH)
    model = -np.cross(rates[1:-1], forces[1:-1])
    power = float((model**2).sum())
    if not power > 0 or not np.isfinite(power):
        return None
    ratio = float((change * model).sum()) / power
    explained = ratio**2 * power / max(float((change**2).sum()), 1e-12)
    return ratio if ratio > 0 and explained > _TELLS else None


def _ordered(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of finite numbers in order of time, the first of each time."""
    whole = np.isfinite(times) & (np.abs(values) <= MAX_NUMBER).all(axis=1)
    found, keep = np.unique(times[whole], return_index=True)
    return found, values[whole][keep]


def _means(times: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Mean of the samples in each interval between edges; that of the curve where there is none."""
    places = np.searchsorted(times, edges)
    sums = np.append(0.0, np.cumsum(values))[places]
    counts = np.diff(places)
    middle = np.interp((edges[1:] + edges[:-1]) / 2, times, values)
    return np.where(counts > 0, np.diff(sums) / np.maximum(counts, 1), middle)


def _json_lines(path: Path) -> dict[str, _Sensor]:
    """Sensors of a file of Spectacular AI: rows ``{"time": s, "sensor": {"type": ..., "values": [x, y, z]}}``."""
    rows: dict[str, list[list[float]]] = {"gyroscope": [], "accelerometer": []}
    for number, line in read_lines(path, REMEDY, "imu"):
        if not line.strip():
            continue
        try:
            entry = json.loads(line)
            sensor = entry.get("sensor")
            if isinstance(sensor, dict) and sensor.get("type") in rows:
                x, y, z = (float(value) for value in sensor["values"])
                rows[sensor["type"]].append([float(entry["time"]), x, y, z])
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            raise DvoError("no row of Spectacular AI's data.jsonl", file=path, field=f"line {number}",
                           remedy="correct the row") from None  # fmt: skip
    found = {}
    for kind, name in (("gyroscope", "gyro"), ("accelerometer", "accel")):
        if rows[kind]:
            table = np.array(rows[kind])
            found[name] = _Sensor(table[:, 0], table[:, 1:], 1.0)
    return found


def is_inertial_table(path: Path) -> bool:
    """True for a text table whose header names a gyroscope and an accelerometer.

    Args:
        path: any file.
    """
    try:
        header = next((line for _, line in read_lines(path, REMEDY) if line.strip()), "") if is_file(path) else ""
    except DvoError:
        return False
    names = [cell.strip().strip('"# ') for cell in re.split(r"[,;\t]", header)]
    try:
        return columns_of(names, Path("table")).keys() >= {"gyro", "accel"}
    except DvoError:
        return False
