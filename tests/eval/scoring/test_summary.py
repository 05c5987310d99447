"""Summary of runs: medians, ranges, failures, the best system."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eval.execution.plan import read_manifest
from eval.scoring.summary import (
    Cell,
    axes_of,
    axis_cell,
    axis_cells,
    best_of,
    error_cell,
    judged_cells,
    mark_best,
    quartiles,
    summarise,
)

pytest.importorskip("evo", reason="evo is in the extra 'eval'")
VALUES = st.lists(st.one_of(st.floats(0, 1e6), st.just(math.inf), st.just(math.nan)))


@given(VALUES)
def test_failures_count_and_values_without_a_meaning_do_not(values):
    found = summarise(values)
    known = sorted(value for value in values if not math.isnan(value))
    if not known:
        assert math.isnan(found.median) and found.text(2) == "–" and found.short(2) == "–"
        return
    assert found.low == known[0] and found.high == known[-1] and found.low <= found.median <= found.high
    assert found == summarise([*values, math.nan], runs=len(values))
    failed = sum(math.isinf(value) for value in known)
    assert math.isfinite(found.median) == (
        failed <= (len(known) - 1) / 2 if len(known) % 2 else 2 * failed < len(known)
    )
    assert (quartiles(values) is None) == (failed == len(known))


def test_texts():
    assert summarise([3.0]).text(2) == "3.00" and summarise([3.001, 3.002]).text(2) == "3.00"
    assert summarise([3.0, 1.0, 8.0]).text(1) == "3.0 [1.0–8.0]"
    assert summarise([3.0, 1.0, math.inf]).text(1) == "3.0 [1.0–∞]"
    assert summarise([1.0, math.inf, math.inf]).text(1) == "–"
    assert summarise([3.0, 1.0, math.inf]).span(0, " – ") == "1 – ∞"
    assert summarise([]).middle(1) == "–"


def test_best_of_a_line():
    line = {"a": summarise([1.001]), "b": summarise([1.004]), "c": summarise([math.inf]), "d": summarise([])}
    assert {name for name, cell in mark_best(line, 2).items() if cell.best} == {"a", "b"}
    assert {name for name, cell in mark_best(line).items() if cell.best} == {"a"}
    assert best_of({"c": line["c"], "d": line["d"]}) == set()


def test_tables_by_axis_and_by_sequence_agree(plan, rows):
    """One sequence, one axis: both tables show the same medians, and pick the same winner."""
    manifest = read_manifest(plan.out)
    (axis,) = axes_of(manifest)
    groups = {name: [row for row in rows if row.system == name] for name in manifest.systems}
    by_axis = axis_cells(axis, manifest.systems, rows)
    by_sequence = judged_cells(axis.sequences[0], groups)
    for name, found in by_axis.items():
        if not found.note:
            assert found == by_sequence[name] == replace(error_cell(groups[name], axis.judged_by), best=found.best)
    assert [name for name, found in by_axis.items() if found.best] == ["good"]


def test_cells(plan, rows):
    manifest = read_manifest(plan.out)
    (axis,) = axes_of(manifest)
    assert axis_cell(axis, "absent", rows).note == "unavailable" and axis_cell(axis, "nobody", rows).note == "not run"
    lossy = axis_cell(axis, "lossy", rows)
    assert (lossy.median, lossy.failed, lossy.runs) == (math.inf, 2, 2)
    null = next(row for row in rows if row.system == "null")
    values = [replace(null, ate_percent=value) for value in (1.0, 2.0, 30.0)]
    mixed = axis_cell(axis, "null", [*values, replace(null, status="timeout")])
    assert mixed == Cell(16.0, 1.0, math.inf, 1, 4)  # between the second and the third of four
    assert replace(mixed, best=True).short(1) == "**16.0** (1/4 failed)"
    missing = axis_cell(axis, "null", [*values, replace(null, status="no data")])
    assert (missing.median, missing.runs, missing.failed) == (2.0, 3, 0)  # says nothing about the system
    pair = {"a": Cell(1.001, 1, 1, 0, 1), "b": Cell(1.004, 1, 1, 0, 1), "c": Cell(math.inf, 1, 1, 1, 1)}
    assert best_of(pair, 2) == {"a", "b"} and best_of(pair, 3) == {"a"}
