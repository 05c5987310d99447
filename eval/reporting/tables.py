"""results.csv and the Markdown tables: medians over runs with their range, failed runs counted."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from eval.execution.plan import Manifest
from eval.scoring.score import COLUMNS, Row
from eval.suites.suite import Sequence, Suite

# Column of the table, field of the row, digits.
FIGURES = (
    ("ATE %", "ate_percent", 2),
    ("ATE m", "ate_rmse", 3),
    ("RPE m", "rpe_trans", 4),
    ("RPE °", "rpe_rot_deg", 3),
    ("rot. error / rot.", "rotation_error_ratio", 2),
    ("scale drift", "scale_drift", 2),
)
RESOURCES = (("frames/s", "fps", 1), ("p95 ms", "latency_p95_ms", 0), ("MB", "peak_memory_mb", 0))
UNITS = {"ate_percent": "ATE %", "rpe_rot_deg": "RPE °", "segment_ate_percent": "segment ATE %", "recovery_s": "s"}
DIGITS = {field: digits for _, field, digits in FIGURES}
NULL = "null"
VOID = ("no data", "not run", "unavailable")  # states that say nothing about how well a system does


@dataclass(frozen=True)
class Axis:
    """One line of the table of systems by axis: the sequences of a suite that are judged by the same error."""

    suite: Suite
    judged_by: str
    sequences: tuple[Sequence, ...]
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
        """Of the figures."""
        return UNITS.get(self.judged_by, self.judged_by)


@dataclass(frozen=True)
class Cell:
    """A system on an axis.

    Attributes:
        median, low, high: over sequences and seeds, failed runs counting as infinite; nan without runs.
        failed, runs: counts.
        note: in place of figures, where there is nothing to compute.
    """

    median: float
    low: float
    high: float
    failed: int
    runs: int
    note: str = ""


def axes_of(manifest: Manifest) -> list[Axis]:
    """The lines of the table of systems by axis."""
    axes = []
    for suite in manifest.suites:
        judges = list(dict.fromkeys(str(sequence.judged_by) for sequence in suite.sequences))
        for judge in judges:
            part = tuple(sequence for sequence in suite.sequences if sequence.judged_by == judge)
            axes.append(Axis(suite, judge, part, len(judges) > 1))
    return axes


def cell(axis: Axis, system: str, rows: list[Row]) -> Cell:
    """The figures of one system on one axis."""
    names = {sequence.name for sequence in axis.sequences}
    mine = [row for row in rows if row.system == system and row.suite == axis.suite.name and row.sequence in names]
    told = [row for row in mine if row.status not in VOID]
    if not told:
        return Cell(math.nan, math.nan, math.nan, 0, 0, mine[0].status if mine else "not run")
    values = errors_of(told, axis.judged_by)
    known = [value for value in values if not math.isnan(value)]
    failed = sum(row.failed for row in told)
    if not known:
        return Cell(math.nan, math.nan, math.nan, failed, len(told), "–")
    return Cell(float(np.median(known)), min(known), max(known), failed, len(told))


def best_of(cells: dict[str, Cell], digits: int) -> set[str]:
    """The systems with the smallest median, to the digits shown."""
    finite = {name: round(cell.median, digits) for name, cell in cells.items() if math.isfinite(cell.median)}
    return {name for name, value in finite.items() if value == min(finite.values())}


def axis_table(manifest: Manifest, rows: list[Row]) -> str:
    """The table of systems by axis for the README: medians, bold the best of a line, failed runs in brackets."""
    systems = list(manifest.systems)
    lines = [_line(["axis", "median", *systems]), _line(["---", "---", *["--:"] * len(systems)])]
    for axis in axes_of(manifest):
        cells = {name: cell(axis, name, rows) for name in systems}
        digits = DIGITS.get(axis.judged_by, 2)
        best = best_of(cells, digits)
        texts = [cell_text(found, digits, bold=name in best) for name, found in cells.items()]
        lines.append(_line([axis.title, axis.unit, *texts]))
    return "\n".join(lines) + "\n"


def cell_text(found: Cell, digits: int, bold: bool = False) -> str:
    """``1.23 (2/6 failed)``."""
    if found.note:
        return found.note
    text = f"{found.median:.{digits}f}" if math.isfinite(found.median) else "–"
    text = f"**{text}**" if bold else text
    return f"{text} ({found.failed}/{found.runs} failed)" if found.failed else text


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    """Every run, one line each; an empty cell is a value without meaning, ``inf`` one that was never reached."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            writer.writerow([_csv(value) for value in asdict(row).values()])


def markdown(manifest: Manifest, suite: Suite, rows: list[Row]) -> str:
    """The table of a suite, protocol first.

    Every figure is the median over seeds, with minimum and maximum in brackets where they differ. A failed run counts
    as infinite in the median of an error, so a system that fails more often than not has no figure. The best value of
    the column that decides a sequence is bold.
    """
    rows = [row for row in rows if row.suite == suite.name]
    systems = list(dict.fromkeys(row.system for row in rows))
    names = ["sequence", "system", "runs failed", *(title for title, _, _ in FIGURES), "complete %"]
    names += [title for title, _, _ in RESOURCES]
    lines = [protocol(manifest, suite, rows), "", _line(names), _line(["---"] * 2 + ["--:"] * (len(names) - 2))]
    for sequence in suite.sequences:
        groups = {name: [r for r in rows if r.sequence == sequence.name and r.system == name] for name in systems}
        groups = {name: group for name, group in groups.items() if group}
        judged = {name: _median(errors_of(group, sequence.judged_by)) for name, group in groups.items()}
        best = min(judged.values(), default=math.inf)
        for position, (name, group) in enumerate(groups.items()):
            cells = []
            for _, field, digits in FIGURES:
                text = summary(errors_of(group, field), digits)
                won = field == sequence.judged_by and math.isfinite(best) and judged[name] == best
                cells.append(f"**{text}**" if won else text)
            cells.append(summary([100 * row.completeness for row in group], 0))
            cells += [summary([getattr(row, field) for row in group], digits) for _, field, digits in RESOURCES]
            failed = sum(row.failed for row in group)
            title = f"{sequence.name} ({sequence.about})" if sequence.about else sequence.name
            lines.append(_line([title if position == 0 else "", name, f"{failed}/{len(group)}", *cells]))
    failures = [row for row in rows if row.failed]
    if failures:
        lines += ["", "Failed runs:", ""]
        lines += [
            f"- {r.system}, {r.sequence}, seed {r.seed}: {r.status}: {one_line(r.reason) or 'no reason given'}"
            for r in failures
        ]
    return "\n".join(lines) + "\n"


def protocol(manifest: Manifest, suite: Suite, rows: list[Row]) -> str:
    """What the figures of a suite stand for, in a few sentences (Markdown)."""
    seeds = manifest.seeds
    sizes = {
        name: ", ".join(dict.fromkeys(r.resolution for r in rows if r.system == name and r.resolution))
        for name in dict.fromkeys(row.system for row in rows)
    }
    worked = "; ".join(f"{name}: {size}" for name, size in sizes.items() if size)
    judges = list(dict.fromkeys(sequence.judged_by for sequence in suite.sequences))
    turned = [sequence.name for sequence in suite.sequences if sequence.judged_by == "rpe_rot_deg"]
    said = "by ATE in percent of the path" + (f", {', '.join(turned)} by RPE in degrees" if turned else "")
    if judges == ["rpe_rot_deg"]:
        said = "by RPE in degrees"
    sentences = [
        f"**{suite.label}** (suite `{suite.name}`).",
        f"Alignment {suite.alignment}; every {suite.stride}. image fed;"
        if suite.stride > 1
        else f"Alignment {suite.alignment}; stride 1;",
        f"seeds {', '.join(map(str, seeds))}: median [min–max]." if len(seeds) > 1 else f"seed {seeds[0]}.",
        f"RPE over {suite.rpe_gap} frames, median over the sequence; errors by evo.",
        f"Sequences are judged {said} (bold: best).",
        f"A run fails if it crashes, takes over {suite.time_limit:g} s, leaves poses that are not finite or poses for "
        f"fewer than {100 * suite.lost_below:g} % of the frames; failed runs count as infinite errors.",
        f"Working resolution: {worked}." if worked else "",
        speed_note(manifest, rows),
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def speed_note(manifest: Manifest, rows: list[Row]) -> str:
    """How the speed columns were taken."""
    threads = sorted({row.threads for row in rows if row.threads}) or [manifest.threads]
    counts = " or ".join(map(str, threads)) + f" thread{'s' if threads != [1] else ''}"
    parallel = max((row.parallel for row in rows), default=1)
    shared = f", taken with {parallel} runs at a time: no speed of a machine at rest" if parallel > 1 else ""
    return f"Speed without reading images, {counts} on {manifest.device} ({manifest.machine}){shared}."


def errors_of(rows: list[Row], field: str) -> list[float]:
    """A field of every row, infinite where the run failed."""
    return [math.inf if row.failed else float(getattr(row, field)) for row in rows]


def summary(values: list[float], digits: int) -> str:
    """``median [min–max]``."""
    known = [value for value in values if not math.isnan(value)]
    if not known or not math.isfinite(np.median(known)):
        return "–"
    figures = (float(function(known)) for function in (np.median, np.min, np.max))
    middle, low, high = (f"{value:.{digits}f}" if math.isfinite(value) else "∞" for value in figures)
    return middle if low == high else f"{middle} [{low}–{high}]"


def one_line(text: str) -> str:
    """Without line breaks."""
    return " ".join(text.split())


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values and not np.isnan(values).any() else math.inf


def _csv(value: object) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.9g}"
    return one_line(str(value))


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"
