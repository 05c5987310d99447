"""Markdown tables."""

from __future__ import annotations

from dataclasses import replace

import pytest

from eval.execution.plan import read_manifest
from eval.reporting.tables import axis_table, markdown
from eval.scoring.score import Row

pytest.importorskip("evo", reason="evo is in the extra 'eval'")


def test_tables(plan, rows):
    manifest = read_manifest(plan.out)
    table = markdown(manifest, plan.suites[0], rows)
    assert "**made for a test**" in table and "Alignment sim3; stride 1; seeds 0, 1" in table
    lines = [line for line in table.splitlines() if line.startswith("|")]
    assert len(lines) == 2 + 5 and len({line.count("|") for line in lines}) == 1
    assert [line.split("|")[3].strip() for line in lines[2:]] == ["0/2", "2/2", "2/2", "2/2", "0/2"]
    good, lossy = lines[2], lines[3]
    assert "**0.00**" in good and "| – |" in lossy and table.count("**") == 4
    assert table.count("- bad, clip, seed") == 2
    axes = axis_table(manifest, rows).splitlines()
    assert axes[0] == "| axis | median | good | lossy | bad | absent | null |"
    assert axes[2].startswith("| tiny | ATE % | **0.00** | – (2/2 failed) | – (2/2 failed) | unavailable | ")


def test_median_and_range_over_seeds(plan, rows):
    manifest, suite = read_manifest(plan.out), plan.suites[0]
    row = next(row for row in rows if row.system == "null")
    three = [replace(row, seed=seed, ate_percent=value) for seed, value in enumerate((3.0, 1.0, 8.0))]
    assert "**3.00 [1.00–8.00]**" in markdown(manifest, suite, three)
    one_lost = [*three[:2], replace(three[2], status="crashed")]
    assert "3.00 [1.00–∞]" in markdown(manifest, suite, one_lost)
    two_lost = [replace(r, status="crashed") if r.seed else r for r in three]
    assert "3.00" not in markdown(manifest, suite, two_lost)


def test_judged_by_rotation(plan, rows):
    null, good = (next(row for row in rows if row.system == name) for name in ("null", "good"))
    sequence = replace(plan.suites[0].sequences[0], judged_by="rpe_rot_deg")
    turned = replace(plan.suites[0], sequences=(sequence,))
    manifest = replace(read_manifest(plan.out), suites=(turned,))
    two: list[Row] = [replace(null, rpe_rot_deg=0.25), replace(good, rpe_rot_deg=0.75)]
    assert "**0.250**" in markdown(manifest, turned, two) and "by RPE °" in markdown(manifest, turned, two)
    assert "| tiny | RPE ° | 0.750 |" in axis_table(manifest, two)
