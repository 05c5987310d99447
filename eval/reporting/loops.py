"""Table of loop closure: errors without and with it beside each other, and the loops against the rendered truth."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence

from eval.execution.plan import Manifest
from eval.reporting.tables import escape, table_line
from eval.scoring.loops import NEAR, OLDER, RIGHT
from eval.scoring.score import Row
from eval.scoring.summary import Cell, error_cell, summarise
from eval.suites.suite import Sequence as Recording

SETTING = "loops"
TITLES = (
    *("ATE % without", "ATE % with", "segments without", "segments with"),
    *("loops", "false loops", "revisits s", "recall %"),
)
NOTE = (
    f"Sequences that show a place again: a second is a revisit if its first frame shares {100 * RIGHT:g} % of the view "
    f"(by rendered depth and poses) with that of a second at least {OLDER:g} s older. Recall: revisits with a loop "
    f"within {NEAR:g} s, of the loops with more inliers than every false one. A false loop joins frames that have no "
    f"view in common. Of a system that does not tell of its loops only the errors are known. The setting `{SETTING}` "
    "of a system closes loops or leaves them open."
)


def loop_pairs(manifest: Manifest) -> list[tuple[str | None, str | None]]:
    """Systems that differ in loop closure alone: without it, with it; a system without a counterpart stands with it.

    Args:
        manifest: of the evaluation.

    Returns:
        Labels, None for one that did not run.
    """
    groups: dict[str, list[tuple[str, bool | None]]] = {}
    for label in manifest.systems:
        identity = manifest.facts[label].identity
        settings = dict(identity.get("settings", {}))
        value = settings.pop(SETTING, None)
        key = json.dumps([identity.get("target", label), settings], sort_keys=True, default=str)
        groups.setdefault(key, []).append((label, value))
    pairs: list[tuple[str | None, str | None]] = []
    for members in groups.values():
        closed = [label for label, value in members if value is True]
        left = [label for label, value in members if value is False]
        plain = [label for label, value in members if value is None]
        if not closed:  # what the default does is known by the other value
            closed, plain = plain[:1], plain[1:]
        if not left:
            left, plain = plain[:1], plain[1:]
        pairs.append((left[0] if left else None, closed[0] if closed else None))
    return pairs


def loop_lines(manifest: Manifest, rows: Sequence[Row]) -> list[list[str]]:
    """Lines of the table: sequence, system, and the texts of :data:`TITLES`.

    Args:
        manifest: of the evaluation.
        rows: of all its runs.

    Returns:
        A line for each sequence with revisits and each system that tells of loops in it, or that ran without and with
        closure; none without such.
    """
    lines = []
    for suite in manifest.suites:
        for sequence in suite.sequences:
            here = [row for row in rows if row.suite == suite.name and row.sequence == sequence.name]
            if any(row.revisit_s > 0 for row in here):
                lines += [
                    _line(sequence, pair, here)
                    for pair in loop_pairs(manifest)
                    if any(math.isfinite(row.loops) for row in here if row.system == pair[1])
                    or set(pair) <= {row.system for row in here}
                ]
    return lines


def loop_table(manifest: Manifest, rows: Sequence[Row]) -> str:
    """The table in Markdown; empty without a line.

    Args:
        manifest: of the evaluation.
        rows: of all its runs.
    """
    lines = loop_lines(manifest, rows)
    if not lines:
        return ""
    table = [["sequence", "system", *TITLES], ["---", "---", *["--:"] * len(TITLES)]]
    table += [[escape(sequence), escape(system), *cells] for sequence, system, *cells in lines]
    return NOTE + "\n\n" + "".join(f"{table_line(cells)}\n" for cells in table)


def _line(sequence: Recording, pair: tuple[str | None, str | None], here: Iterable[Row]) -> list[str]:
    here = list(here)
    without, closed = ([row for row in here if row.system == label] for label in pair)
    cells: list[Cell] = [error_cell(side, "ate_percent") for side in (without, closed)]
    texts = [cell.text(2) for cell in cells]
    texts += [_count(side, "segments").text(0) for side in (without, closed)]
    texts += [_count(closed, field).text(0) for field in ("loops", "false_loops", "revisit_s")]
    return [sequence.name, str(pair[1]), *texts, _count(closed, "loop_recall", 100.0).text(0)]


def _count(rows: Iterable[Row], field: str, factor: float = 1.0) -> Cell:
    return summarise([factor * float(getattr(row, field)) for row in rows if row.tracked])
