"""Calibration by name on one line or several: ``fx=525 fy=525 cx=320 cy=240``."""

from __future__ import annotations

import re
from pathlib import Path

from dvo.core.errors import DvoError

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def read_named_values(text: str, path: Path, remedy: str) -> list[float] | None:
    """Read intrinsics that are written as ``name=value``.

    Args:
        text: content of a calibration file; blanks, commas and semicolons separate, ``#`` begins a comment.
        path: file that it comes from, for messages.
        remedy: another form, for messages.

    Returns:
        Nine or twelve values in the order of :data:`NAMES`, 0 for distortion that is not named; None for text
        of another form.

    Raises:
        DvoError: another name, a name twice, a value that is no number, or no ``fx``, ``fy``, ``cx`` or ``cy``.
    """
    lines = [re.sub("[,;]", " ", line.split("#")[0]) for line in text.splitlines()]
    fields = " ".join(lines).replace("=", " = ").split()
    if fields[1:2] != ["="]:
        return None
    found: dict[str, float] = {}
    for at in range(0, len(fields), 3):
        name, sign, value = (*fields[at : at + 3], "", "")[:3]
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
