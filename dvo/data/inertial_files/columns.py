"""Columns of tables of inertial samples: which are the gyroscope, the accelerometer and their times, by their names."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.data.files.clock import is_time_name, parse_time
from dvo.data.inertial_files.tidy import STANDARD_GRAVITY

FORCE_UNITS = {"m/s^2": 1.0, "m/s2": 1.0, "m/s²": 1.0, "ms^-2": 1.0, "ms-2": 1.0, "m s^-2": 1.0, "m/s/s": 1.0,
          "m/sec^2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000}  # fmt: skip
"""Units of an accelerometer, in m/s^2."""
RATE_UNITS = {"rad/s": 1.0, "rads^-1": 1.0, "rad s^-1": 1.0, "rad/sec": 1.0, "radians/s": 1.0, "radians/sec": 1.0,
         "radians/second": 1.0, "deg/s": math.pi / 180, "°/s": math.pi / 180, "dps": math.pi / 180,
         "deg/sec": math.pi / 180, "degrees/s": math.pi / 180, "degrees/sec": math.pi / 180,
         "degrees/second": math.pi / 180, "mdps": math.pi / 180e3}  # fmt: skip
"""Units of a gyroscope, in rad/s."""
NAMED = ((re.compile(r"gyr", re.IGNORECASE), "gyro"), (re.compile(r"acc", re.IGNORECASE), "accel"))
"""Names of files with one sensor."""

_UNIT = re.compile(r"[\[(]\s*([^\])]*?)\s*[\])]")
_INDEX = re.compile(r"[\[(]([012])[\])]")  # PX4, Betaflight
_WITHOUT_GRAVITY = re.compile(r"lin|user|without|free")
_GYRO = re.compile(r"(?:.*(?:gyr|angular|rotation ?rate|gyrorotation|omega).*?|w ?(?:rs s )?|alpha ?|g)([xyz])$")
_ACCEL = re.compile(r"(?:.*acc.*?|a ?(?:rs s )?|total ?acceleration.*?)([xyz])$")
_G_FORCE = re.compile(r"g ?f(?:orce)? ?([xyz])$")
_ROS = re.compile(r"(?:^| )linear acceleration [xyz]$")  # of sensor_msgs/Imu, with gravity
_VEL, _ACC = re.compile(r"\bang(?:ular)? vel\b"), re.compile(r"\blin(?:ear)? acc(?:el)?\b")  # ang_vel_x, lin_acc_x
_OTHER = re.compile(
    r"mag|grav|orient|quat|euler|bias|cov|temper|pos|vel(?!ocity)|attitude|^gps|drift|std|stdev|sigma|noise|delta|world|earth|"
    r"angular ?acc|incr"
)
_UNCORRECTED = re.compile(r"unc|unfilt|raw")
_SUFFIX = re.compile(  # units behind the axis
    r"(.*[xyz])[ _]((?:m?deg|m?d|rad)(?:[ _]?p?s|[ _]per[ _]s(?:ec)?)|m[ _]?p?s[ _]?(?:\^?2|s)|m?g)$", re.IGNORECASE
)
_SPELLED = {"rads": "rad/s", "degs": "deg/s", "ds": "deg/s", "mdegs": "mdps", "mds": "mdps", "ms2": "m/s^2",
            "mss": "m/s^2", "g": "g", "mg": "mg"}  # fmt: skip
_INSTANCES = {"i", "instance", "imu", "imu_id", "device_id", "deviceid"}
_STAMP = re.compile(r"(?:^|[._ ])header[._ ]stamp$")
_DISTINCT = 0.2  # share of times that are new, of a clock that is fine enough
_NANOS = re.compile(r"(.*?)(?:n|nano)(secs?)$")


@dataclass(frozen=True)
class Columns:
    """Columns of one sensor.

    Attributes:
        places: of x, y and z.
        factor: of the unit that their names state to the standard one; None for none.
        rivals: names of other columns that may be the same sensor as well.
    """

    places: list[int]
    factor: float | None
    rivals: list[str] = field(default_factory=list)


def columns_of(header: Sequence[str], path: Path) -> dict[str, Columns]:
    """Columns of the sensors ``gyro`` and ``accel`` in a table.

    Columns that differ by the axis alone belong together. Of several such groups one with gravity comes before others,
    and one that is corrected before one that is not.

    Args:
        header: names of the columns.
        path: its name tells the sensor of columns that are x, y and z alone.

    Raises:
        DvoError: a unit that is not known.
    """
    header = [_bracketed(name) for name in header]
    plain = [_plain(name) for name in header]
    is_ros = any("angular velocity" in name for name in plain)
    groups: dict[str, dict[str, dict[str, int]]] = {}
    for place, name in enumerate(plain):
        for sensor, pattern in (("g-force", _G_FORCE), ("accel", _ACCEL), ("gyro", _GYRO)):
            match = pattern.fullmatch(name)
            without = sensor == "accel" and _is_without(name, is_ros)
            if match and not _OTHER.search(name) and not without:
                stem = name[:-1].strip()
                while match[1] in groups.get(sensor, {}).get(stem, {}):
                    stem += "'"
                groups.setdefault(sensor, {}).setdefault(stem, {})[match[1]] = place
                break
    if not groups:
        bare = {_UNIT.sub("", name).strip().lower(): place for place, name in enumerate(header)}
        kind = next((kind for pattern, kind in NAMED if pattern.search(path.stem)), None)
        if kind is not None and {"x", "y", "z"} <= bare.keys():
            groups[kind] = {"": {axis: bare[axis] for axis in "xyz"}}
    whole = {sensor: {stem: [places[axis] for axis in "xyz"] for stem, places in stems.items() if len(places) == 3}
             for sensor, stems in groups.items()}  # fmt: skip
    is_g = bool(whole.get("g-force"))  # Physics Toolbox: ax, ay, az beside them are without gravity
    if is_g:
        whole["accel"] = whole["g-force"]
    found = {}
    for sensor in ("gyro", "accel"):
        stems = sorted(whole.get(sensor, {}), key=_rank)
        if stems:
            places = whole[sensor][stems[0]]
            rivals = [header[whole[sensor][stem][0]] for stem in stems[1:] if _rank(stem) == _rank(stems[0])]
            unit = STANDARD_GRAVITY if sensor == "accel" and is_g else None
            found[sensor] = Columns(places, unit or _stated([header[k] for k in places], sensor, path), rivals)
    return found


def without_gravity(header: Sequence[str]) -> list[str]:
    """Names of columns of an accelerometer from which gravity was removed.

    Args:
        header: names of the columns.
    """
    plain = [_plain(_bracketed(name)) for name in header]
    is_ros = any("angular velocity" in name for name in plain)
    pairs = zip(header, plain, strict=True)
    return [name for name, words in pairs if _ACCEL.fullmatch(words) and _is_without(words, is_ros)]


def _is_without(name: str, is_ros: bool) -> bool:
    return bool(_WITHOUT_GRAVITY.search(name)) and not (is_ros and _ROS.search(name))


def with_units(header: Sequence[str], units: Sequence[str]) -> list[str]:
    """Names of columns with units that stand in a line of their own.

    Args:
        header: names of the columns.
        units: what stands below them.

    Returns:
        Empty if these are no units.
    """
    plain = [cell.strip().strip("[]()").strip() for cell in units]
    known = {name.replace(" ", "") for name in (*FORCE_UNITS, *RATE_UNITS)}
    count = sum(cell.lower().replace(" ", "") in known for cell in plain)
    if count < 3 or len(units) != len(header):  # of one sensor
        return []
    return [f"{name} [{unit}]" if unit and not _UNIT.search(name) else name
            for name, unit in zip(header, plain, strict=True)]  # fmt: skip


def _bracketed(name: str) -> str:
    """Name whose unit stands in brackets: ``acc_x [m/s^2]`` of ``acc_x_m_s2``."""
    found = None if _UNIT.search(name) else _SUFFIX.fullmatch(name.strip())
    if found is None:
        return name
    short = re.sub(r"[ _^]|p(?=s)|per|(?<=s)ec$", "", found[2].lower())
    return f"{found[1]} [{_SPELLED[short]}]" if short in _SPELLED else name


def _plain(name: str) -> str:
    """Name in small letters, without unit, its index as an axis."""
    indexed = _INDEX.sub(lambda match: " " + "xyz"[int(match[1])], name)
    words = " ".join(re.sub(r"[._:/-]", " ", _UNIT.sub("", indexed).lower()).split())
    return _ACC.sub("linear acceleration", _VEL.sub("angular velocity", words))


def _rank(stem: str) -> int:
    """Order of groups that may be meant; ``g`` beside another gyroscope is gravity."""
    return 2 if _UNCORRECTED.search(stem) else 1 if stem.rstrip("'") == "g" else -1 if "total" in stem else 0


def _stated(names: Sequence[str], sensor: str, path: Path) -> float | None:
    """Factor of the unit in the names of three columns; None for none."""
    plain = [_INDEX.sub("", name) for name in names]
    units = {match[1].lower().replace(" ", "") for name in plain if (match := _UNIT.search(name))}
    if not units:
        return None
    table = FORCE_UNITS if sensor == "accel" else RATE_UNITS
    known = {unit.replace(" ", ""): factor for unit, factor in table.items()}
    factors = {known.get(unit) for unit in units}
    if len(factors) != 1 or None in factors:
        message = f"the unit {', '.join(sorted(units))[:60]} is not known"
        raise DvoError(message, file=path, field=sensor, remedy=f"name one of {', '.join(table)}")
    return factors.pop()


def time_columns(
    header: Sequence[str], rows: Sequence[Sequence[str]], sensors: Mapping[str, Columns]
) -> tuple[dict[str, int | tuple[int, int]], str]:
    """Column of the times of each sensor.

    It is the stamp of a ROS header, or else the first that is named a time and holds numbers, which do not repeat where
    there is another one; of several with this name (phyphox) the nearest one to the left of the sensor.

    Args:
        header: names of the columns.
        rows: cells of the rows.
        sensors: their columns.

    Returns:
        For each sensor a column, or those of seconds and nanoseconds, which add up; empty if there is none. And a note.
    """
    others = {place for columns in sensors.values() for place in columns.places}
    names = {k: _UNIT.sub("", name) for k, name in enumerate(header) if k not in others}  # m/s is no time
    low = {k: name.strip().lower() for k, name in names.items()}
    pairs: list[tuple[int, int]] = []
    for k, name in low.items():
        parts = _NANOS.fullmatch(name)
        if parts:
            pairs += [(j, k) for j, other in low.items() if other == parts[1] + parts[2]]
    stamp = next((k for k, name in low.items() if _STAMP.search(name) and _are_numbers(rows, k)), None)
    if stamp is None and pairs:
        return dict.fromkeys(sensors, pairs[0]), ""
    named = [k for k, name in names.items() if is_time_name(name) or "time" in low[k]]
    if stamp is None and not named:
        return {}, ""
    numbers = [k for k in named if _are_numbers(rows, k)] or named[:1]
    first = stamp if stamp is not None else next((k for k in numbers if _changes(rows, k)), numbers[0])
    same = [k for k in named if low[k] == low[first]] or [first]
    passed = stamp is None and first != numbers[0]
    note = f"most rows of {header[numbers[0]]} are the same: times are those of {header[first]}" if passed else ""
    places = {name: max((k for k in same if k < min(one.places)), default=first) for name, one in sensors.items()}
    return dict(places), note


def _changes(rows: Sequence[Sequence[str]], column: int) -> bool:
    """True if the cells do not repeat more often than those of several sensors at one time."""
    cells = [row[column] for row in rows[:1000] if row[column]]
    return len(set(cells)) > _DISTINCT * len(cells)


def _are_numbers(rows: Sequence[Sequence[str]], column: int) -> bool:
    """True if more than half of the cells that are not empty are times."""
    cells = [row[column] for row in rows[:1000] if row[column]]
    return 2 * sum(map(_is_time, cells)) > len(cells)


def _is_time(cell: str) -> bool:
    try:
        parse_time(cell)
    except ValueError:
        return False
    return True


def first_instance(header: Sequence[str], rows: Sequence[Sequence[str]]) -> tuple[list[int] | None, str]:
    """Rows of the first of several sensors that take turns in a table (ArduPilot).

    Args:
        header: names of the columns.
        rows: cells of the rows.

    Returns:
        Their numbers, None for all rows; and a note.
    """
    column = next((k for k, name in enumerate(header) if name.strip().lower() in _INSTANCES), None)
    if column is None or not rows:
        return None, ""
    first = rows[0][column]
    kept = [k for k, row in enumerate(rows) if row[column] == first]
    if len(kept) == len(rows):
        return None, ""
    return kept, f"rows of other sensors, whose {header[column].strip()} is not {first}, are left out"
