"""The report of an evaluation: results.csv, Markdown tables, figures, and one HTML page that needs nothing else."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.output import write_text
from dvo.data.trajectory import read_tum
from dvo.odometry.protocol import Segment
from eval.execution.cache import slug
from eval.execution.plan import AXES, FIGURE_FOLDER, LOOPS, PAGE, RESULTS, TABLE, Manifest, groundtruth_file
from eval.execution.predict import RECORD, read_prediction, read_segments
from eval.reporting.loops import NOTE, TITLES, loop_lines, loop_table
from eval.reporting.plots import plot_axis, plot_sequence, plot_speed, styles
from eval.reporting.tables import FALSE_POSES_NOTE, SEGMENTS_NOTE, axis_table, markdown, one_line, speed_note, write_csv
from eval.reporting.verdict import verdicts
from eval.scoring.metric_table import BLACKOUT, FIGURES, METRICS, OVERALL, RESOURCES
from eval.scoring.score import Row
from eval.scoring.summary import (
    NOTHING,
    NULL,
    VOID,
    Axis,
    Cell,
    axes_of,
    axis_cell,
    axis_cells,
    axis_rows,
    count_cell,
    error_cell,
    errors_of,
    judged_cells,
    resource_cell,
    segment_columns,
    summarise,
)
from eval.suites.suite import Sequence, Suite

TEMPLATES = Path(__file__).resolve().parent / "templates"


@dataclass(frozen=True)
class Shown:
    """A cell of the table of systems by axis, ready for the page."""

    text: str
    spread: str
    failed: str
    best: bool
    shade: str


def write_tables(out: Path, manifest: Manifest, rows: list[Row]) -> str:
    """Write results.csv, table.md (a table per suite), axes.md and, with revisits, loops.md; returns that of table.md.

    Args:
        out: folder of the evaluation.
        manifest: of the evaluation.
        rows: of all its runs.
    """
    write_csv(out / RESULTS, rows)
    table = "\n".join(markdown(manifest, suite, rows) for suite in manifest.suites)
    write_text(out / TABLE, table)
    write_text(out / AXES, axis_table(manifest, rows))
    loops = loop_table(manifest, rows)
    if loops:
        write_text(out / LOOPS, loops)
    else:
        (out / LOOPS).unlink(missing_ok=True)
    return table


def write_report(
    out: Path, manifest: Manifest, rows: list[Row], say: Callable[[str], None] = lambda text: None
) -> Path:
    """Write report.html with all figures in it, and the figures beside it as SVG files.

    Args:
        out: folder of the evaluation.
        manifest: of the evaluation.
        rows: of all its runs.
        say: called with a line for each figure.

    Returns:
        Path of the page.

    Raises:
        DvoError: jinja2 is not installed.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError:
        raise DvoError("jinja2 is not installed", remedy="pip install -e '.[eval]'") from None
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template("report.html").render(**content(out, manifest, rows, say))
    write_text(out / PAGE, page)
    return out / PAGE


def content(out: Path, manifest: Manifest, rows: list[Row], say: Callable[[str], None]) -> dict[str, Any]:
    """Everything that the page shows.

    Args:
        out, manifest, rows, say: see :func:`write_report`.

    Returns:
        Variables of the template.
    """
    axes = axes_of(manifest)
    figures = Figures(out / FIGURE_FOLDER)
    sections = []
    for suite in manifest.suites:
        for sequence in suite.sequences:
            say(f"figure of {suite.name}, {sequence.name}")
            sections.append(sequence_section(out, manifest, suite, sequence, rows, figures))
    look = styles(manifest.systems)
    return {
        "manifest": manifest,
        "suites": manifest.suites,
        "systems": [(name, manifest.facts[name], look[name].color) for name in manifest.systems],
        "runs": len(rows),
        "failed": sum(row.failed and row.status not in VOID for row in rows),
        "void": sum(row.status in VOID for row in rows),
        "verdicts": verdicts(manifest, rows),
        "axes": [(axis, shown_cells(axis, manifest, rows)) for axis in axes],
        "axis_figures": [axis_figure(axis, manifest, rows, figures) for axis in axes],
        "speed_figures": speed_figures(axes, manifest, rows, figures),
        "speed_note": speed_note(manifest, rows),
        "overall_titles": [metric.title for metric in (*OVERALL, *segment_columns(rows), *RESOURCES)],
        "overall": [(name, overall(name, rows)) for name in manifest.systems],
        "notes": {"segments": SEGMENTS_NOTE, "false poses": FALSE_POSES_NOTE},
        "loops": {"note": NOTE, "titles": TITLES, "lines": loop_lines(manifest, rows)},
        "failures": [(row, one_line(row.reason)) for row in rows if row.failed],
        "sections": sections,
        "open_sections": len(sections) <= 6,
        "null": NULL,
        "has_null": NULL in manifest.systems,
    }


class Figures:
    """Keeps every figure as a file and gives what ``<img src>`` needs to hold it in the page."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def __call__(self, name: str, svg: str) -> str:
        text = svg if "xmlns=" in svg[:400] else svg.replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1)
        write_text(self.folder / f"{slug(name)}.svg", text)
        return "data:image/svg+xml;base64," + base64.b64encode(text.encode()).decode()


def shown_cells(axis: Axis, manifest: Manifest, rows: list[Row]) -> list[Shown]:
    """A line of the table of systems by axis."""
    cells = axis_cells(axis, manifest.systems, rows)
    zero = cells[NULL].median if NULL in cells else math.nan
    shown = []
    for name, found in cells.items():
        if found.note:
            shown.append(Shown(found.note, "", "", False, "void"))
            continue
        failed = f"{found.failed} of {found.runs} failed" if found.failed else ""
        kind = "zero" if name == NULL else shade(found, zero)
        shown.append(Shown(found.middle(axis.digits), found.span(axis.digits, " – "), failed, found.best, kind))
    return shown


def shade(found: Cell, zero: float) -> str:
    """Class of a cell: how its median stands to that of knowing nothing (null), in steps.

    Args:
        found: of a system on an axis.
        zero: median of the null system; nan without one.
    """
    if not math.isfinite(found.median):
        return "lost"
    if not (math.isfinite(zero) and zero > 0):
        return "plain"
    ratio = found.median / zero
    steps = ((0.1, "good3"), (0.25, "good2"), (0.5, "good1"), (1.0, "plain"))
    return next((name for limit, name in steps if ratio < limit), "bad")


def axis_figure(axis: Axis, manifest: Manifest, rows: list[Row], figures: Figures) -> tuple[str, str]:
    """Alternative text and source of the figure of an axis."""
    values: dict[str, list[float]] = {}
    for system in manifest.systems:
        made = [row for row in axis_rows(axis, system, rows) if row.status not in VOID]
        values[system] = [value for value in errors_of(made, axis.judged_by) if not math.isnan(value)]
    zero = axis_cell(axis, NULL, rows).median if NULL in manifest.systems else math.nan
    svg = plot_axis(axis.title, axis.unit, values, zero)
    return f"{axis.title}: {axis.unit} of every run, by system", figures(f"axis_{axis.title}_{axis.judged_by}", svg)


def speed_figures(axes: list[Axis], manifest: Manifest, rows: list[Row], figures: Figures) -> list[tuple[str, str]]:
    """Error against speed, a figure for each kind of error; the null system has no speed worth showing."""
    found = []
    for judge in dict.fromkeys(axis.judged_by for axis in axes):
        places = [
            (axis.suite.name, sequence.name) for axis in axes if axis.judged_by == judge for sequence in axis.sequences
        ]
        points: dict[str, list[tuple[float, float]]] = {}
        for system in manifest.systems:
            if system == NULL:
                continue
            for place in places:
                mine = [
                    r for r in rows if r.system == system and (r.suite, r.sequence) == place and r.status not in VOID
                ]
                if mine:
                    pair = (resource_cell(mine, "fps").median, error_cell(mine, judge).median)
                    points.setdefault(system, []).append(pair)
        if any(math.isfinite(error) and error > 0 for pairs in points.values() for _, error in pairs):
            unit = METRICS[judge].title
            svg = plot_speed(points, unit)
            found.append((f"{unit} against frames a second, by system", figures(f"speed_{judge}", svg)))
    return found


def overall(system: str, rows: list[Row]) -> list[str]:
    """A line of the table of systems: over all their runs.

    Args:
        system: label.
        rows: of all runs.

    Returns:
        Texts of the columns of ``OVERALL`` and of the resources.
    """
    mine = [row for row in rows if row.system == system and row.status not in VOID]
    cells = []
    for metric in OVERALL:
        values = [metric.factor * float(getattr(row, metric.name)) for row in mine]
        found = _mean(values) if metric.over_runs == "mean" else summarise(values).median
        cells.append(_text(found, metric.digits))
    for metric in segment_columns(rows):  # means: most runs have one segment
        values = [metric.factor * float(getattr(row, metric.name)) for row in mine if row.tracked]
        cells.append(_text(_mean(values), max(metric.digits, 1)))
    return cells + [resource_cell(mine, metric.name).middle(metric.digits) for metric in RESOURCES]


def _mean(values: list[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else NOTHING


def sequence_section(
    out: Path, manifest: Manifest, suite: Suite, sequence: Sequence, rows: list[Row], figures: Figures
) -> dict[str, Any]:
    """Table and figure of a sequence; the run that is drawn of a system is the one of median error."""
    mine = [row for row in rows if row.suite == suite.name and row.sequence == sequence.name]
    groups = {name: [row for row in mine if row.system == name] for name in manifest.systems}
    dark = any(row.blackouts for row in mine)
    columns = [*FIGURES, *(BLACKOUT if dark else ()), *RESOURCES]
    extra = segment_columns(mine)
    judged = judged_cells(sequence, groups)
    lines = []
    for name, group in groups.items():
        texts = []
        for metric in columns:
            found = (resource_cell if metric in RESOURCES else error_cell)(group, metric.name)
            texts.append((found.text(metric.digits), metric.name == sequence.judged_by and judged[name].best))
        shares = [summarise([100 * row.completeness for row in group]).text(0)]
        shares += [count_cell(group, metric).text(metric.digits) for metric in extra]
        failed = sum(row.failed for row in group)
        states = ", ".join(dict.fromkeys(row.status for row in group if row.failed))
        lines.append((name, f"{failed}/{len(group)}" + (f" {states}" if states else ""), shares, texts))
    truth_file = groundtruth_file(out, suite.name, sequence.name)
    figure = None
    if truth_file.is_file():
        tracks, spans = _tracks(out, manifest, suite, sequence, groups)
        svg = plot_sequence(suite, sequence.judged_by, read_tum(truth_file), tracks, spans)
        figure = figures(f"{suite.name}__{sequence.name}", svg)
    known = [row.path_length for row in mine if math.isfinite(row.path_length)]
    return {
        "id": slug(f"{suite.name}-{sequence.name}"),
        "suite": suite,
        "sequence": sequence,
        "frames": max((row.frames for row in mine), default=0),
        "length": max(known, default=math.nan),
        "columns": [METRICS["completeness"].title, *(metric.title for metric in (*extra, *columns))],
        "lines": lines,
        "figure": figure,
        "reason": next((one_line(row.reason) for row in mine if row.status == "no data"), ""),
    }


def _tracks(
    out: Path, manifest: Manifest, suite: Suite, sequence: Sequence, groups: dict[str, list[Row]]
) -> tuple[dict[str, tuple[Segment, ...]], list[list[float]]]:
    folders = {(run.system, run.suite, run.sequence, run.seed): out / run.folder for run in manifest.runs}
    tracks: dict[str, tuple[Segment, ...]] = {}
    dark: list[list[float]] = []
    for name, group in groups.items():
        ranked = sorted(group, key=lambda row: errors_of([row], sequence.judged_by)[0])
        if not ranked:
            continue
        folder = folders[name, suite.name, sequence.name, ranked[(len(ranked) - 1) // 2].seed]
        tracks[name] = read_segments(folder)
        if (folder / RECORD).is_file():
            dark = dark or read_prediction(folder).dark
    return tracks, dark
