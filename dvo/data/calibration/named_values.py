"""Calibration by name: ``fx=525 fy=525 cx=320 cy=240`` on one line or several, or a table with a header."""

from __future__ import annotations

import re
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.data.files.clock import is_number

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def read_named_values(text: str, path: Path, remedy: str) -> list[float] | None:
    """Read intrinsics that are written as ``name=value`` or ``name,value``, or as a line of names and one of values.

    Args:
        text: content of a calibration file; blanks, commas and semicolons separate, ``#`` begins a comment. Names may
            be upper case.
        path: file that it comes from, for messages.
        remedy: another form, for messages.

    Returns:
        Nine or twelve values in the order of :data:`NAMES`, 0 for distortion that is not named; None for text
        of another form.

    Raises:
        DvoError: another name, a name twice, a value that is no number, or no ``fx``, ``fy``, ``cx`` or ``cy``.
    """
    lines = [re.sub("[,;]", " ", line.split("#")[0]).replace("=", " = ").split() for line in text.splitlines()]
    lines = [line for line in lines if line]
    if len(lines) > 1 and {len(line) for line in lines} == {2} and not any(map(is_number, lines[0])):
        lines = lines[1:]  # the header of a table of names and values
    is_named = bool(lines) and lines[0][0].lower() in NAMES
    if is_named and len(lines) == 2 and len(lines[0]) == len(lines[1]) > 3:
        lines = [list(pair) for pair in zip(*lines, strict=True)]
    if is_named and all(len(line) == 2 for line in lines):
        lines = [[name, "=", value] for name, value in lines]
    fields = [word for line in lines for word in line]
    if fields[1:2] != ["="]:
        return None
    found: dict[str, float] = {}
    for at in range(0, len(fields), 3):
        name, sign, value = (*fields[at : at + 3], "", "")[:3]
        name = name.lower() if name.lower() in NAMES else name
        if name not in NAMES or sign != "=" or name in found:
            problem = f"{name[:40]!r} twice" if name in found else f"not name=value: {name[:40]!r}"
            raise DvoError(problem, file=path, field="intrinsics", remedy=f"name {', '.join(NAMES)} once; or {remedy}")
        try:
            found[name] = float(value)
        except ValueError:
            raise DvoError(f"not a number: {value[:40]!r}", file=path, field=name, remedy=remedy) from None
    missing = [name for name in NAMES[:4] if name not in found]
    if missing:
        raise DvoError(
            f"no {', '.join(missing)} in it",
            file=path,
            field="intrinsics",
            remedy="add them, in pixels; cx and cy of most cameras are near (width - 1) / 2 and (height - 1) / 2",
        )
    values = [found.get(name, 0.0) for name in NAMES]
    return values if any(values[9:]) else values[:9]
