"""Summary of runs: median, range, failures and the best system; the one source of tables, report, verdicts and figures.

One rule for all of them: a failed run counts as an infinite error and is never left out; a value without a meaning
(nan) is left out; a run that could not be made (no data, system not installed) is
left out where systems are compared over an axis.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dvo.metrics.table import Metric
from eval.execution.plan import Manifest
from eval.scoring.metric_table import DARK, FALSE_POSES, INERTIAL, METRICS, SEGMENTS, VERDICTS
from eval.scoring.metric_table import NEVER_MADE as VOID
from eval.scoring.score import Row
from eval.suites.suite import Sequence as Recording
from eval.suites.suite import Suite

NULL = "null"
NOTHING = "–"


@dataclass(frozen=True)
class Axis:
    """One line of the table of systems by axis: the sequences of a suite that are judged by the same error.

    Attributes:
        suite, sequences: the suite, and those of its sequences.
        judged_by: field of the row.
        shared: whether the suite has another axis.
    """

    suite: Suite
    judged_by: str
    sequences: tuple[Recording, ...]
    shared: bool = False

    @property
    def title(self) -> str:
        """Name of the suite, and what sets this part of it apart."""
        name = self.suite.name.replace("_", " ")
        if not self.shared:
            return name
        return f"{name}: {', '.join(one.name for one in self.sequences)}" if len(self.sequences) == 1 else name

    @property
    def unit(self) -> str:
        """Name of the error, with its unit."""
        return METRICS[self.judged_by].title

    @property
    def digits(self) -> int:
        """Digits after the point with which the error is shown."""
        return METRICS[self.judged_by].digits


@dataclass(frozen=True)
class Cell:
    """Summary of one quantity over some runs.

    Attributes:
        median, low, high: over sequences and seeds, failed runs counting as infinite; nan without a value.
        failed, runs: counts.
        note: in place of figures, where there is nothing to compute.
        best: no other system of the line has a smaller median.
    """

    median: float
    low: float
    high: float
    failed: int
    runs: int
    note: str = ""
    best: bool = False

    def middle(self, digits: int) -> str:
        """Median as text; a dash where more than half of the runs failed, or none has a value."""
        return f"{self.median:.{digits}f}" if math.isfinite(self.median) else NOTHING

    def span(self, digits: int, dash: str = "–") -> str:
        """Range as text, ``∞`` for a failed run; empty if all values are shown alike."""
        low, high = (f"{value:.{digits}f}" if math.isfinite(value) else "∞" for value in (self.low, self.high))
        return "" if low == high else f"{low}{dash}{high}"

    def text(self, digits: int) -> str:
        """``median [min–max]``."""
        if not math.isfinite(self.median):
            return NOTHING
        span = self.span(digits)
        return f"{self.middle(digits)} [{span}]" if span else self.middle(digits)

    def short(self, digits: int) -> str:
        """``1.23 (2/6 failed)``, bold in Markdown where it is the best."""
        if self.note:
            return self.note
        text = f"**{self.middle(digits)}**" if self.best else self.middle(digits)
        return f"{text} ({self.failed}/{self.runs} failed)" if self.failed else text


def summarise(values: Iterable[float], failed: int = 0, runs: int | None = None) -> Cell:
    """Summary of some values.

    Args:
        values: infinite for a failed run; nan, without a meaning, is left out.
        failed, runs: counts; ``runs`` is the number of values if it is not given.

    Example:
        >>> summarise([3.0, 1.0, math.inf]).text(1)
        '3.0 [1.0–∞]'
    """
    given = list(values)
    known = [value for value in given if not math.isnan(value)]
    count = len(given) if runs is None else runs
    if not known:
        return Cell(math.nan, math.nan, math.nan, failed, count)
    return Cell(float(np.median(known)), float(min(known)), float(max(known)), failed, count)


def quartiles(values: Iterable[float]) -> tuple[float, float, float] | None:
    """Quartiles of the runs that did not fail; None without any.

    Args:
        values: infinite for a failed run, nan without a meaning.
    """
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return None
    left, middle, right = np.quantile(known, [0.25, 0.5, 0.75])
    return float(left), float(middle), float(right)


def errors_of(rows: Iterable[Row], field: str) -> list[float]:
    """Field of every row, infinite where the run failed.

    Args:
        rows: of some runs.
        field: column of results.csv.
    """
    return [math.inf if row.failed else float(getattr(row, field)) for row in rows]


def error_cell(rows: Sequence[Row], field: str) -> Cell:
    """Summary of an error over some runs.

    Args:
        rows: of some runs.
        field: column of results.csv.
    """
    return summarise(errors_of(rows, field), failed=sum(row.failed for row in rows))


def resource_cell(rows: Sequence[Row], field: str) -> Cell:
    """Summary of a quantity that failed runs have too: speed, memory, completeness.

    Args:
        rows: of some runs.
        field: column of results.csv.
    """
    return summarise([float(getattr(row, field)) for row in rows], failed=sum(row.failed for row in rows))


def inertial_columns(suite: Suite, rows: Iterable[Row]) -> list[Metric]:
    """Columns on metric poses that a table of some runs needs.

    Args:
        suite: of the table.
        rows: of the table.
    """
    if all(sequence.inertial is None for sequence in suite.sequences):
        return []
    return [*INERTIAL, *(DARK if any(row.blackouts for row in rows) else ())]


def segment_columns(rows: Iterable[Row]) -> list[Metric]:
    """Columns on segments, frames without a view and verdicts that a table of some runs needs.

    Args:
        rows: of the table.
    """
    rows = list(rows)
    unseen = any(row.unseen for row in rows)
    several = any(row.segments > 1 for row in rows)
    told = any(row.doubted == 1 or row.silent == 1 for row in rows)
    return [
        *(SEGMENTS if several or any(row.blackouts for row in rows) else ()),
        *(FALSE_POSES if unseen else ()), *(VERDICTS if told else ()),
    ]  # fmt: skip


def count_cell(rows: Iterable[Row], metric: Metric) -> Cell:
    """Summary of a count or a share over the runs that left a trajectory, as it is shown.

    Args:
        rows: of some runs.
        metric: the column.
    """
    values = [metric.factor * float(getattr(row, metric.name)) for row in rows if row.tracked]
    known = [value for value in values if not math.isnan(value)]
    if metric.over_runs == "mean" and known:
        mean = float(np.mean(known))
        return Cell(mean, mean, mean, 0, len(values))
    return summarise(values)


def best_of(cells: Mapping[str, Cell], digits: int | None = None) -> set[str]:
    """Systems with the smallest finite median.

    Args:
        cells: by system.
        digits: medians that agree to these digits tie; None compares them as they are.
    """
    finite = {name: cell.median for name, cell in cells.items() if math.isfinite(cell.median)}
    if digits is not None:
        finite = {name: round(value, digits) for name, value in finite.items()}
    return {name for name, value in finite.items() if value == min(finite.values())}


def mark_best(cells: Mapping[str, Cell], digits: int | None = None) -> dict[str, Cell]:
    """The cells with :attr:`Cell.best` set, see :func:`best_of`."""
    best = best_of(cells, digits)
    return {name: replace(cell, best=name in best) for name, cell in cells.items()}


def axes_of(manifest: Manifest) -> list[Axis]:
    """Lines of the table of systems by axis."""
    axes = []
    for suite in manifest.suites:
        judges = list(dict.fromkeys(str(sequence.judged_by) for sequence in suite.sequences))
        for judge in judges:
            part = tuple(sequence for sequence in suite.sequences if sequence.judged_by == judge)
            axes.append(Axis(suite, judge, part, len(judges) > 1))
    return axes


def axis_rows(axis: Axis, system: str, rows: Iterable[Row]) -> list[Row]:
    """Runs of one system on one axis."""
    names = {sequence.name for sequence in axis.sequences}
    return [row for row in rows if row.system == system and row.suite == axis.suite.name and row.sequence in names]


def axis_cell(axis: Axis, system: str, rows: Iterable[Row]) -> Cell:
    """Summary of one system on one axis.

    Args:
        axis: line of the table.
        system: label.
        rows: of all runs.

    Returns:
        A cell with a note where no run was made, or none has a value.
    """
    mine = axis_rows(axis, system, rows)
    made = [row for row in mine if row.status not in VOID]
    if not made:
        return Cell(math.nan, math.nan, math.nan, 0, 0, mine[0].status if mine else "not run")
    found = error_cell(made, axis.judged_by)
    return replace(found, note=NOTHING) if math.isnan(found.median) else found


def axis_cells(axis: Axis, systems: Iterable[str], rows: Sequence[Row]) -> dict[str, Cell]:
    """A line of the table of systems by axis, the best marked to the digits shown.

    Args:
        axis: line of the table.
        systems: labels.
        rows: of all runs.
    """
    return mark_best({name: axis_cell(axis, name, rows) for name in systems}, axis.digits)


def judged_cells(sequence: Recording, groups: Mapping[str, Sequence[Row]]) -> dict[str, Cell]:
    """Systems on one sequence, by the error that decides it, the best marked.

    Args:
        sequence: of the runs.
        groups: its runs by system.
    """
    return mark_best({name: error_cell(group, sequence.judged_by) for name, group in groups.items()})
