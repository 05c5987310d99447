"""results.csv and the Markdown table: medians over seeds with their range, failed runs counted."""

from __future__ import annotations

import csv
import math
import os
import platform
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from eval.score import COLUMNS, Row
from eval.sequences import Suite

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
JUDGE_TITLES = {field: title for title, field, _ in FIGURES}


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    """Every run, one line each; an empty cell is a value without meaning."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            writer.writerow([_cell(value) for value in asdict(row).values()])


def markdown(suite: Suite, rows: list[Row], threads: int, device: str) -> str:
    """The table of a suite, protocol first.

    Every figure is the median over seeds, with minimum and maximum in brackets where they differ. A failed run counts
    as infinite in the median of an error, so a system that fails more often than not has no figure. The best value of
    the column that decides a sequence is bold.
    """
    systems = list(dict.fromkeys(row.system for row in rows))
    names = ["sequence", "system", "runs failed", *(title for title, _, _ in FIGURES), "complete %"]
    names += [title for title, _, _ in RESOURCES]
    lines = [protocol(suite, rows, threads, device), "", _line(names), _line(["---"] * 2 + ["--:"] * (len(names) - 2))]
    for sequence in suite.sequences:
        groups = {name: [r for r in rows if r.sequence == sequence.name and r.system == name] for name in systems}
        groups = {name: group for name, group in groups.items() if group}
        judged = {name: _median(_errors(group, sequence.judged_by)) for name, group in groups.items()}
        best = min(judged.values(), default=math.inf)
        for position, (name, group) in enumerate(groups.items()):
            cells = []
            for _, field, digits in FIGURES:
                text = _summary(_errors(group, field), digits)
                won = field == sequence.judged_by and math.isfinite(best) and judged[name] == best
                cells.append(f"**{text}**" if won else text)
            cells.append(_summary([100 * row.completeness for row in group], 0))
            cells += [_summary([getattr(row, field) for row in group], digits) for _, field, digits in RESOURCES]
            failed = sum(row.failed for row in group)
            title = f"{sequence.name} ({sequence.about})" if sequence.about else sequence.name
            lines.append(_line([title if position == 0 else "", name, f"{failed}/{len(group)}", *cells]))
    failures = [row for row in rows if row.failed]
    if failures:
        lines += ["", "Failed runs:", ""]
        lines += [
            f"- {r.system}, {r.sequence}, seed {r.seed}: {r.status}: {r.reason or 'no reason given'}" for r in failures
        ]
    return "\n".join(lines) + "\n"


def protocol(suite: Suite, rows: list[Row], threads: int, device: str) -> str:
    """What the figures stand for, in a few sentences."""
    seeds = sorted({row.seed for row in rows})
    sizes = {
        name: ", ".join(dict.fromkeys(r.resolution for r in rows if r.system == name and r.resolution))
        for name in dict.fromkeys(row.system for row in rows)
    }
    worked = "; ".join(f"{name}: {size}" for name, size in sizes.items() if size)
    turned = [sequence.name for sequence in suite.sequences if sequence.judged_by == "rpe_rot_deg"]
    judges = "by ATE in percent of the path" + (f", {', '.join(turned)} by RPE in degrees" if turned else "")
    sentences = [
        f"**{suite.label}** (suite `{suite.name}`).",
        f"Alignment {suite.alignment}; every {suite.stride}. image fed;"
        if suite.stride > 1
        else f"Alignment {suite.alignment}; stride 1;",
        f"seeds {', '.join(map(str, seeds))}: median [min–max]." if len(seeds) > 1 else f"seed {seeds[0]}.",
        f"RPE over {suite.rpe_gap} frames, median over the sequence; errors by evo.",
        f"Sequences are judged {judges} (bold: best).",
        f"A run fails if it crashes, takes over {suite.time_limit:g} s, leaves poses that are not finite or poses for "
        f"fewer than {100 * suite.lost_below:g} % of the frames; failed runs count as infinite errors.",
        f"Working resolution: {worked}." if worked else "",
        f"Speed without reading images, {threads} thread{'s' if threads != 1 else ''} on {device} ({_machine()}).",
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def _errors(group: list[Row], field: str) -> list[float]:
    return [math.inf if row.failed else getattr(row, field) for row in group]


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values and not np.isnan(values).any() else math.inf


def _summary(values: list[float], digits: int) -> str:
    known = [value for value in values if not math.isnan(value)]
    if not known or not math.isfinite(np.median(known)):
        return "–"
    figures = (float(function(known)) for function in (np.median, np.min, np.max))
    middle, low, high = (f"{value:.{digits}f}" if math.isfinite(value) else "∞" for value in figures)
    return middle if low == high else f"{middle} [{low}–{high}]"


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.9g}" if math.isfinite(value) else ""
    return " ".join(str(value).split())


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"


def _machine() -> str:
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                name = line.split(":", 1)[1].strip()
                break
    return f"{name}, {os.cpu_count()} cores"
