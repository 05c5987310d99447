"""Table of loop closure: systems that differ in it alone stand beside each other."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest

from eval.execution.plan import Manifest, Plan, read_manifest
from eval.reporting.loops import TITLES, loop_pairs, loop_table
from eval.reporting.report import write_report, write_tables
from eval.scoring.score import Row

pytest.importorskip("evo", reason="evo is in the extra 'eval'")

SETTINGS = {
    "dvo-small": {"weights": "small"},
    "dvo-small+loops=false": {"weights": "small", "loops": False},
    "dvo-small+patches=48": {"weights": "small", "patches": 48},
    "keyframe": {},
    "keyframe-loops": {"loops": True},
    "orbslam3": {},
    "orbslam3+loops=false": {"loops": False},
}


def with_systems(manifest: Manifest, names: list[str]) -> Manifest:
    facts = manifest.facts["null"]
    found = {
        name: replace(facts, label=name, identity={"target": re.split("[-+]", name)[0], "settings": SETTINGS[name]})
        for name in names
    }
    return replace(manifest, systems=tuple(names), facts=found)


def test_pairs_by_settings(plan: Plan, rows: list[Row]) -> None:
    manifest = read_manifest(plan.out)
    assert loop_pairs(with_systems(manifest, list(SETTINGS))) == [
        ("dvo-small+loops=false", "dvo-small"),
        (None, "dvo-small+patches=48"),
        ("keyframe", "keyframe-loops"),
        ("orbslam3+loops=false", "orbslam3"),
    ]
    assert loop_pairs(with_systems(manifest, ["dvo-small+loops=false"])) == [("dvo-small+loops=false", None)]


def test_table_of_sequences_with_revisits(plan: Plan, rows: list[Row]) -> None:
    manifest = with_systems(read_manifest(plan.out), list(SETTINGS))
    null = next(row for row in rows if row.system == "null")
    on = replace(null, system="dvo-small", ate_percent=1.5, loops=7.0, false_loops=0.0, revisit_s=34.0, loop_recall=0.6)
    off = replace(on, system="dvo-small+loops=false", ate_percent=6.0, loops=math.nan, loop_recall=math.nan)
    silent = replace(off, system="keyframe-loops")
    table = loop_table(manifest, [on, off, silent])
    line = table.splitlines()[-1]
    assert [cell.strip() for cell in line.split("|")[1:-1]] == [
        *("clip", "dvo-small", "6.00", "1.50", "1", "1", "7", "0", "34", "60")
    ]
    assert table.count("| clip |") == 1 and "keyframe" not in line  # it told of no loops
    assert loop_table(manifest, [replace(row, revisit_s=0.0) for row in (on, off)]) == ""
    two = loop_table(manifest, [on, off, replace(on, seed=1, ate_percent=2.5, loop_recall=0.8)])
    assert "2.00 [1.50–2.50]" in two and "70 [60–80]" in two


def test_system_that_does_not_tell_of_its_loops(plan: Plan, rows: list[Row]) -> None:
    """Its errors without and with closure stand in the table; with one of the two there is nothing to compare."""
    manifest = with_systems(read_manifest(plan.out), list(SETTINGS))
    null = next(row for row in rows if row.system == "null")
    on = replace(null, system="orbslam3", ate_percent=2.5, revisit_s=34.0)
    off = replace(on, system="orbslam3+loops=false", ate_percent=3.5)
    assert math.isnan(on.loops) and math.isnan(on.loop_recall)
    line = loop_table(manifest, [on, off]).splitlines()[-1]
    assert [cell.strip() for cell in line.split("|")[1:-1]] == [
        *("clip", "orbslam3", "3.50", "2.50", "1", "1", "–", "–", "34", "–")
    ]
    assert loop_table(manifest, [on]) == ""


def test_file_and_page(plan: Plan, rows: list[Row], no_figures: None) -> None:
    manifest = read_manifest(plan.out)
    write_tables(plan.out, manifest, rows)
    assert not (plan.out / "loops.md").exists()
    assert 'id="loops"' not in write_report(plan.out, manifest, rows).read_text(encoding="utf-8")
    found = [replace(row, revisit_s=30.0, loops=2.0) if row.system == "good" else row for row in rows]
    write_tables(plan.out, manifest, found)
    assert "| clip | good |" in (plan.out / "loops.md").read_text(encoding="utf-8")
    page = write_report(plan.out, manifest, found).read_text(encoding="utf-8")
    assert all(f"<th>{title}</th>" in page for title in TITLES)
    write_tables(plan.out, manifest, rows)
    assert not (plan.out / "loops.md").exists()
