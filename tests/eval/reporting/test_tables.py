"""Markdown tables."""

from __future__ import annotations

import html
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eval.execution.plan import read_manifest
from eval.reporting.loops import loop_table
from eval.reporting.tables import axis_table, escape, markdown
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


WILD = "a|b `c` *d* <b>e</b> [f](http://g) ![h](i) &amp; www.j.k\nl_m _n_ \\\\ #o ~~p~~ q@r.s"
ESCAPED = (
    r"a\|b \`c\` \*d\* &lt;b&gt;e&lt;/b&gt; \[f\](http://g) !\[h\](i) &amp;amp; www.j.k "
    r"l_m \_n\_ \\\\ \#o \~\~p\~\~ q\@r.s"
)


def cells(line):
    """Cells of a line, as Markdown divides it."""
    return [cell.strip() for cell in re.split(r"(?<!\\)(?:\\\\)*\|", line)[1:-1]]


@pytest.mark.long
@pytest.mark.parametrize("place", ["system", "sequence", "about", "suite", "label", "reason", "resolution", "machine"])
def test_names_are_shown_as_they_are(plan, rows, place):
    """Whatever a name holds, it is text: no cell, line, markup, HTML or link."""
    manifest, suite = read_manifest(plan.out), plan.suites[0]
    if place in ("system", "sequence", "reason", "resolution"):
        rows = [replace(row, **{place: WILD}) for row in rows if row.system in ("good", "bad")]
    if place == "suite":
        rows = [replace(row, suite=WILD) for row in rows]
    if place in ("sequence", "about"):
        sequence = replace(suite.sequences[0], **{"name" if place == "sequence" else "about": WILD})
        suite = replace(suite, sequences=(sequence,))
    elif place in ("suite", "label"):
        suite = replace(suite, **{"name" if place == "suite" else "label": WILD})
    elif place == "machine":
        manifest = replace(manifest, machine=WILD)
    table = markdown(manifest, suite, rows)
    assert ESCAPED in table and WILD not in table and "<b>" not in table and "](" not in table.replace("\\](", "")
    lines = [line for line in table.splitlines() if line.startswith("|")]
    assert len(lines) >= 3 and len({len(cells(line)) for line in lines}) == 1
    assert all(line == "" or line[0] in "|*-F" for line in table.splitlines())


def test_names_of_the_other_tables(plan, rows):
    known = read_manifest(plan.out)
    manifest = replace(known, systems=(WILD,), facts={WILD: known.facts["good"]})
    axes = axis_table(manifest, [replace(row, system=WILD) for row in rows])
    assert cells(axes.splitlines()[0])[2] == ESCAPED and len({len(cells(line)) for line in axes.splitlines()}) == 1
    seen = [replace(row, system=WILD, revisit_s=1.0, loops=1.0) for row in rows if row.system == "good"]
    assert f"| {ESCAPED} |" in loop_table(manifest, seen)


@given(st.text(st.sampled_from("ab1 |\\`*_[]()<>&#~!-+.:/@\n\r\t\u2028\x00"), max_size=12))
def test_escaped_text_has_no_markup(text):
    found = escape(text)
    assert found.splitlines() in ([], [found]) and not re.search(r"[<>]", found)
    assert not re.search(r"(?<!\\)[|`*\[\]]", found.replace("\\\\", ""))
    assert html.unescape(re.sub(r"\\([^\w\s]|_)", r"\1", found)) == "".join(
        letter if letter.isprintable() else " " for letter in " ".join(text.split())
    )
