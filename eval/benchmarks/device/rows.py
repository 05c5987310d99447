"""Rows of the result, and their table."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

HEAD = ("section", "case", "value", "unit", "memory MB", "note")


@dataclass(frozen=True)
class Row:
    """One result.

    Attributes:
        section: that measured it.
        case: what was measured.
        value: the number; None where there is none.
        unit: of the value.
        memory_mb: peak memory of the device (on the CPU, of the process) so far; None: not asked.
        note: what else belongs to it; of a row without a value, why there is none.
        failed: the case did not work.
    """

    section: str
    case: str
    value: float | None = None
    unit: str = ""
    memory_mb: float | None = None
    note: str = ""
    failed: bool = False


def append_row(file: Path, row: Row) -> None:
    """Add a row to a file of JSON lines, at once: a section that is stopped keeps those it has.

    Args:
        file: to append to.
        row: to add.
    """
    with file.open("a", encoding="utf-8") as lines:
        lines.write(json.dumps(asdict(row)) + "\n")


def read_rows(file: Path) -> list[Row]:
    """Rows of a file of JSON lines; none without the file. A line that is cut off ends it.

    Args:
        file: to read.
    """
    found: list[Row] = []
    for line in file.read_text(encoding="utf-8").splitlines() if file.is_file() else []:
        try:
            found.append(Row(**json.loads(line)))
        except ValueError:
            break
    return found


def table(rows: Sequence[Row]) -> str:
    """Table in Markdown.

    Args:
        rows: in the order of the lines.
    """
    lines = ["| " + " | ".join(HEAD) + " |", "|---|---|--:|---|--:|---|"]
    for row in rows:
        value = "failed" if row.failed else "-" if row.value is None else f"{row.value:.4g}"
        memory = "" if row.memory_mb is None else f"{row.memory_mb:.0f}"
        lines.append(_line(row.section, row.case, value, row.unit, memory, row.note))
    return "\n".join(lines)


def _line(*cells: str) -> str:
    return "| " + " | ".join(" ".join(cell.replace("|", "\\|").split()) for cell in cells) + " |"


def reason_of(error: BaseException) -> str:
    """What an exception says, in one short line.

    Args:
        error: the exception.
    """
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]


def failures(rows: Iterable[Row]) -> int:
    """Number of cases that did not work.

    Args:
        rows: any.
    """
    return sum(row.failed for row in rows)
