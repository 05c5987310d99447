"""results.csv and the Markdown tables: medians over runs with their range, failed runs counted."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from dvo.data.files.output import replaced
from dvo.metrics.segment_metrics import FRAMES_PER_WORLD, SEGMENT_POSES
from eval.execution.plan import Manifest
from eval.scoring.metric_table import FIGURES, METRICS, RECOVERY, RESOURCES, SCALE
from eval.scoring.score import COLUMNS, Row
from eval.scoring.summary import (
    axes_of,
    axis_cells,
    count_cell,
    error_cell,
    inertial_columns,
    judged_cells,
    resource_cell,
    segment_columns,
    summarise,
)
from eval.suites.suite import Suite

SEGMENTS_NOTE = (
    f"Each segment of a trajectory is aligned on its own; errors are taken over the frames of all that are scored. Of "
    f"several, those with {SEGMENT_POSES} poses are scored, the longest first, at most one and one more for each gap "
    f"without a view and each {FRAMES_PER_WORLD} frames; a run fails if the scored part is too small. Compare ATE of "
    f"different numbers of segments with care: cutting lowers it."
)
FALSE_POSES_NOTE = "False poses: share of the frames without a view (black, white, noise) that have a pose."


def axis_table(manifest: Manifest, rows: list[Row]) -> str:
    """Table of systems by axis for the README: medians, bold the best of a line, failed runs in brackets.

    Args:
        manifest: of the evaluation.
        rows: of all its runs.

    Returns:
        Markdown.
    """
    systems = list(manifest.systems)
    lines = [table_line(["axis", "median", *map(escape, systems)])]
    lines.append(table_line(["---", "---", *["--:"] * len(systems)]))
    for axis in axes_of(manifest):
        cells = axis_cells(axis, systems, rows)
        lines.append(table_line([escape(axis.title), axis.unit, *(cell.short(axis.digits) for cell in cells.values())]))
    return "\n".join(lines) + "\n"


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    """Every run, one line each; an empty cell is a value without meaning, ``inf`` one that was never reached.

    Args:
        path: file; replaced if it exists.
        rows: in the order of the file.
    """
    with replaced(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            writer.writerow([_csv(value) for value in asdict(row).values()])


def markdown(manifest: Manifest, suite: Suite, rows: list[Row]) -> str:
    """The table of a suite, protocol first.

    Every figure is the median over seeds, with minimum and maximum in brackets where they differ. A failed run counts
    as infinite in the median of an error, so a system that fails more often than not has no figure. The best value of
    the column that decides a sequence is bold.

    Args:
        manifest: of the evaluation.
        suite: of the table.
        rows: of all runs; those of other suites are left out.
    """
    rows = [row for row in rows if row.suite == suite.name]
    systems = list(dict.fromkeys(row.system for row in rows))
    extra = [*inertial_columns(suite, rows), *segment_columns(rows)]
    figures = [*FIGURES, *(SCALE if suite.alignment == "se3" else ())]
    figures += RECOVERY if any(one.judged_by == "recovery_s" for one in suite.sequences) else ()
    names = ["sequence", "system", "runs failed", *(metric.title for metric in figures), METRICS["completeness"].title]
    names += [metric.title for metric in (*extra, *RESOURCES)]
    lines = [
        protocol(manifest, suite, rows),
        "",
        table_line(names),
        table_line(["---"] * 2 + ["--:"] * (len(names) - 2)),
    ]
    for sequence in suite.sequences:
        groups = {name: [r for r in rows if r.sequence == sequence.name and r.system == name] for name in systems}
        groups = {name: group for name, group in groups.items() if group}
        judged = judged_cells(sequence, groups)
        for position, (name, group) in enumerate(groups.items()):
            cells = []
            for metric in figures:
                text = error_cell(group, metric.name).text(metric.digits)
                cells.append(f"**{text}**" if metric.name == sequence.judged_by and judged[name].best else text)
            cells.append(summarise([100 * row.completeness for row in group]).text(0))
            cells += [count_cell(group, metric).text(metric.digits) for metric in extra]
            cells += [resource_cell(group, metric.name).text(metric.digits) for metric in RESOURCES]
            failed = sum(row.failed for row in group)
            title = f"{sequence.name} ({sequence.about})" if sequence.about else sequence.name
            lines.append(
                table_line([escape(title) if position == 0 else "", escape(name), f"{failed}/{len(group)}", *cells])
            )
    failures = [row for row in rows if row.failed]
    if failures:
        lines += ["", "Failed runs:", ""]
        lines += [
            f"- {escape(r.system)}, {escape(r.sequence)}, seed {r.seed}: {escape(r.status)}: "
            f"{escape(r.reason) or 'no reason given'}"
            for r in failures
        ]
    return "\n".join(lines) + "\n"


def protocol(manifest: Manifest, suite: Suite, rows: list[Row]) -> str:
    """Protocol of a suite in a few sentences (Markdown).

    Args:
        manifest: of the evaluation.
        suite: to describe.
        rows: of its runs.
    """
    seeds = manifest.seeds
    sizes = {
        name: ", ".join(dict.fromkeys(r.resolution for r in rows if r.system == name and r.resolution))
        for name in dict.fromkeys(row.system for row in rows)
    }
    worked = "; ".join(f"{escape(name)}: {escape(size)}" for name, size in sizes.items() if size)
    judges = list(dict.fromkeys(sequence.judged_by for sequence in suite.sequences))
    names = {judge: [sequence.name for sequence in suite.sequences if sequence.judged_by == judge] for judge in judges}
    usual = max(judges, key=lambda judge: len(names[judge]))
    said = f"by {METRICS[usual].title}"
    others = [judge for judge in judges if judge != usual]
    said += "".join(f", {', '.join(map(escape, names[judge]))} by {METRICS[judge].title}" for judge in others)
    sentences = [
        f"**{escape(suite.label)}** (suite {escape(suite.name)}).",
        f"Alignment {suite.alignment}; every {suite.stride}. image fed;"
        if suite.stride > 1
        else f"Alignment {suite.alignment}; stride 1;",
        f"seeds {', '.join(map(str, seeds))}: median [min–max]." if len(seeds) > 1 else f"seed {seeds[0]}.",
        f"RPE over {suite.rpe_gap} frames, median over the sequence; errors by evo.",
        f"Sequences are judged {said} (bold: best).",
        f"A run fails if it crashes, takes over {suite.time_limit:g} s, leaves poses that are not finite or poses for "
        f"fewer than {100 * suite.lost_below:g} % of the frames; failed runs count as infinite errors.",
        SEGMENTS_NOTE if any(row.segments > 1 for row in rows) else "",
        FALSE_POSES_NOTE if any(row.unseen for row in rows) else "",
        f"Working resolution: {worked}." if worked else "",
        escape(speed_note(manifest, rows)),
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def speed_note(manifest: Manifest, rows: list[Row]) -> str:
    """Sentence on the measurement of the speed columns."""
    threads = sorted({row.threads for row in rows if row.threads}) or [manifest.threads]
    counts = " or ".join(map(str, threads)) + f" thread{'s' if threads != [1] else ''}"
    parallel = max((row.parallel for row in rows), default=1)
    shared = f", taken with {parallel} runs at a time: no speed of a machine at rest" if parallel > 1 else ""
    return f"Speed without reading images, {counts} on {manifest.device} ({manifest.machine}){shared}."


def one_line(text: str) -> str:
    """Without line breaks."""
    return " ".join(text.split())


def escape(text: str) -> str:
    """The text as Markdown shows it: on one line, without markup, HTML, named links or the end of a cell.

    Args:
        text: name of a system, a sequence or a suite, message of a program: anything.

    Returns:
        Markdown for a cell or a sentence.

    Example:
        >>> escape("a|b [c](http://d) <e>")
        'a\\|b \\[c\\](http://d) &lt;e&gt;'
    """
    plain = "".join(letter if letter.isprintable() else " " for letter in one_line(text)).replace("&", "&amp;")
    marked = re.sub(r"[\\`*\[\]|~#]|(?<!\w)_|_(?!\w)|@(?=\w)", r"\\\g<0>", plain)
    return re.sub(r"^(\d*)([-+.)])(?=\s)", r"\1\\\2", marked.replace("<", "&lt;").replace(">", "&gt;"))


def _csv(value: object) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.9g}"
    return one_line(str(value))


def table_line(cells: Iterable[str]) -> str:
    """A line of a table in Markdown.

    Args:
        cells: Markdown; names and other texts escaped.
    """
    return "| " + " | ".join(cells) + " |"
