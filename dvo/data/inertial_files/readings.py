"""Tables with a row for each reading of a sensor, whose name stands in a column, and lists of such readings in JSON.

Such a table is read as if each sensor had a file of its own. Sensor Logger, which writes ``seconds_elapsed``, calls
what is left of the acceleration without gravity ``Accelerometer``, and has ``Gravity`` beside it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.core.yaml_files import read_text
from dvo.data.files.files import MAX_TABLE

SENSOR_LOGGER = "seconds_elapsed"
"""Column by which a table is one of Sensor Logger."""
REMEDY = 'give a list of readings, [{"sensor": "Gyroscope", "time": "...", "x": "...", ...}, ...], as of Sensor Logger'
"""Of errors about JSON."""

_COLUMNS = {"sensor", "sensortype", "sensorname", "type", "name"}
_AXIS = re.compile(r"(?:values?[ ._]?)?([xyz])(?=$|\s*[\[(])", re.IGNORECASE)
_GYRO, _ACCEL, _GRAVITY = re.compile(r"gyr|angularvel|rotationrate"), re.compile(r"acc(?!ur)"), re.compile(r"grav")
_LINEAR = re.compile(r"lin|user|without|free")
_WORN, _RAW = re.compile(r"watch|wrist|head"), re.compile(r"unc|raw|unfilt")


def kind_of(name: str, *, is_logger: bool = False) -> str:
    """What a sensor measures: ``gyro``, ``accel``, ``linear`` (without gravity), ``gravity``, or an empty text.

    Args:
        name: of the sensor.
        is_logger: it is one of Sensor Logger.
    """
    plain = re.sub(r"[^a-z]", "", name.lower())
    if _GYRO.search(plain):
        return "gyro"
    if _ACCEL.search(plain):
        return "linear" if _LINEAR.search(plain) or (is_logger and plain.endswith("accelerometer")) else "accel"
    return "gravity" if _GRAVITY.search(plain) else ""


@dataclass(frozen=True)
class Readings:
    """Rows of one sensor.

    Attributes:
        name: of the sensor, as it stands there.
        kind: ``gyro``, ``accel``, ``linear`` (an accelerometer without gravity) or ``gravity``.
        header: names of the columns; those of the axes begin with ``gyro`` or ``accel``.
        rows: their cells.
    """

    name: str
    kind: str
    header: list[str]
    rows: list[list[str]]

    @staticmethod
    def of(name: str, header: Sequence[str], rows: list[list[str]], unit: str = "") -> Readings:
        """Rows of a sensor, by its name.

        Args:
            name: of an inertial sensor.
            header: names of the columns, of which three are x, y and z.
            rows: their cells.
            unit: of the readings, if there is one that the header does not state.
        """
        kind = kind_of(name, is_logger=SENSOR_LOGGER in header)
        sensor, end = "gyro" if kind == "gyro" else "accel", f" [{unit}]" if unit else ""
        axes = [_AXIS.match(column.strip()) for column in header]
        names = [f"{sensor} {found.string[found.start(1) :]}{end}" if found else column
                 for found, column in zip(axes, header, strict=True)]  # fmt: skip
        return Readings(name, kind, names, rows)

    @property
    def rank(self) -> tuple[bool, bool, bool]:
        """Order of those of one kind that may be meant: of the device itself, corrected, and whole."""
        plain = self.name.lower()
        return bool(_WORN.search(plain)), bool(_RAW.search(plain)), "total" not in plain


def by_sensor(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[Readings]:
    """Inertial sensors of a table with a row for each reading; none of another table.

    Args:
        header: names of the columns.
        rows: cells of the rows.
    """
    plain = [re.sub(r"[ ._-]", "", name.lower()) for name in header]
    axes = [found[1].lower() for name in header if (found := _AXIS.match(name.strip()))]
    columns = [k for k, name in enumerate(plain) if name in _COLUMNS and any(kind_of(row[k]) for row in rows)]
    if not columns or sorted(axes) != ["x", "y", "z"]:
        return []
    sensors: dict[str, list[list[str]]] = {}
    for row in rows:
        sensors.setdefault(row[columns[0]].strip(), []).append(list(row))
    unit = next((k for k, name in enumerate(plain) if name in ("unit", "units")), None)
    tables = []
    for name, mine in sensors.items():
        units = {row[unit].strip() for row in mine} if unit is not None else set()
        if kind_of(name):
            tables.append(Readings.of(name, header, mine, ",".join(sorted(units))))
    return tables


def read_json(path: Path) -> tuple[list[str], list[list[str]], dict[str, str]]:
    """Read a list of readings, such as Sensor Logger exports.

    Args:
        path: JSON; a list of tables of names and values, which may be texts.

    Returns:
        Header and rows of the readings of inertial sensors; and the entry of Sensor Logger about the recording.

    Raises:
        DvoError: no such list.
    """
    try:
        entries = json.loads(read_text(path, REMEDY, MAX_TABLE))
    except (ValueError, RecursionError) as error:
        where = f" (line {error.lineno}: {error.msg})" if isinstance(error, json.JSONDecodeError) else ""
        raise DvoError(f"no whole JSON{where}", file=path, field="imu", remedy=REMEDY) from None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DvoError("no list of readings", file=path, field="imu", remedy=REMEDY)
    about: dict[str, str] = {}
    readings = []
    for entry in entries:
        flat: dict[str, str] = {}
        for name, value in entry.items():
            parts = value.items() if isinstance(value, dict) else [("", value)]
            flat |= {f"{name} {part}".strip(): _text(one) for part, one in parts}
        sensors = [value for name, value in flat.items() if name.lower() in _COLUMNS]
        if any(map(kind_of, sensors)):
            readings.append(flat)
        elif "Metadata" in sensors:
            about = flat
    header = list(dict.fromkeys(name for flat in readings for name in flat))
    return header, [[flat.get(name, "") for name in header] for flat in readings], about


def _text(value: Any) -> str:
    return value.strip() if isinstance(value, str) else "" if value is None else str(value)
