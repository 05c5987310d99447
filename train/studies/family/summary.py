"""Figures of a member of the family from the tables of measurements: pooled over sequences, then over seeds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dvo.metrics.relative_pose import recall_area
from train.studies.family.records import Records, Row

LIMITS = (1.0, 2.0, 5.0, 10.0)
"""Degrees up to which the area under the recall curve is taken."""


@dataclass(frozen=True)
class Spread:
    """Median and range over the seeds; infinite where a value is missing, which is worse than any."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Spread:
        """Spread of some values, nan taken for a missing one; nan without any."""
        found = np.array([np.inf if np.isnan(value) else value for value in values], float)
        if not len(found):
            return cls(np.nan, np.nan, np.nan)
        ordered = np.sort(found)
        middle = ordered[[(len(found) - 1) // 2, len(found) // 2]]
        return cls(float(middle.sum() / 2), float(ordered[0]), float(ordered[-1]))

    def times(self, factor: float) -> Spread:
        """The spread in another unit."""
        return Spread(self.median * factor, self.low * factor, self.high * factor)

    def text(self, digits: int) -> str:
        """``median [low-high]``, the range only if there is one; a dash for no value."""
        if not np.isfinite(self.median):
            return "–"
        text = f"{self.median:,.{digits}f}"
        return text if self.low == self.high else f"{text} [{self.low:,.{digits}f}-{self.high:,.{digits}f}]"


@dataclass(frozen=True)
class MemberSummary:
    """Figures of a member.

    Attributes:
        name: of the member.
        seeds: that are measured on all sequences.
        area: area under the recall curve by limit (degrees) and gap (frames), 0 for all gaps pooled.
        errors: pooled errors of the pairs of all seeds, degrees.
        ate_percent, rotation_ratio: medians over the sequences.
        posed: share of the frames with a pose, all sequences together.
        segments: mean number of worlds of a sequence.
        fps: median over the sequences, frames a second of one processor.
        memory_mb: highest over the sequences.
        training_mb, steps, seconds, parameters: of the training runs; nan without one.
    """

    name: str
    seeds: tuple[int, ...]
    area: dict[tuple[float, int], Spread]
    errors: np.ndarray
    ate_percent: Spread
    rotation_ratio: Spread
    posed: Spread
    segments: Spread
    fps: Spread
    memory_mb: Spread
    training_mb: Spread
    steps: Spread
    seconds: Spread
    parameters: Spread


def summarise(records: Records, name: str) -> MemberSummary | None:
    """Figures of a member.

    Args:
        records: of the study.
        name: of the member.

    Returns:
        None if no seed is measured on all sequences.
    """
    wanted = set(records.config.held_out.sequences())
    rows = [row for row in records.sequences.rows() if row["member"] == name and row["sequence"] in wanted]
    found = sorted({int(row["seed"]) for row in rows})
    seeds = [seed for seed in found if records.measured(name, seed) >= wanted]
    if not seeds:
        return None
    by_seed = [[row for row in rows if int(row["seed"]) == seed] for seed in seeds]
    pairs = [row for row in records.pairs.rows() if row["member"] == name and row["sequence"] in wanted]
    errors = [[row for row in pairs if int(row["seed"]) == seed] for seed in seeds]
    runs = [row for row in records.runs.rows() if row["member"] == name and int(row["seed"]) in seeds]
    area = {}
    for gap in (0, *records.config.held_out.gaps):
        areas = [recall_area(pooled(some, gap), LIMITS) for some in errors]
        area |= {(limit, gap): Spread.of(one[limit] for one in areas) for limit in LIMITS}

    def over_sequences(column: str) -> Spread:
        return Spread.of(Spread.of(float(row[column]) for row in some).median for some in by_seed)

    def of_runs(column: str) -> Spread:
        return Spread.of(float(row[column]) for row in runs)

    return MemberSummary(
        name=name, seeds=tuple(seeds), area=area, errors=pooled([row for some in errors for row in some]),
        ate_percent=over_sequences("ate_percent"), rotation_ratio=over_sequences("rotation_ratio"),
        posed=Spread.of(total(some, "posed") / max(total(some, "frames"), 1) for some in by_seed),
        segments=Spread.of(total(some, "segments") / len(some) for some in by_seed), fps=over_sequences("fps"),
        memory_mb=Spread.of(max(float(row["memory_mb"]) for row in some) for some in by_seed),
        training_mb=of_runs("memory_mb"), steps=of_runs("steps"), seconds=of_runs("seconds"),
        parameters=of_runs("parameters"),
    )  # fmt: skip


def pooled(rows: Iterable[Row], gap: int = 0) -> np.ndarray:
    """Errors of all pairs of some rows of the table of pairs.

    Args:
        rows: of :attr:`train.studies.family.records.Records.pairs`.
        gap: frames between the two of a pair; 0 for all.
    """
    texts = [row["errors_deg"] for row in rows if gap in (0, int(row["gap"]))]
    return np.array([float(word) for text in texts for word in text.split()])


def total(rows: Iterable[Row], column: str) -> float:
    """Sum of a column."""
    return sum(float(row[column]) for row in rows)


@dataclass(frozen=True)
class Curve:
    """Learning curve of a member.

    Attributes:
        hours: ``(P,)`` of the processor, median over the seeds.
        values: ``(seeds, P)`` mean over the sequences; nan where there is none.
    """

    hours: np.ndarray
    values: np.ndarray


def learning_curve(records: Records, name: str, column: str) -> Curve | None:
    """Learning curve of a member, at the points that all its measured seeds have.

    Args:
        records: of the study.
        name: of the member.
        column: of the table of curves.

    Returns:
        None without a point.
    """
    cells: dict[int, dict[int, list[tuple[float, float]]]] = {}
    for row in records.curves.rows():
        if row["member"] == name:
            point = cells.setdefault(int(row["point"]), {}).setdefault(int(row["seed"]), [])
            point.append((float(row["seconds"]) / 3600, float(row[column])))
    seeds = sorted({seed for point in cells.values() for seed in point})
    points = sorted(point for point, found in cells.items() if set(found) == set(seeds))
    if not points:
        return None
    table = np.array([[np.mean(cells[point][seed], axis=0) for point in points] for seed in seeds])
    return Curve(np.median(table[:, :, 0], axis=0), table[:, :, 1])
