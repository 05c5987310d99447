"""Verdicts on our systems: axes on which each wins and loses, in words, from the same cells as the table."""

from __future__ import annotations

import math
from dataclasses import dataclass

from eval.execution.plan import Manifest
from eval.scoring.score import Row
from eval.scoring.summary import NULL, VOID, axes_of, axis_cells

LEVEL = 1.1  # medians within ten percent of each other count as level


@dataclass(frozen=True)
class Verdict:
    """Sentences on one of our systems.

    Attributes:
        wins, level, losses, below_null: one line an axis.
        failed, runs: counts over everything.
    """

    system: str
    wins: tuple[str, ...]
    level: tuple[str, ...]
    losses: tuple[str, ...]
    below_null: tuple[str, ...]
    failed: int
    runs: int


def verdicts(manifest: Manifest, rows: list[Row]) -> list[Verdict]:
    """One for each system of ours (names beginning with ``dvo``) that ran.

    Args:
        manifest: of the evaluation.
        rows: of all its runs.
    """
    return [found for name in manifest.systems if name.startswith("dvo") and (found := _verdict(name, manifest, rows))]


def _verdict(name: str, manifest: Manifest, rows: list[Row]) -> Verdict | None:
    mine = [row for row in rows if row.system == name and row.status not in VOID]
    if not mine:
        return None
    wins, level, losses, below = [], [], [], []
    for axis in axes_of(manifest):
        cells = axis_cells(axis, manifest.systems, rows)
        ours = cells.pop(name)
        if not ours.runs:
            continue
        zero = cells[NULL].median if NULL in cells else math.nan
        rivals = {
            system: found.median
            for system, found in cells.items()
            if not system.startswith("dvo") and system != NULL and math.isfinite(found.median)
        }
        digits = axis.digits
        own = f"{ours.median:.{digits}f}" if math.isfinite(ours.median) else "fails"
        if not ours.median < zero and math.isfinite(zero):
            below.append(f"{axis.title}: {own} against {zero:.{digits}f}")
        if not rivals:
            if math.isfinite(ours.median):
                wins.append(f"{axis.title}: {own} {axis.unit}, no other system has a figure")
            continue
        rival = min(rivals, key=lambda system: rivals[system])
        there = rivals[rival]
        line = f"{axis.title}: {own} {axis.unit} against {there:.{digits}f} of {rival}"
        if not math.isfinite(ours.median) or ours.median > there * LEVEL:
            losses.append(line)
        elif ours.median * LEVEL < there:
            wins.append(line)
        else:
            level.append(line)
    failed = sum(row.failed for row in mine)
    return Verdict(name, tuple(wins), tuple(level), tuple(losses), tuple(below), failed, len(mine))
