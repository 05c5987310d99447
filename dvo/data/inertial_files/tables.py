"""Inertial samples of text tables: EuRoC and TUM-VI, the usual applications of phones, and any table with a header that
names time, gyroscope and accelerometer.

The header decides which column is which, and the units if it states them. A unit of time that is not stated is the one
in which the samples come at the rate of an inertial sensor; one of the accelerometer the one in which the median of its
norm is that of gravity; one of the gyroscope the one in which gravity turns in the accelerometer as it says.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.clock import NAMES, PARTS, is_number, is_time_name, parse_time, unit_of_name
from dvo.data.files.files import is_file, read_lines
from dvo.data.inertial import InertialSamples
from dvo.data.inertial_files.tidy import GRAVITY_RANGE, STANDARD_GRAVITY, check_gravity, joined, tidy

RATES = (15.0, 5000.0)
"""Samples a second of an inertial sensor; the units of time differ by more than the ratio."""
REMEDY = (
    "give a table whose header names time, gyroscope and accelerometer with their units, such as "
    "'time [ns], gx [rad/s], gy [rad/s], gz [rad/s], ax [m/s^2], ay [m/s^2], az [m/s^2]'"
)

_UNIT = re.compile(r"[\[(]\s*([^\])]*?)\s*[\])]")
_FORCES = {"m/s^2": 1.0, "m/s2": 1.0, "m/s²": 1.0, "ms^-2": 1.0, "ms-2": 1.0, "m s^-2": 1.0, "m/s/s": 1.0,
           "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000}  # fmt: skip
_RATES = {"rad/s": 1.0, "rads^-1": 1.0, "rad s^-1": 1.0, "rad/sec": 1.0, "deg/s": math.pi / 180,
          "°/s": math.pi / 180, "dps": math.pi / 180, "deg/sec": math.pi / 180}  # fmt: skip
_WITHOUT_GRAVITY = re.compile(r"lin|user|without")
_GYRO = re.compile(r"(?:.*(?:gyr|angular|rotation ?rate|gyrorotation|omega).*?|w ?(?:rs s )?|alpha ?|g)([xyz])$")
_ACCEL = re.compile(r"(?:.*acc.*?|a ?(?:rs s )?|total ?acceleration.*?)([xyz])$")
_G_FORCE = re.compile(r"g ?f(?:orce)? ?([xyz])$")
_APPLE = re.compile(r"alpha_[xyz]$|accelerometerAcceleration[XYZ]")  # Stray Scanner, SensorLog: g at rest points down
_OTHER = re.compile(r"mag|grav|orient|quat|euler|bias|cov|temper|pos|vel(?!ocity)|attitude|^gps")
_FILES = ((re.compile(r"gyr", re.IGNORECASE), "gyro"), (re.compile(r"acc", re.IGNORECASE), "accel"))
_PARTNERS = ("TotalAcceleration", "AccelerometerUncalibrated", "Accelerometer")  # of Sensor Logger, in this order
_SMOOTH = 0.2  # seconds over which gravity is averaged where it is compared with the gyroscope
_TELLS = 0.3  # share of the change of gravity that the gyroscope explains
_FASTEST = 20.0  # rad/s: numbers of the gyroscope that exceed it are degrees


@dataclass(frozen=True)
class _Sensor:
    """Samples of one sensor as they stand in a file.

    Attributes:
        times: ``(K,)`` seconds.
        values: ``(K, 3)`` in the unit of the file.
        factor: of the stated unit to the standard one; None for none.
    """

    times: np.ndarray
    values: np.ndarray
    factor: float | None


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
        path: ``.csv`` or ``.txt``, ``.jsonl`` of Spectacular AI, or a folder with a file for each sensor.
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
        sensors, notes = _of_text(path)
        where = path.name
        if len(sensors) == 1:
            partner = _partner(path, next(iter(sensors)))
            others, more = _of_text(partner)
            where, notes = f"{path.name} and {partner.name}", [*notes, *more]
            sensors |= {name: sensor for name, sensor in others.items() if name not in sensors}
    for name in ("gyro", "accel"):
        if name not in sensors:
            raise DvoError(f"no columns of the {_noun(name)}", file=path, field=name, remedy=REMEDY)
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
    words = {"gyro": r"gyroscope|gyrometer|gyro|gyr", "accel": r"accelerometer|acceleration|accel|acce|acc"}
    other = "accel" if sensor == "gyro" else "gyro"
    shape = re.sub(words[sensor], "*", path.stem, count=1, flags=re.IGNORECASE).lower()
    there = sorted(child for child in path.parent.iterdir() if child.suffix.lower() == path.suffix.lower())
    preferred = [child for name in _PARTNERS for child in there if child.stem == name] if other == "accel" else []
    fit = [child for child in there if re.sub(words[other], "*", child.stem, count=1, flags=re.IGNORECASE).lower()
           == shape and child != path and re.search(words[other], child.stem, re.IGNORECASE)]  # fmt: skip
    found = [child for child in fit if not _WITHOUT_GRAVITY.search(child.stem.lower())]
    if path.stem == "Gyroscope" and preferred:
        found = preferred[:1]
    if len(found) != 1:
        what = "several files" if found else "no file"
        message = f"only the {_noun(sensor)} in it, and {what} of the {_noun(other)} beside it"
        raise DvoError(message, file=path, field=other, remedy=REMEDY)
    return found[0]


def _text(path: Path) -> _Text:
    """Rows of a text file, their cells apart by commas, semicolons or tabs, or else by blanks."""
    lines = [line.strip("\r\n ") for _, line in read_lines(path, REMEDY, "imu") if line.strip()]
    comments = [line.lstrip("#% ") for line in lines if line[0] in "#%"]
    rows = [line for line in lines if line[0] not in "#%"]
    if not rows:
        raise DvoError("no rows in it", file=path, field="imu", remedy=REMEDY)
    mark = next((mark for mark in ("\t", ";", ",") if mark in rows[-1]), None)

    def cells(line: str) -> list[str]:
        return [cell.strip().strip('"') for cell in (line.split(mark) if mark else line.split())]

    header: list[str] = []
    if not any(is_number(cell.replace(",", ".")) for cell in cells(rows[0])):
        header, rows = cells(rows[0]), rows[1:]
    elif comments:
        named = comments[-1]
        header = cells(named) if mark and mark in named else [cell for cell in re.split(r"[,;\t]\s*|\s{2,}|\s(?![\[(])",
                                                                                        named) if cell]  # fmt: skip
    notes: list[str] = []
    texts = [cells(row) for row in rows]
    if header and texts and all(len(row) == len(header) + 1 and not row[-1] for row in texts):
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
    decimal = mark in (";", "\t") and any("," in cell for row in texts[:3] for cell in row)
    if decimal:
        texts = [[cell.replace(",", ".") for cell in row] for row in texts]
    table = np.array([[_float(cell) for cell in row] for row in texts], dtype=np.float64).reshape(-1, width)
    return _Text(header, table, texts, notes)


def _float(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _of_text(path: Path) -> tuple[dict[str, _Sensor], list[str]]:
    """Sensors in a text file, and notes."""
    text = _text(path)
    if not len(text.table):
        raise DvoError("no rows in it", file=path, field="imu", remedy=REMEDY)
    if not text.header:
        return _unnamed(text, path)
    columns = _columns(text.header, path)
    if not columns:
        raise DvoError("no columns of a gyroscope or an accelerometer", file=path, field="header", remedy=REMEDY)
    times, notes = _times(text, {place for places, _ in columns.values() for place in places}, path)
    found = {name: _Sensor(times, text.table[:, places], factor) for name, (places, factor) in columns.items()}
    if "accel" in found and any(_APPLE.match(name) for name in text.header):
        found["accel"] = replace(found["accel"], values=-found["accel"].values)
        notes.append(f"{path.name}: the sign of the accelerometer is Apple's and was changed")
    return found, [*text.notes, *notes]


def _columns(header: Sequence[str], path: Path) -> dict[str, tuple[list[int], float | None]]:
    """Columns of each sensor, and the factor of the unit that they state."""
    by_sensor: dict[str, dict[str, int]] = {}
    for place, name in enumerate(header):
        plain = " ".join(re.sub(r"[._:-]", " ", _UNIT.sub("", name).lower()).split())
        for sensor, pattern in (("g-force", _G_FORCE), ("accel", _ACCEL), ("gyro", _GYRO)):
            match = pattern.fullmatch(plain)
            is_other = _OTHER.search(plain) or (sensor == "accel" and _WITHOUT_GRAVITY.search(plain))
            if match and not is_other:
                by_sensor.setdefault(sensor, {}).setdefault(match[1], place)
                break
    if not by_sensor:
        bare = {_UNIT.sub("", name).strip().lower(): place for place, name in enumerate(header)}
        kind = next((kind for pattern, kind in _FILES if pattern.search(path.stem)), None)
        if kind is not None and {"x", "y", "z"} <= bare.keys():
            by_sensor[kind] = {axis: bare[axis] for axis in "xyz"}
    if "g-force" in by_sensor:  # Physics Toolbox: ax, ay, az beside them are without gravity
        by_sensor["accel"] = by_sensor.pop("g-force")
        unit: float | None = STANDARD_GRAVITY
    else:
        unit = None
    found = {}
    for sensor, places in by_sensor.items():
        if len(places) == 3:
            chosen = [places[axis] for axis in "xyz"]
            factor = unit if sensor == "accel" and unit else _stated([header[k] for k in chosen], sensor, path)
            found[sensor] = (chosen, factor)
    return found


def _stated(names: Sequence[str], sensor: str, path: Path) -> float | None:
    """Factor of the unit in the names of three columns; None for none."""
    units = {match[1].lower().replace(" ", "") for name in names if (match := _UNIT.search(name))}
    if not units:
        return None
    known = {unit.replace(" ", ""): factor for unit, factor in (_FORCES if sensor == "accel" else _RATES).items()}
    factors = {known.get(unit) for unit in units}
    if len(factors) != 1 or None in factors:
        remedy = f"name one of {', '.join(_FORCES if sensor == 'accel' else _RATES)}"
        raise DvoError(f"the unit {', '.join(sorted(units))[:60]} is not known", file=path, field=sensor, remedy=remedy)
    return factors.pop()


def _times(text: _Text, others: set[int], path: Path) -> tuple[np.ndarray, list[str]]:
    """Seconds of the rows, by the first column whose name is that of a time."""
    names = {place: name for place, name in enumerate(text.header) if place not in others}
    bare = {k: _UNIT.sub("", name) for k, name in names.items()}  # m/s is no time
    column = next((k for k, name in bare.items() if is_time_name(name) or "time" in name.lower()), None)
    if column is None:
        raise DvoError("no column of times", file=path, field="time", remedy=REMEDY)
    return _in_seconds([row[column] for row in text.rows], unit_of_name(text.header[column]), path)


def _in_seconds(cells: Sequence[str], unit: str | None, path: Path) -> tuple[np.ndarray, list[str]]:
    """Seconds of times as text; a cell that holds no number is NaN."""
    values: list[int | float | None] = []
    for cell in cells:
        try:
            values.append(parse_time(cell))
        except ValueError:
            values.append(None)
    known = [value for value in values if value is not None]
    if 2 * len(known) <= len(values):
        message = f"times that are no numbers, such as {cells[0][:40]}"
        raise DvoError(message, file=path, field="time", remedy="give times in seconds to the millisecond, or finer")
    steps = np.diff(np.array([float(value) for value in known]))
    steps = steps[steps > 0]
    if not len(steps):
        raise DvoError("times that do not increase", file=path, field="time", remedy=REMEDY)
    step, notes = float(np.median(steps)), []
    if unit is None:
        unit = next((name for name, parts in PARTS.items() if RATES[0] <= parts / step <= RATES[1]), None)
        if unit is None:
            message = f"the unit of the times is not clear: one is {step:.6g} after the other"
            raise DvoError(message, file=path, field="time", remedy="name it in the header, such as 'time [ns]'")
        if unit != "s":
            notes.append(f"{path.name}: times are taken for {NAMES[unit]}")
    if not RATES[0] <= PARTS[unit] / step <= RATES[1]:
        message = f"{PARTS[unit] / step:.4g} samples a second"
        remedy = f"give {RATES[0]:g} to {RATES[1]:g} a second, and the unit of the times in the header"
        raise DvoError(message, file=path, field="time", remedy=remedy)
    parts = PARTS[unit]
    return np.array([math.nan if value is None else value / parts for value in values]), notes


def _unnamed(text: _Text, path: Path) -> tuple[dict[str, _Sensor], list[str]]:
    """Sensors of a file without a header: time and six numbers, the three with gravity in it being the accelerometer;
    or time and three numbers, the time first or last, in a file whose name tells the sensor."""
    width = text.table.shape[1]
    increasing = [k for k in (0, width - 1) if (np.diff(text.table[:, k]) > 0).mean() > 0.95] if len(text.rows) > 1 \
        else []  # fmt: skip
    sensor = next((kind for pattern, kind in _FILES if pattern.search(path.stem)), None)
    if len(increasing) != 1 or not (width == 7 or (width == 4 and sensor)):
        message = f"{width} columns without a header, which do not tell what they are"
        raise DvoError(message, file=path, field="header", remedy=REMEDY)
    times, notes = _in_seconds([row[increasing[0]] for row in text.rows], None, path)
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
    """Factor to rad/s, and a note if it is a guess."""
    if gyro.factor is not None:
        return gyro.factor, []
    name, reason = "rad/s", "the usual unit"
    ratio = turn_of_gravity(gyro.times, gyro.values, accel.times, accel.values)
    if ratio is not None:
        name = "rad/s" if ratio > 0.13 else "deg/s"  # half way between 1 and pi / 180
        reason = "as gravity turns"
    elif np.nanquantile(np.abs(gyro.values), 0.99) > _FASTEST:
        name, reason = "deg/s", "numbers too large for rad/s"
    return _RATES[name], [f"{path.name}: the gyroscope is taken for {name} ({reason})"]


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
    a_times, keep = np.unique(accel_times[np.isfinite(accel_times)], return_index=True)
    a = accel[np.isfinite(accel_times)][keep]
    w_times, keep = np.unique(gyro_times[np.isfinite(gyro_times)], return_index=True)
    w = gyro[np.isfinite(gyro_times)][keep]
    start, end = max(a_times[0], w_times[0]), min(a_times[-1], w_times[-1])
    if not 10 * _SMOOTH <= end - start <= _SMOOTH * len(w_times):  # too short, or gaps alone
        return None
    edges = np.arange(start, end, _SMOOTH)
    means = [np.stack([_means(times, np.nan_to_num(values[:, k]), edges) for k in range(3)], axis=1)
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
        return _columns(names, Path("table")).keys() >= {"gyro", "accel"}
    except DvoError:
        return False
