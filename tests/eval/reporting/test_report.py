"""The page, the figures and the verdicts, on an evaluation in which most systems fail in some way."""

from __future__ import annotations

import base64
import csv
import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Segment
from eval.__main__ import main
from eval.execution.plan import read_manifest
from eval.reporting.plots import OURS, RING, plot_axis, plot_sequence, plot_speed, styles, with_breaks
from eval.reporting.report import overall, shade, write_report, write_tables
from eval.reporting.tables import markdown
from eval.reporting.verdict import verdicts
from eval.scoring.summary import Cell
from eval.suites.suite import Suite

pytest.importorskip("evo", reason="evo is in the extra 'eval'")
CUTS = ((0, 80, 1.0), (90, 195, 3.0), (195, 200, 2.0))  # rows and scale of three segments
VOID_TAGS = {"meta", "img", "br", "link"}


def segments(*trajectories: Trajectory) -> list[Segment]:
    """A segment of each that has rows."""
    return [Segment(t, float(t.timestamps[0]), float(t.timestamps[-1])) for t in trajectories if len(t)]


class Outline(HTMLParser):
    """Checks that tags nest, and keeps what the tests look at."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if tag not in VOID_TAGS:
            self.open.append(tag)
        if given.get("id"):
            self.ids.append(given["id"])
        if tag == "a":
            self.links.append(given["href"])
        if tag == "img":
            self.images.append(given)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture
def page(plan, rows) -> str:
    manifest = read_manifest(plan.out)
    write_tables(plan.out, manifest, rows)
    return write_report(plan.out, manifest, rows).read_text(encoding="utf-8")


@pytest.mark.long
def test_page_is_whole_needs_nothing_else_and_shows_every_system(plan, page, tmp_path, capsys):
    outline = Outline()
    outline.feed(page)
    assert not outline.open
    assert {"axes", "spread", "speed", "systems", "failures", "sequences", "meaning", "tiny-clip"} <= set(outline.ids)
    assert all(link.lstrip("#") in outline.ids for link in outline.links)
    assert len(outline.images) == 3
    for image in outline.images:
        kind, _, content = image["src"].partition(";base64,")
        assert kind == "data:image/svg+xml" and image["alt"]
        ElementTree.fromstring(base64.b64decode(content))
    assert "<script" not in page and not re.search(r'(src|href)="(?!data:|#)', page) and "url(" not in page
    text = " ".join(" ".join(outline.text).split())
    for name in ("good", "lossy", "bad", "absent", "null"):
        assert text.count(name) >= 3, name
    assert "10 runs, 4 of them failed, 2 could not be made" in text and "2 of 2 failed" in text
    assert text.count("RuntimeError: boom | with a bar and two lines") == 2
    assert "8 of 20 frames have a pose" in text and "needs a thing" in text
    assert "null is the zero line" in text and "alignment" in text and "made for a test" in text

    # It is made again from the folder alone: neither images nor ground truth are looked for, and it may be moved.
    (tmp_path / "clip").rename(tmp_path / "gone")
    moved = plan.out.rename(tmp_path / "moved")
    assert main(["report", str(moved)]) == 0
    assert (moved / "report.html").read_text(encoding="utf-8") == page
    with open(moved / "results.csv", newline="") as file:
        written = list(csv.DictReader(file))
    assert len(written) == 10 and float(written[0]["completeness"]) == 0.9
    crashed = next(row for row in written if row["system"] == "bad")
    assert crashed["ate_rmse"] == "" and crashed["reason"] == "RuntimeError: boom | with a bar and two lines"
    assert capsys.readouterr().out.startswith("**made for a test**")


def test_shades_against_null():
    shades = [shade(Cell(value, 0, 0, 0, 1), 10.0) for value in (0.5, 2.0, 4.0, 8.0, 10.0, math.inf)]
    assert shades == ["good3", "good2", "good1", "plain", "bad", "lost"]
    assert shade(Cell(1.0, 0, 0, 0, 1), math.nan) == "plain"


def test_verdict_tells_losses_and_wins(plan, rows):
    manifest = read_manifest(plan.out)
    null = next(row for row in rows if row.system == "null")

    def told(ours: float, theirs: float, status: str = "ok"):
        systems = {"dvo-x": (ours, status), "keyframe": (theirs, "ok"), "null": (5.0, "ok")}
        made = [replace(null, system=name, ate_percent=v, status=s) for name, (v, s) in systems.items()]
        (found,) = verdicts(replace(manifest, systems=tuple(systems)), made)
        return found

    assert told(1.0, 2.0).wins == ("tiny: 1.00 ATE % against 2.00 of keyframe",) and not told(1.0, 2.0).losses
    assert told(3.0, 2.0).losses == ("tiny: 3.00 ATE % against 2.00 of keyframe",) and not told(3.0, 2.0).below_null
    assert told(2.1, 2.0).level and not told(2.1, 2.0).wins
    assert told(6.0, 2.0).below_null == ("tiny: 6.00 against 5.00",)
    crashed = told(1.0, 2.0, "crashed")
    assert crashed.losses == ("tiny: fails ATE % against 2.00 of keyframe",) and crashed.failed == 1
    assert verdicts(manifest, rows) == []  # none of ours was asked


def test_areas_count_failures_as_nothing(rows):
    null = next(row for row in rows if row.system == "null")
    made = [replace(null, auc=0.8), replace(null, auc=0.0, status="crashed")]
    assert overall("null", made)[3] == "0.40"


def test_styles_are_told_apart_without_colour():
    names = ["dvo-small", "dvo-full", "keyframe", "direct", "monoslam", "klt-pnp", "orbslam3", "svo", "colmap", "null"]
    found = styles([*names, "own"])
    assert found["dvo-small"].color == OURS == found["dvo-full"].color
    assert found["dvo-small"].line != found["dvo-full"].line
    assert len({(style.color, str(style.line)) for style in found.values()}) == len(names) + 1
    assert len({style.color for name, style in found.items() if not name.startswith("dvo")}) == len(names) - 1


@pytest.mark.long
def test_figures_survive_what_runs_leave_behind():
    """No poses, one pose, all failed, far off, dark stretches."""
    s = np.linspace(0, 5, 900)
    truth = Trajectory(s, np.column_stack([np.cos(s), 0 * s, s, 0 * s, 0 * s, 0 * s, 1 + 0 * s]))
    far = Trajectory(s, truth.poses_wc * [1e6, 1, 1e6, 1, 1, 1, 1])
    none = Trajectory(np.zeros(0), np.zeros((0, 7)))
    one = Trajectory(s[:1], truth.poses_wc[:1])
    for judge in ("ate_percent", "rpe_rot_deg"):
        tracks = {
            name: segments(track) for name, track in (("dvo-x", truth), ("far", far), ("none", none), ("one", one))
        }
        svg = plot_sequence(Suite("s", "l", ()), judge, truth, tracks, [[1.0, 2.0]])
        ElementTree.fromstring(svg)
        assert "none: no trajectory" in svg and len(svg) < 120_000
    assert plot_speed({"a": [(3.0, 1.0)]}, "%") == plot_speed({"a": [(3.0, 1.0)]}, "%")  # the same bytes
    assert "2 failed" in plot_axis("t", "u", {"a": [1.0, 2.0, math.inf, math.inf], "b": [math.inf], "c": []}, 3.0)
    ElementTree.fromstring(plot_axis("t", "u", {"a": [math.inf]}, math.nan))
    assert "1 of 2 without a figure" in plot_speed({"a": [(3.0, 1.0), (3.0, math.inf)]}, "ATE %")


def test_axes_keep_their_digits_and_coordinates_lose_theirs():
    s, zero = np.linspace(0, 1, 50), np.zeros(50)
    truth = Trajectory(s, np.column_stack([0.001 * s, zero, 0.004 * s, zero, zero, zero, zero + 1]))
    drawn = plot_sequence(Suite("s", "l", ()), "ate_percent", truth, {"dvo-x": segments(truth)})
    numbers = [float(word) for word in re.findall(r">([0-9.]+)</", drawn)]
    assert {0.001, 0.002, 0.003} & set(numbers), f"ticks of 4 mm: {numbers}"
    assert not re.search(r" (?:d|x|y)=\"[^\"]*\d\.\d{3}", drawn)


@pytest.mark.long
def test_segments_are_told_apart_in_the_figure():
    """Each in its own world and scale; drawn on the truth, a ring at the start of the second, tiny ones left out."""
    s = np.linspace(0, 5, 200)
    truth = Trajectory(s, np.column_stack([np.cos(s), 0.1 * np.sin(3 * s), s, 0 * s, 0 * s, 0 * s, 1 + 0 * s]))
    parts = [Trajectory(s[a:b], truth.poses_wc[a:b] * [k, k, k, 1, 1, 1, 1]) for a, b, k in CUTS]
    one, two = ({"dvo-x": segments(*tracks)} for tracks in ([truth], parts))
    alone, cut = (plot_sequence(Suite("s", "l", ()), "ate_percent", truth, tracks) for tracks in (one, two))
    assert "dvo-x (3 segments, 1 too short)" in cut and "segments" not in alone
    ring = re.compile(rf"<use [^>]*stroke: {OURS}; stroke-width: {RING['mew']}")
    assert (len(ring.findall(alone)), len(ring.findall(cut))) == (0, 2)  # in the plan, and in the errors over time
    joined = [segments(parts[0])[0], replace(segments(parts[1])[0], joined_to=0)]
    assert not ring.search(plot_sequence(Suite("s", "l", ()), "ate_percent", truth, {"dvo-x": joined}))


def test_curves_break_where_there_are_no_frames():
    stamps = np.r_[0:10, 20:30] / 10
    curve = with_breaks(np.column_stack([stamps, stamps]))
    assert np.isnan(curve[:, 0]).tolist() == [row == 10 for row in range(21)]
    assert len(with_breaks(curve[:1])) == 1 and len(with_breaks(curve[:0])) == 0


def test_tables_and_page_tell_segments_and_false_poses(plan, rows, no_figures):
    manifest, suite = read_manifest(plan.out), plan.suites[0]
    plain = [replace(row, unseen=0, false_poses=math.nan) for row in rows]
    titles = markdown(manifest, suite, plain).splitlines()[2]
    assert "segments" not in titles and "false poses" not in titles
    good = [replace(r, segments=3, scored=0.8, unseen=4, false_poses=0.25) if r.system == "good" else r for r in plain]
    table = markdown(manifest, suite, good)
    titles, _, first = table.splitlines()[2:5]
    cells = dict(zip(titles.split("|"), first.split("|"), strict=True))
    assert [cells[f" {name} "].strip() for name in ("segments", "scored %", "false poses %")] == ["3", "80", "25"]
    assert "aligned on its own" in table and "False poses: share" in table
    page = write_report(plan.out, manifest, good).read_text(encoding="utf-8")
    for title in ("segments", "scored %", "false poses %"):
        assert page.count(f"<th>{title}</th>") == 2, title  # systems, and the sequence
    page = write_report(plan.out, manifest, plain).read_text(encoding="utf-8")
    assert "<th>segments</th>" not in page
    dark = [replace(row, blackouts=1, unseen=20, false_poses=0.0) for row in plain]
    page = write_report(plan.out, manifest, dark).read_text(encoding="utf-8")
    assert "<th>segments</th>" in page and "<th>false poses %</th>" in page  # always, where it goes dark
