"""Checks of settings dataclasses, and reading of settings from text and YAML."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

from dvo.errors import DvoError
from dvo.yaml_files import parse_yaml, read_yaml

Range = tuple[float, float]


def check_settings(settings: Any, ranges: Mapping[str, Range]) -> None:
    """Check type and range of the numbers of a settings dataclass.

    Args:
        settings: instance of a dataclass with fields of type int, float, bool or str.
        ranges: smallest and largest valid value by field, both inclusive; other fields are not bounded.

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


def parse_settings(items: Iterable[str]) -> dict[str, Any]:
    """Parse ``NAME=VALUE`` texts; values are YAML scalars.

    Args:
        items: such as ``"patches=48"``.

    Returns:
        Name to value.

    Raises:
        DvoError: a text without a name or a value.

    Example:
        >>> parse_settings(["patches=48", "motion_damping=0.3"])
        {'patches': 48, 'motion_damping': 0.3}
    """
    found = {}
    for item in items:
        name, _, text = (part.strip() for part in item.partition("="))
        try:
            value = parse_yaml(text)
        except DvoError:
            value = None
        if not name.isidentifier() or value is None:
            raise DvoError(f"not a setting: {item!r}", field=name or None, remedy="give NAME=VALUE, such as patches=48")
        found[name] = value
    return found


def read_settings(file: str | Path) -> dict[str, Any]:
    """Read a YAML file with one ``name: value`` a line.

    Args:
        file: path.

    Returns:
        Name to value.

    Raises:
        DvoError: no such file, or invalid content.
    """
    remedy = "give a YAML file with one 'name: value' a line"
    table = read_yaml(file, remedy)
    if not isinstance(table, dict) or not all(isinstance(name, str) for name in table):
        raise DvoError("not a table of settings", file=file, remedy=remedy)
    return table


def check_names(kind: type, values: Mapping[str, Any]) -> None:
    """Check that all names are fields of a dataclass.

    Args:
        kind: the dataclass.
        values: name to value.

    Raises:
        DvoError: an unknown name.
    """
    names = [item.name for item in fields(kind)]
    unknown = sorted(set(values) - set(names))
    if unknown:
        raise DvoError(
            f"unknown setting of {kind.__name__}", field=", ".join(unknown), remedy=f"use one of {', '.join(names)}"
        )
