"""Settings dataclasses: checks of their values, and reading them from text, tables and YAML files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from numbers import Integral
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from dvo.core.errors import DvoError
from dvo.core.text import choice
from dvo.core.yaml_files import parse_yaml, read_yaml

T = TypeVar("T")
Range = tuple[float, float]

LARGEST_SEED = 2**63 - 1  # of torch
LONGEST = 10_000  # characters of a text in a table
_NOUNS = {
    str: "text",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    dict: "a table",
    tuple: "a list",
}
_REMEDIES = {
    str: "put it in quotes",
    int: "give digits without quotes",
    float: "give a finite number, such as 4.0e-4",
    bool: "give true or false",
    dict: "write {name: value, ...}",
    tuple: "write [value, ...]",
}


def shown(value: Any, limit: int = 60) -> str:
    """The value in a message, cut if it is long.

    Args:
        value: anything.
        limit: characters.
    """
    text = repr(value)
    return text if len(text) <= limit else f"{text[: limit - 3]}..."


def check_settings(settings: Any, ranges: Mapping[str, Range]) -> None:
    """Check type and range of the values of a settings dataclass.

    Args:
        settings: instance of a dataclass; fields of type int, float, bool, str and ``Literal`` of texts are checked.
        ranges: smallest and largest valid value by field, both inclusive; other fields are not bounded. A field of type
            ``tuple[float, float]`` with an entry holds a range, the lower limit first, within these two.

    Raises:
        DvoError: a value of another type, not finite, out of range or unknown, with the name of the field.
    """
    hints = get_type_hints(type(settings))
    for item in fields(settings):
        value, kind = getattr(settings, item.name), hints[item.name]
        if kind is int and (isinstance(value, bool) or not isinstance(value, int)):
            raise DvoError(f"must be a whole number, got {shown(value)}", field=item.name, remedy="give a whole number")
        if kind is float and (
            isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value)
        ):
            raise DvoError(f"must be a number, got {shown(value)}", field=item.name, remedy="give a finite number")
        if kind in (bool, str) and not isinstance(value, kind):
            raise DvoError(
                f"must be a {kind.__name__}, got {shown(value)}", field=item.name, remedy="see its description"
            )
        if get_origin(kind) is Literal and not (isinstance(value, str) and value in get_args(kind)):
            remedy = choice(value, map(str, get_args(kind)))
            raise DvoError(f"unknown: {shown(value)}", field=item.name, remedy=remedy)
        if item.name in ranges:
            low, high = ranges[item.name]
            if kind == tuple[float, float]:
                numbers = isinstance(value, (tuple, list)) and all(type(x) in (int, float) for x in value)
                if not numbers or len(value) != 2 or not low <= value[0] <= value[1] <= high:
                    remedy = f"give [low, high], from {low:g} to {high:g}"
                    raise DvoError(f"no range: {shown(value)}", field=item.name, remedy=remedy)
            elif not low <= value <= high:
                limits = f"from {low:g} to {high:g}" if math.isfinite(high) else f"of at least {low:g}"
                raise DvoError(f"out of range: {shown(value)}", field=item.name, remedy=f"give a number {limits}")


def settings_of(kind: type[T], value: Any, field: str) -> T:
    """Settings dataclass from an instance, or from a table of its values as YAML gives it.

    Args:
        kind: the dataclass.
        value: instance, or name to value.
        field: for messages.

    Returns:
        The instance.

    Raises:
        DvoError: neither; an unknown name, or a value of another type or out of range.
    """
    if isinstance(value, kind):
        return value
    try:
        return from_table(kind, value, Path(field))
    except DvoError as error:
        name = field if error.field in (None, "") else f"{field}: {error.field}"
        raise DvoError(error.message, field=name, remedy=error.remedy) from None


def check_seed(seed: Any) -> None:
    """Check the seed of random numbers.

    Args:
        seed: anything.

    Raises:
        DvoError: no whole number, or out of range.
    """
    if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= int(seed) <= LARGEST_SEED:
        raise DvoError(f"not a seed: {shown(seed)}", field="seed", remedy="give a whole number from 0 to 2^63 - 1")


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
            raise DvoError(
                f"not a setting: {shown(item)}", field=name or None, remedy="give NAME=VALUE, such as patches=48"
            )
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
            f"unknown setting of {kind.__name__}", field=", ".join(unknown), remedy=choice(unknown[0], names)
        )


def changed(settings: T, values: Mapping[str, Any]) -> T:
    """Settings with some of them changed.

    Args:
        settings: instance of a dataclass.
        values: name to value.

    Raises:
        DvoError: an unknown name, or a value of another type.
    """
    check_names(type(settings), values)
    new = replace(cast(Any, settings), **values)
    check_settings(new, {})
    return cast(T, new)


def from_table(kind: type[T], entry: Any, file: Path, place: str = "") -> T:
    """Instance of a dataclass from a table of a YAML file, with the type and the range of every value checked.

    Args:
        kind: dataclass whose fields are ``str``, ``int``, ``float``, ``bool``, ``Literal[...]``, ``dict[str, X]``,
            ``tuple[X, ...]``, ``tuple[X, Y]``, ``Any``, another such dataclass, or one of these ``| None``. Its class
            attribute ``RANGES``, if it has one, gives the smallest and the largest value of fields, both inclusive.
        entry: the table, as read from the file.
        file: for messages.
        place: of the entry in the file, for messages.

    Returns:
        The instance; lists become tuples.

    Raises:
        DvoError: not a table; an unknown or missing field; a value of another type or out of range.
    """
    noun = kind.__name__.lower()
    if not isinstance(entry, dict):
        message = f"expected a table of settings ({noun}), got {_brief(entry)}"
        raise DvoError(message, file=file, field=place or None, remedy="give a table: {name: value, ...}")
    known = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
    unknown = [name for name in entry if name not in known]
    if unknown:
        remedy = choice(unknown[0], sorted(known), "known are")
        raise DvoError(f"unknown setting {_brief(unknown[0])}", file=file, field=place or None, remedy=remedy)
    needed = [name for name, f in known.items() if f.default is MISSING and f.default_factory is MISSING]
    missing = [name for name in needed if name not in entry]
    if missing:
        message = f"incomplete {noun}: no {missing[0]}"
        raise DvoError(message, file=file, field=place or None, remedy="add it")
    hints = get_type_hints(kind)
    ranges: Mapping[str, Range] = getattr(kind, "RANGES", {})
    values = {}
    for name, value in entry.items():
        field = f"{place}: {name}" if place else name
        values[name] = typed(value, hints[name], file, field)
        if name in ranges:
            low, high = ranges[name]
            if not low <= value <= high:
                limits = f"from {low:g} to {high:g}" if math.isfinite(high) else f"of at least {low:g}"
                raise DvoError(
                    f"out of range: {_brief(value)}", file=file, field=field, remedy=f"give a number {limits}"
                )
    return kind(**values)


def typed(value: Any, hint: Any, file: Path, field: str) -> Any:
    """The value, if it has the type of an annotation; see :func:`from_table`.

    Raises:
        DvoError: it has another type, is a number that is not finite, or a very long text.
    """
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if is_dataclass(hint):
        return from_table(cast(type, hint), value, file, field)
    if origin in (Union, UnionType):
        choices = [one for one in inner if one is not NoneType]
        return None if value is None and NoneType in inner else typed(value, choices[0], file, field)
    if origin is Literal:
        if not isinstance(value, str) or value not in inner:
            remedy = choice(value, map(str, inner), "choose one of")
            raise DvoError(f"unknown: {_brief(value)}", file=file, field=field, remedy=remedy)
        return value
    if origin is dict:
        if not isinstance(value, dict) or not all(isinstance(name, str) for name in value):
            raise _wrong(value, dict, file, field)
        return {name: typed(one, inner[1], file, f"{field}: {name}") for name, one in value.items()}
    if origin is tuple:
        kinds = inner if inner[-1] is not Ellipsis else (inner[0],) * len(value if isinstance(value, list) else ())
        if not isinstance(value, list) or len(value) != len(kinds):
            raise _wrong(value, tuple, file, field, f"a list of {len(kinds)}" if kinds else "a list")
        return tuple(typed(one, kind, file, f"{field}[{i}]") for i, (one, kind) in enumerate(zip(value, kinds)))  # noqa: B905
    whole = isinstance(value, int) and not isinstance(value, bool)
    fits = whole or isinstance(value, float) if hint is float else whole if hint is int else isinstance(value, hint)
    if not fits or (isinstance(value, float) and not math.isfinite(value)):
        raise _wrong(value, hint, file, field)
    if isinstance(value, str) and len(value) > LONGEST:
        raise _wrong(value, hint, file, field, f"text of {LONGEST} characters at most")
    return value


def _brief(value: Any) -> str:
    if isinstance(value, (dict, list, tuple)):
        return "a table" if isinstance(value, dict) else "a list"
    return shown(value)


def _wrong(value: Any, kind: type, file: Path, field: str, noun: str | None = None) -> DvoError:
    message = f"must be {noun or _NOUNS[kind]}, got {_brief(value)}"
    return DvoError(message, file=file, field=field, remedy=_REMEDIES[kind])
