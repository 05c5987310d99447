"""Measurements of the study of the family: tables in CSV, a row appended as soon as it is measured."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from dvo.core.errors import DvoError
from train.studies.family.config import NULL, FamilyConfig

Row = dict[str, str]
"""Column to text. The texts of numbers are those of Python, ``nan`` and ``inf`` included."""


@dataclass(frozen=True)
class Table:
    """Table in a CSV file, to which several processes may append.

    Attributes:
        file: of the table.
        key: columns that tell the rows apart; of equal ones the last row counts.
        columns: the others.
    """

    file: Path
    key: tuple[str, ...]
    columns: tuple[str, ...]

    def append(self, **values: object) -> None:
        """Add a row.

        Args:
            values: by column; floats are rounded to six digits.

        Raises:
            KeyError: a column is missing.
        """
        names = (*self.key, *self.columns)
        texts = [f"{v:.6g}" if isinstance(v, float) else str(v) for v in (values[name] for name in names)]
        self.file.parent.mkdir(parents=True, exist_ok=True)
        with self.file.open("a+b") as file, _alone(file):
            end = file.seek(0, os.SEEK_END)
            before = "" if end else _line(names)
            if end and file.seek(end - 1) and file.read(1) != b"\n":  # of a process that was killed
                before = "," * len(names) + "\n"  # too many fields: the row does not count
            file.write((before + _line(texts)).encode())

    def rows(self) -> list[Row]:
        """Rows in the order of their first appearance; none if there is no file.

        Raises:
            DvoError: a file with other columns.
        """
        if not self.file.is_file():
            return []
        text = self.file.read_bytes().decode()
        reader = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1], newline=""))
        missing = [name for name in (*self.key, *self.columns) if name not in (reader.fieldnames or ())]
        if missing and text:
            remedy = "remove it, or take the version that this program wrote"
            raise DvoError(f"has no column '{missing[0]}'", file=self.file, remedy=remedy)
        # A row that was cut off has no end of line, or too many fields since append() went on behind it.
        whole = (row for row in reader if None not in row and None not in row.values())
        found = {tuple(row[name] for name in self.key): row for row in whole}
        return list(found.values())


@contextmanager
def _alone(file: IO[bytes]) -> Iterator[None]:
    """Lock a file against other processes that append to it, where the system can."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    fcntl.flock(file, fcntl.LOCK_EX)
    try:
        yield
        file.flush()
    finally:
        fcntl.flock(file, fcntl.LOCK_UN)


def _line(texts: Iterable[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(texts)
    return line.getvalue()


class Records:
    """All measurements of the study.

    Args:
        config: names the folder, and the settings that the measurements must have been made with.

    Attributes:
        runs: a row a training run.
        curves: a row a sequence and point of the learning curve.
        sequences: a row a run and sequence.
        pairs: a row a run, sequence and gap, with the errors of all pairs of frames.
    """

    def __init__(self, config: FamilyConfig) -> None:
        self.config = config
        folder = Path(config.out)
        run = ("member", "seed")
        self.runs = Table(
            folder / "runs.csv", run, ("digest", "parameters", "steps", "clips", "skipped", "seconds", "memory_mb")
        )
        self.curves = Table(
            folder / "curves.csv", (*run, "point", "sequence"),
            ("digest", "step", "seconds", "auc_10", "rotation_ratio", "posed"),
        )  # fmt: skip
        self.sequences = Table(
            folder / "sequences.csv", (*run, "sequence"),
            ("digest", "frames", "posed", "segments", "ate_percent", "rotation_ratio", "fps", "memory_mb"),
        )  # fmt: skip
        self.pairs = Table(folder / "pairs.csv", (*run, "sequence", "gap"), ("digest", "errors_deg"))

    @property
    def tables(self) -> tuple[Table, ...]:
        """All tables."""
        return self.runs, self.curves, self.sequences, self.pairs

    def check(self) -> None:
        """Check that the measurements of the configured members were made with the settings of the configuration.

        Raises:
            DvoError: some were not.
        """
        names = [*self.config.members, NULL]
        for table in self.tables:
            for row in table.rows():
                if row["member"] in names and row["digest"] != self.config.digest(row["member"]):
                    raise DvoError(
                        f"holds measurements of {row['member']} with other settings",
                        file=table.file,
                        remedy="remove the rows of this member from all tables of the folder, or restore the settings",
                    )

    def measured(self, member: str, seed: int) -> set[str]:
        """Names of the sequences that a run is measured on.

        Args:
            member, seed: of the run.
        """
        wanted = [member, str(seed)]
        return {row["sequence"] for row in self.sequences.rows() if [row["member"], row["seed"]] == wanted}

    def trained(self, member: str, seed: int) -> bool:
        """Answer whether a run is trained; :data:`train.studies.family.config.NULL` needs no training.

        Args:
            member, seed: of the run.
        """
        wanted = [member, str(seed)]
        return member == NULL or any([row["member"], row["seed"]] == wanted for row in self.runs.rows())

    def complete(self, member: str, seed: int) -> bool:
        """Answer whether there is nothing left to do for a run.

        Args:
            member, seed: of the run.
        """
        return self.trained(member, seed) and self.measured(member, seed) >= set(self.config.held_out.sequences())
