"""Settings dataclasses: checks of their values, and reading them from text and YAML."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

from dvo.errors import DvoError

Range = tuple[float, float]


def check_settings(settings: Any, ranges: Mapping[str, Range]) -> None:
    """Check type and range of the numbers of a settings dataclass.

    Args:
        settings: an instance; its fields are of type int, float, bool or str.
        ranges: lowest and highest value, both allowed, of the numbers that have one.

    Raises:
        DvoError: a value of another type, not finite or out of range, with the name of the field.
    """
    hints = get_type_hints(type(settings))
    for item in fields(settings):
        value, kind = getattr(settings, item.name), hints[item.name]
        if kind is int and (isinstance(value, bool) or not isinstance(value, int)):
            raise DvoError(f"must be a whole number, got {value!r}", field=item.name, remedy="give a whole number")
        if kind is float and (
            isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value)
        ):
            raise DvoError(f"must be a number, got {value!r}", field=item.name, remedy="give a finite number")
        if kind in (bool, str) and not isinstance(value, kind):
            raise DvoError(f"must be a {kind.__name__}, got {value!r}", field=item.name, remedy="see its description")
        if item.name in ranges:
            low, high = ranges[item.name]
            if not low <= value <= high:
                limits = f"from {low:g} to {high:g}" if math.isfinite(high) else f"of at least {low:g}"
                raise DvoError(f"out of range: {value}", field=item.name, remedy=f"give a number {limits}")


def parse_settings(kind: type, items: Iterable[str]) -> dict[str, Any]:
    """Values of ``NAME=VALUE`` texts, converted to the types of a settings dataclass.

    Args:
        kind: the dataclass.
        items: such as ``"patches=48"``.

    Raises:
        DvoError: an unknown name, or a value that is not of the field's type.

    Example:
        >>> parse_settings(TrackerConfig, ["patches=48", "motion_damping=0.3"])
        {'patches': 48, 'motion_damping': 0.3}
    """
    hints = get_type_hints(kind)
    found = {}
    for item in items:
        name, separator, text = item.partition("=")
        name = name.strip()
        if not separator or name not in hints:
            raise _unknown(kind, name or item)
        found[name] = _convert(name, text.strip(), hints[name])
    return found


def read_settings(kind: type, file: str | Path) -> dict[str, Any]:
    """Values of a YAML file with one ``name: value`` a line.

    Args:
        kind: the settings dataclass.
        file: path.

    Raises:
        DvoError: no such file, not such YAML, or an unknown name.
    """
    import yaml

    path = Path(file)
    if not path.is_file():
        raise DvoError("no such file", file=path, remedy="give a YAML file with one 'name: value' a line")
    try:
        table = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DvoError(f"not YAML ({str(error).splitlines()[0]})", file=path, remedy="fix the file") from error
    if not isinstance(table, dict):
        raise DvoError("not a table of settings", file=path, remedy="give one 'name: value' a line")
    names = {item.name for item in fields(kind)}
    for name in table:
        if name not in names:
            unknown = _unknown(kind, str(name))
            raise DvoError(unknown.message, file=path, field=unknown.field, remedy=unknown.remedy)
    return table


def _convert(name: str, text: str, kind: Any) -> Any:
    if kind is bool:
        known = {"true": True, "false": False, "1": True, "0": False, "yes": True, "no": False}
        if text.lower() in known:
            return known[text.lower()]
        raise DvoError(f"must be true or false, got {text!r}", field=name, remedy=f"give {name}=true or {name}=false")
    try:
        return int(text) if kind is int else float(text) if kind is float else text
    except ValueError:
        what = "a whole number" if kind is int else "a number"
        raise DvoError(f"must be {what}, got {text!r}", field=name, remedy=f"give {name}=NUMBER") from None


def _unknown(kind: type, name: str) -> DvoError:
    names = ", ".join(item.name for item in fields(kind))
    return DvoError(f"no setting '{name}' in {kind.__name__}", field=name, remedy=f"use one of {names}")
