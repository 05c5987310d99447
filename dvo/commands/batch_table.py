"""Table of ``dvo batch``: a row for each video, printed and in batch.csv."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.core.text import printable
from dvo.data.files.output import write_text

DONE, FAILED, INTERRUPTED, WAITING = "done", "failed", "interrupted", "waiting"


@dataclass(frozen=True)
class Row:
    """Outcome of a video.

    Attributes:
        name: of its results folder.
        source: absolute path.
        state: ``done``, ``failed``, ``interrupted`` (the results are those of a part) or ``waiting``.
        frames, tracked: read, and with a pose; None without results.
        segments: of the trajectory.
        verdict, reason: of the odometry on its result.
        ate_percent: error against the ground truth, percent of the path.
        seconds: of reading, tracking, finishing, calibrating and checking together.
        error: in one line, of a failed video.
    """

    name: str
    source: str
    state: str = WAITING
    frames: int | None = None
    tracked: int | None = None
    segments: int | None = None
    verdict: str | None = None
    reason: str | None = None
    ate_percent: float | None = None
    seconds: float | None = None
    error: str | None = None

    @property
    def is_tracked(self) -> bool:
        """True if the video is done and has a tracked frame."""
        return self.state == DONE and bool(self.tracked)

    @property
    def outcome(self) -> str:
        """Verdict with its reason; of a failed video the error."""
        if self.state == FAILED:
            return f"failed: {self.error}"
        if self.state == WAITING:
            return "not done"
        told = ": ".join(part for part in (self.verdict, self.reason) if part)
        told = told or ("tracked" if self.tracked else "nothing tracked")
        return f"interrupted ({told})" if self.state == INTERRUPTED else told


COLUMNS = tuple(field.name for field in fields(Row))


def row_of(name: str, source: str, facts: Mapping[str, Any]) -> Row:
    """Row of a video with results.

    Args:
        name: of its folder.
        source: absolute path.
        facts: content of run.json (:func:`dvo.session.run_facts.read_facts`).

    Returns:
        The row; ``interrupted`` unless the run came to its end.
    """
    quality, metrics = facts.get("quality") or {}, facts.get("metrics") or {}
    frames = facts["frames"]
    seconds = [value for value in (facts.get("seconds") or {}).values() if value is not None]
    return Row(
        name,
        source,
        DONE if is_complete(facts) else INTERRUPTED,
        frames["read"],
        frames.get("tracked") or 0,
        len(facts["segments"]),
        quality.get("verdict"),
        quality.get("reason") or None,
        None if metrics.get("ate_percent") is None else round(metrics["ate_percent"], 4),
        round(sum(seconds), 1),
    )


def is_complete(facts: Mapping[str, Any]) -> bool:
    """True for a run that came to its end and wrote all of its results.

    Args:
        facts: content of run.json.
    """
    return facts.get("finished") is True and not facts.get("interrupted")


def printed(rows: Sequence[Row]) -> list[str]:
    """Lines of the table.

    Args:
        rows: of the videos.
    """
    texts: list[tuple[str, ...]] = [("name", "frames", "tracked", "seconds", "verdict")]
    for row in rows:
        numbers = (row.frames, row.tracked, None if row.seconds is None else f"{row.seconds:.1f}")
        texts.append((row.name, *("-" if value is None else str(value) for value in numbers), printable(row.outcome)))
    widths = [max(len(text[column]) for text in texts) for column in range(4)]
    return [
        "  ".join([text[0].ljust(widths[0]), *(text[k].rjust(widths[k]) for k in (1, 2, 3)), text[4]]) for text in texts
    ]


def read_table(file: Path) -> list[dict[str, str]]:
    """Read the rows of an earlier batch.

    Args:
        file: batch.csv; may be missing.

    Returns:
        A dictionary of :data:`COLUMNS` for each row.

    Raises:
        DvoError: a file of the name that no batch has written, or that cannot be read.
    """
    try:
        if not file.exists() and not file.is_symlink():
            return []
        text = file.read_text(encoding="utf-8") if file.is_file() else ""
        reader = csv.DictReader(io.StringIO(text))
        rows = list(reader) if tuple(reader.fieldnames or ()) == COLUMNS else None
    except (OSError, ValueError, csv.Error):
        rows = None
    if rows is None or any(None in row or None in row.values() for row in rows):
        message = "is not a file that dvo batch has written there, and would be replaced"
        raise DvoError(message, file=file, field="--out", remedy="give a new folder")
    return rows


def write_table(file: Path, rows: Iterable[Row], others: Iterable[Mapping[str, str]] = ()) -> None:
    """Write batch.csv as a whole.

    Args:
        file: to create or replace.
        rows: of this batch.
        others: rows of earlier ones, which follow.

    Raises:
        OSError: it cannot be written.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        values = asdict(row).items()
        writer.writerow({name: "" if value is None else printable(value) for name, value in values})
    writer.writerows(others)
    write_text(file, text.getvalue())
