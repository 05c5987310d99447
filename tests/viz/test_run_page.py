"""The page of a run: it stands alone, holds what it should, and is small."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from dvo.data.trajectory import Trajectory
from dvo.session.frame_table import STATUSES, FrameRow
from dvo.viz.run_page import (
    ASSETS,
    MAX_FRAMES,
    MAX_POINTS,
    RunPage,
    TrackLine,
    World,
    encode,
    page_data,
    read_images,
    view_basis,
    write_page,
)


def walk(count: int, step: float = 0.1) -> Trajectory:
    times = 50 + step * np.arange(count)
    poses = np.zeros((count, 7))
    poses[:, 0], poses[:, 2], poses[:, 6] = np.sin(0.1 * times), 0.3 * np.cos(0.1 * times), 1
    return Trajectory(times, poses)


def rows_of(trajectory: Trajectory, **options) -> list[FrameRow]:
    return [FrameRow(float(t), "tracking", 0, seconds=0.02, **options) for t in trajectory.timestamps]


def page(trajectory: Trajectory, **options) -> RunPage:
    content = {
        "title": "clip", "subtitle": "", "notices": (), "facts": (), "tables": "", "rows": rows_of(trajectory),
        "worlds": [World("w", (TrackLine(trajectory, 0),))], "errors": np.full(len(trajectory), np.nan), "loops": (),
    }  # fmt: skip
    return RunPage(**{**content, **options})


def floats(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4")


class Tags(HTMLParser):
    """Checks that elements are closed, and collects attributes."""

    EMPTY = {"meta", "input", "br", "!doctype"}

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []

    def handle_starttag(self, tag, attributes):
        self.attributes += [(tag, name, value) for name, value in attributes]
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_needs_nothing_else(tmp_path):
    write_page(tmp_path / "summary.html", page(walk(30)))
    text = (tmp_path / "summary.html").read_text(encoding="utf-8")
    tags = Tags()
    tags.feed(text)
    assert not tags.open
    assert not [found for found in tags.attributes if found[1] in ("src", "href")]
    assert set(re.findall(r"https?://[^\s\"')]+", text)) <= {"http://www.w3.org/2000/svg"}  # a name, never fetched
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest|import\(", text)
    assert "$" not in re.sub(r"\$\{|`", "", text.split("<script", 1)[0]), "every marker of the template is filled"


def test_texts_of_the_user_are_no_markup(tmp_path):
    bad = "</script><script>alert(1)</script><b>&"
    lost = [FrameRow(50.0, "lost", reason=bad)]
    write_page(
        tmp_path / "p.html", page(walk(1), title=bad, subtitle=bad, notices=[bad], facts=[(bad, bad)], rows=lost)
    )
    text = (tmp_path / "p.html").read_text(encoding="utf-8")
    assert "alert(1)</script>" not in text and text.count("</script>") == 2
    data = json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])
    assert data["states"][0][3] == bad


def test_texts_of_the_user_do_not_steer_a_terminal(tmp_path):
    """A page that is printed, or opened by an editor."""
    strange = "\x1b[2J\x9b\u202e\u200b"
    found = replace(
        page(walk(5)), title=strange, subtitle=strange, notices=(strange,), facts=((strange, strange),),
        tables=f"<p>{strange}</p>", verdict=("good", strange),
    )  # fmt: skip
    write_page(tmp_path / "p.html", found)
    text = (tmp_path / "p.html").read_text(encoding="utf-8")
    assert not set("\x1b\x9b\u202e\u200b") & set(text) and text.count(r"\x1b[2J\x9b\u202e\u200b") >= 7


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node to check the scripts")
def test_the_scripts_are_valid(tmp_path):
    write_page(tmp_path / "p.html", page(walk(3)))
    script = re.findall(r"<script>(.*?)</script>", (tmp_path / "p.html").read_text(encoding="utf-8"), re.DOTALL)[0]
    (tmp_path / "page.js").write_text(script)
    done = subprocess.run(["node", "--check", str(tmp_path / "page.js")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_scripts_use_colours_that_the_style_defines_for_both_themes():
    style = (ASSETS / "page.css").read_text(encoding="utf-8")
    light, dark = (set(re.findall(r"--(\w+):", part)) for part in style.split("@media", 2)[:2])
    assert light == dark
    used = set(
        re.findall(r"var\(--(\w+)\)", style + "".join(p.read_text(encoding="utf-8") for p in ASSETS.glob("*.js")))
    )
    assert used <= light and set(STATUSES) <= light


def test_data_of_a_short_run():
    trajectory = walk(20)
    rows = rows_of(trajectory)
    rows[5:8] = [FrameRow(row.timestamp, "lost", reason="black image") for row in rows[5:8]]
    rows[3] = FrameRow(rows[3].timestamp, "tracking", 0, keyframe=True)
    data = page_data(page(trajectory, rows=rows, loops=[(51.0, 50.5)]))
    assert [(state[2], state[3], state[4]) for state in data["states"]] == [
        ("tracking", "", 5), ("lost", "black image", 3), ("tracking", "", 12),
    ]  # fmt: skip
    assert data["states"][1][:2] == [pytest.approx(0.5), pytest.approx(0.8)]
    assert [ribbon[:3] for ribbon in data["ribbons"]] == [
        [0.0, pytest.approx(0.4), 0], [pytest.approx(0.8), pytest.approx(1.9), 0],
    ]  # fmt: skip
    assert data["loops"] == [[pytest.approx(1.0), pytest.approx(0.5)]]
    np.testing.assert_allclose(floats(data["keyframes"]), [0.3], atol=1e-6)
    world = data["worlds"][0]
    poses = floats(world["tracks"][0]["poses"]).reshape(-1, 7)
    np.testing.assert_allclose(poses, trajectory.poses_wc, atol=1e-6)
    np.testing.assert_allclose(floats(world["keyframes"]), trajectory.positions[3], atol=1e-6)


@pytest.mark.long
def test_a_long_run_stays_small_and_keeps_peaks(tmp_path):
    trajectory = walk(50_000)
    errors = np.zeros(50_000)
    errors[31_234] = 7.0
    generator = np.random.default_rng(0)
    points, colors = generator.normal(size=(200_000, 3)), generator.integers(0, 255, (200_000, 3), dtype=np.uint8)
    worlds = [World("w", (TrackLine(trajectory, 0),), True, trajectory.positions, points, colors)]
    content = page(trajectory, errors=errors, worlds=worlds, rows=rows_of(trajectory, keyframe=True))
    data = page_data(content)
    assert len(floats(data["frames"]["time"])) <= MAX_FRAMES and floats(data["frames"]["error"]).max() == 7
    assert len(floats(data["worlds"][0]["points"])) <= 3 * MAX_POINTS
    poses = floats(data["worlds"][0]["tracks"][0]["poses"]).reshape(-1, 7)
    assert len(poses) <= MAX_FRAMES + 1
    np.testing.assert_allclose(poses[-1], trajectory.poses_wc[-1], atol=1e-6)
    write_page(tmp_path / "p.html", content)
    assert (tmp_path / "p.html").stat().st_size < 500_000, "images, of at most MAX_BYTES, aside"


IMAGES = [(50.0 + k, b"\xff\xd8" + bytes([k])) for k in range(4)]


def test_the_images_of_a_page_are_read_back(tmp_path):
    file = tmp_path / "p.html"
    write_page(file, page(walk(30), images=IMAGES))
    found = read_images(file)
    assert [jpeg for _, jpeg in found] == [jpeg for _, jpeg in IMAGES]
    np.testing.assert_allclose([time for time, _ in found], [time for time, _ in IMAGES], atol=1e-6)
    write_page(file, page(walk(30)))
    assert read_images(file) == [] and read_images(tmp_path / "none.html") == []


@pytest.mark.parametrize("images", ['[["a", "b"]]', "[[1, 2, 3]]", '[[0, "%%"]]', "7", '[[0, "aGVsbG8="]]', "null"])
def test_images_of_another_file_are_none(images, tmp_path):
    text = f'<script type="application/json" id="data">{{"start": 1.0, "images": {images}}}</script>'
    (tmp_path / "p.html").write_text(text)
    assert read_images(tmp_path / "p.html") == []


def test_the_verdict_stands_before_the_figures(tmp_path):
    write_page(tmp_path / "p.html", page(walk(3), verdict=("doubtful", "waves & wind."), facts=[("frames / s", "3")]))
    text = (tmp_path / "p.html").read_text(encoding="utf-8")
    place = text.index('<p class="verdict doubtful"><strong>verdict: doubtful</strong> waves &amp; wind.</p>')
    assert text.index("<h1>") < place < text.index("frames / s")
    write_page(tmp_path / "p.html", page(walk(3)))
    assert '<p class="verdict' not in (tmp_path / "p.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("reach", [0.0, 0.05, 3.0])
def test_the_view_holds_the_path_and_the_nearer_half_of_the_map(reach):
    trajectory = walk(60)
    trajectory.poses_wc[:, :3] *= reach
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)) + [0, 0, 4.0]
    world = World("w", (TrackLine(trajectory, 0),), points=points, colors=np.zeros((200, 3), np.uint8))
    found = page_data(page(trajectory, worlds=[world]))["worlds"][0]
    inside = np.linalg.norm(points - found["centre"], axis=1) <= found["radius"] * 1.0001
    assert inside.sum() >= 100 and found["radius"] < 8
    assert (np.linalg.norm(trajectory.positions - found["centre"], axis=1) <= found["radius"] * 1.0001).all()


def test_a_gap_is_not_bridged():
    whole = walk(300)
    kept = np.r_[0:100, 150:300]
    data = page_data(page(Trajectory(whole.timestamps[kept], whole.poses_wc[kept])))
    assert data["worlds"][0]["tracks"][0]["starts"] == [100]
    truth = whole.positions.copy()
    truth[[0, 40, 41]] = np.nan
    data = page_data(page(whole, worlds=[World("w", (TrackLine(whole, 0),), truth=truth)]))
    assert data["worlds"][0]["truthStarts"] == [39]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_any_length(tmp_path, count):
    write_page(tmp_path / "p.html", page(walk(count), worlds=[World("w", (TrackLine(walk(count), 0),))]))
    write_page(tmp_path / "q.html", page(walk(0), worlds=[World("w", ())]))
    assert (tmp_path / "q.html").stat().st_size > 1000


def test_far_points_are_left_out():
    points = np.concatenate([np.random.default_rng(0).normal(size=(100, 3)), [[1e6, 0, 0], [np.nan, 0, 0]]])
    world = World("w", (TrackLine(walk(50), 0),), points=points, colors=np.zeros((102, 3), np.uint8))
    data = page_data(page(walk(50), worlds=[world]))
    assert len(floats(data["worlds"][0]["points"])) == 300


def test_up_is_where_the_images_are_up():
    """A camera of a world with z up: x right, y down, z forward in the images."""
    trajectory = walk(40)
    poses = trajectory.poses_wc.copy()
    poses[:, 3:] = [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # the image's y points to -z
    poses[:, :3] = np.linspace(0, 1, 40)[:, None] * [0.1, 3, 0.2]
    basis = view_basis([TrackLine(Trajectory(trajectory.timestamps, poses), 0)], poses[:, :3] - poses[:, :3].mean(0))
    np.testing.assert_allclose(basis[2], [0, 0, 1], atol=1e-9)
    assert abs(basis[0] @ [0, 1, 0]) > 0.99, "the path is widest from left to right"
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(basis) == pytest.approx(1)


def test_encode_is_little_endian():
    assert base64.b64decode(encode(np.array([1.0]))) == b"\x00\x00\x80\x3f"
    assert base64.b64decode(encode(np.array([[1, 255]], np.uint8))) == b"\x01\xff"


def test_the_assets_are_in_the_package():
    assert {path.name for path in Path(ASSETS).iterdir()} == {
        "page.html",
        "page.css",
        "view.js",
        "charts.js",
        "page.js",
    }
