"""Tables of the benchmark of loops."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from eval.benchmarks.loops.runs import Run

DASH = "–"


def revisit_table(runs: Sequence[Run]) -> str:
    """Scenes with and without loop closure, in Markdown.

    Args:
        runs: of the mode ``revisit``.

    Returns:
        The table; its last line has medians (errors, times, memory), sums (loops) and the recall of all revisits.
    """
    lines = [
        "| scene | frames | ATE % without | with | loops | false | revisits s | recall % | p95 ms without | with | "
        "archive kB a keyframe without | with | resident kB a keyframe without | with |",
        "|---|" + "--:|" * 13,
    ]
    pairs = _pairs(runs, lambda run: run.loops)
    for name, (without, closed) in pairs.items():
        lines.append(_revisit_line(name, without, closed))
    both = [(without, closed) for without, closed in pairs.values() if without and closed]
    if len(both) > 1:
        rows = [list(side) for side in zip(*both, strict=True)]
        found = sum(run.recall * run.revisit_s for run in rows[1] if run.revisit_s > 0)
        seconds = sum(run.revisit_s for run in rows[1])
        cells = [
            f"**{len(both)} scenes**", "", *(_number(_median(side, "ate_percent"), 2) for side in rows),
            *(_number(sum(getattr(run, part) for run in rows[1]), 0) for part in ("found", "false", "revisit_s")),
            _number(100 * found / seconds if seconds else math.nan, 0),
            *(_number(_median(side, "p95_ms"), 0) for side in rows),
            *(_number(_median(side, part), 1) for part in ("archive_kb", "resident_kb") for side in rows),
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _revisit_line(name: str, without: Run | None, closed: Run | None) -> str:
    some = closed or without
    assert some is not None
    cells = [
        name, str(some.frames), _error(without), _error(closed),
        *(_cell(closed, part, 0) for part in ("found", "false", "revisit_s")),
        _number(100 * closed.recall if closed else math.nan, 0),
        *(_cell(run, "p95_ms", 0) for run in (without, closed)),
        *(_cell(run, part, 1) for part in ("archive_kb", "resident_kb") for run in (without, closed)),
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def blackout_table(runs: Sequence[Run]) -> str:
    """Sequences that go dark and look back, and the same without darkness, in Markdown.

    Args:
        runs: of the mode ``blackout``.

    Returns:
        The table, and a line with the share that was joined and the median ratio of the errors, in which a sequence
        that was not joined counts as infinite.
    """
    lines = ["| sequence | joined | loops | false | ATE m dark | bright | ratio |", "|---|---|" + "--:|" * 5]
    ratios, joined, false = [], 0, 0.0
    for name, (bright, dark) in _pairs(runs, lambda run: run.dark).items():
        ratio = math.nan
        if bright and dark:
            ratio = dark.joined_ate / max(bright.joined_ate, 1e-9) if dark.joined else math.inf
            ratios.append(ratio)
            joined, false = joined + dark.joined, false + np.nan_to_num(dark.false)
        cells = [
            name, DASH if dark is None else "yes" if dark.joined else "no", _cell(dark, "found", 0),
            _cell(dark, "false", 0), _number(dark.joined_ate if dark and dark.joined else math.nan, 4),
            _cell(bright, "joined_ate", 4), _number(ratio, 2),
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    known = [ratio for ratio in ratios if not math.isnan(ratio)]
    median = f"{np.median(known):.2f}" if known and math.isfinite(np.median(known)) else DASH
    lines.append(f"\njoined {joined} of {len(ratios)}, {false:.0f} false loops, median ratio of the ATE {median}")
    return "\n".join(lines)


def _pairs(runs: Iterable[Run], second: Callable[[Run], bool]) -> dict[str, tuple[Run | None, Run | None]]:
    """Both runs of every sequence (and system and seed, where there are several), in the order of the runs."""
    runs = list(runs)
    several = len({(run.system, run.seed) for run in runs}) > 1
    found: dict[str, tuple[Run | None, Run | None]] = {}
    for run in runs:
        name = f"{run.sequence}, {run.system}, seed {run.seed}" if several else run.sequence
        one, two = found.get(name, (None, None))
        found[name] = (one, run) if second(run) else (run, two)
    return found


def _error(run: Run | None) -> str:
    if run is None:
        return DASH
    return _number(run.ate_percent, 2) if run.status == "ok" else run.status


def _cell(run: Run | None, part: str, digits: int) -> str:
    return DASH if run is None else _number(float(getattr(run, part)), digits)


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else DASH


def _median(runs: Iterable[Run], part: str) -> float:
    """Median over runs, failed ones infinite where it is an error."""
    values = [math.inf if part == "ate_percent" and run.status != "ok" else float(getattr(run, part)) for run in runs]
    known = [value for value in values if not math.isnan(value)]
    return float(np.median(known)) if known else math.nan
