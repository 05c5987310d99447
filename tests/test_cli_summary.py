"""summary.html and frames.csv of ``dvo run``, and ``dvo summary``."""

from __future__ import annotations

import json
import re
from html import escape
from pathlib import Path

import numpy as np
import pytest

from dvo.cli import main
from dvo.commands.page_tables import tables
from dvo.data.trajectory import read_tum, write_tum
from dvo.session.frame_table import read_frames
from dvo.session.results_reader import read_results
from tests.support.command_line import arguments, errors, summary
from tests.support.summary_page import data_of, floats


@pytest.fixture
def run(given, image_folder, tmp_path):
    """``run(truth=True, **options)`` tracks the folder and gives the results folder."""

    def go(truth: bool = True, **options) -> Path:
        given(**options)
        more = ["--groundtruth", str(image_folder.parent / "truth.txt")] if truth else []
        assert main(arguments(image_folder, tmp_path / "out", *more)) == 0
        return tmp_path / "out"

    return go


def test_the_page_of_a_run_with_ground_truth(run):
    out = run(lost=(7,), new_segment=(8,))
    data = data_of(out / "summary.html")
    (world,) = data["worlds"]
    assert (world["name"], world["unit"]) == ("ground truth", "m")
    assert [track["segment"] for track in world["tracks"]] == [0, 1]
    error = floats(data["frames"]["error"])
    assert np.isnan(error[7]) and np.nanmax(error) < 1e-5, "both segments know the answer, up to a Sim(3)"
    truth = floats(world["truth"]).reshape(-1, 3)
    for track in world["tracks"]:
        distances = np.linalg.norm(floats(track["poses"]).reshape(-1, 7)[:, None, :3] - truth, axis=2)
        assert distances.min(axis=1).max() < 1e-4
    assert len(floats(world["points"])) == 30
    text = (out / "summary.html").read_text()
    assert "19 of 20" in text and "black image" in text and "a new segment" in text and "ATE m" in text


def test_segments_without_ground_truth_have_worlds_of_their_own(run):
    data = data_of(run(truth=False, new_segment=(8,)) / "summary.html")
    assert [world["name"] for world in data["worlds"]] == ["segment 1", "segment 0"], "the longest first"
    assert [len(floats(world["points"])) for world in data["worlds"]] == [30, 0], "the map is of the longest"
    assert not np.isfinite(floats(data["frames"]["error"])).any()


def test_the_table_of_frames(run):
    rows = read_frames(run(lost=(7,)) / "frames.csv")
    assert [row.status for row in rows] == ["tracking"] * 7 + ["lost"] + ["tracking"] * 12
    assert rows[7].reason == "black image" and rows[0].true_position is not None


def test_summary_of_a_folder_is_the_page_of_the_run(run, capsys):
    out = run(lost=(7,), new_segment=(8,))
    before = data_of(out / "summary.html")
    (out / "summary.html").unlink()
    assert main(["summary", str(out)]) == 0
    assert "summary.html" in capsys.readouterr().out
    after = data_of(out / "summary.html")
    assert [after["states"], after["ribbons"]] == [before["states"], before["ribbons"]]
    assert len(before["images"]) == 20 and after["images"] == [], "the page had them"
    for key in ("time", "segment", "colour"):
        assert after["frames"][key] == before["frames"][key]
    old, new = before["worlds"][0], after["worlds"][0]
    np.testing.assert_allclose(floats(new["tracks"][0]["poses"]), floats(old["tracks"][0]["poses"]), atol=1e-5)
    assert (new["colors"], new["name"]) == (old["colors"], old["name"])


def test_a_page_that_is_written_anew_keeps_its_images(run, image_folder, tmp_path):
    out = run(truth=False)
    before = data_of(out / "summary.html")["images"]
    more = ["--groundtruth", str(image_folder.parent / "truth.txt"), "--out", str(tmp_path / "new.html")]
    assert main(["summary", str(out), *more]) == 0
    assert data_of(tmp_path / "new.html")["images"] == before and len(before) == 20


def test_summary_of_a_folder_of_an_older_version(run, tmp_path):
    """Without the table of frames: states and segments by trajectories and breaks."""
    out = run(truth=False, lost=(3, 7), new_segment=(8,))
    states = data_of(out / "summary.html")["states"]
    (out / "frames.csv").unlink()
    assert main(["summary", str(out), "--out", str(tmp_path / "page.html")]) == 0
    data = data_of(tmp_path / "page.html")
    assert [state[2:] for state in data["states"]] == [state[2:] for state in states]
    np.testing.assert_allclose([s[0] for s in data["states"]], [s[0] for s in states], atol=1e-6)


def test_summary_with_another_ground_truth(run, image_folder, tmp_path):
    out = run(truth=False)
    truth = read_tum(image_folder.parent / "truth.txt")
    truth.poses_wc[10:, 1] += 0.5
    write_tum(tmp_path / "other.txt", truth)
    assert main(["summary", str(out), "--groundtruth", str(tmp_path / "other.txt")]) == 0
    data = data_of(out / "summary.html")
    assert data["worlds"][0]["name"] == "ground truth"
    assert 0.02 < np.nanmax(floats(data["frames"]["error"])) < 0.6
    assert "ATE after Sim(3)" in (out / "summary.html").read_text()
    assert summary(out)["metrics"] is None, "the results stay"


def test_a_recording_in_a_map_that_had_no_calibration(run):
    """Times of the map are on another clock: they are told, and not drawn."""
    out = run(truth=False)
    facts = summary(out)
    loop = {"from": 0.5, "to": 0.1, "kind": "retrieval", "inliers": 0.8, "edges": 9, "joins_segments": True}
    facts["info"]["loops"] = [{**loop, "in_map": True}, {**loop, "to": 0.2, "in_map": False}]
    facts["segments"][0]["in_map"], facts["map"] = True, "office.dvo"
    facts["self_calibration"] = {"focal": 51.0, "deviation": 1.5, "source": "self-calibration"}
    (out / "run.json").write_text(json.dumps(facts))
    assert main(["summary", str(out)]) == 0
    data, text = data_of(out / "summary.html"), (out / "summary.html").read_text()
    assert [pair[1] - pair[0] for pair in data["loops"]] == [pytest.approx(-0.3)]
    assert len(floats(data["worlds"][0]["loops"])) <= 6
    assert "0.10 of the map" in text and '<td class="words">the map</td>' in text and "office.dvo" in text
    assert "51.0 ± 1.5 px (self-calibration)" in text
    assert read_results(out).result.segments[0].in_map


@pytest.mark.parametrize("broken", ["write_page", "write_frames"])
def test_a_page_that_cannot_be_drawn_costs_no_other_file(image_folder, tmp_path, given, monkeypatch, capsys, broken):
    def fail(*_):
        raise ValueError("a wrong number")

    given()
    monkeypatch.setattr(f"dvo.commands.summary.{broken}", fail)
    assert main(arguments(image_folder, tmp_path / "out")) == 2
    assert "ValueError: a wrong number" in capsys.readouterr().err
    facts = summary(tmp_path / "out")
    assert not facts["finished"] and facts["frames"]["tracked"] == 20 and (tmp_path / "out" / "map.ply").is_file()


def test_all_warnings_of_a_run_are_on_its_page(image_folder, tmp_path, given, monkeypatch, capsys):
    """Those of reading, of observers that end after the page was written, and of files that could not be."""
    (image_folder / "0007.png").write_bytes(b"no image")
    (tmp_path / "base.txt").write_text("1.5 0 0 0 0 0 1\n")
    given()
    more = ["--extrinsics", str(tmp_path / "base.txt")]
    assert main(arguments(image_folder, tmp_path / "out", *more)) == 0
    warnings, text = summary(tmp_path / "out")["warnings"], (tmp_path / "out" / "summary.html").read_text()
    assert ["0007.png" in warnings[0], "lever arm" in warnings[1], len(warnings)] == [True, True, 2]
    assert re.findall('<p class="notice">(.*?)</p>', text) == [escape(warning) for warning in warnings]

    def fail(*_, **__):
        raise ValueError("a wrong number")

    monkeypatch.setattr("dvo.commands.run.draw", fail)
    assert main(arguments(image_folder, tmp_path / "out", "--overwrite", *more)) == 2
    warnings, text = summary(tmp_path / "out")["warnings"], (tmp_path / "out" / "summary.html").read_text()
    assert "trajectory.png: ValueError: a wrong number" in warnings[1] and escape(warnings[1]) in text


def test_the_page_of_a_metric_run(run, image_folder, tmp_path):
    """Units and alignment are told as they are; another ground truth replaces the errors of each segment."""
    out = run(new_segment=(8,))
    facts = summary(out)
    old = [part["ate_rmse"] for part in facts["segments"]]
    known = [{"segment": number, "source": "depth", "deviation": None} for number in range(2)]
    facts["info"]["scale"] = {"source": "depth", "segments": known}
    (out / "run.json").write_text(json.dumps(facts))
    (out / "frames.csv").unlink()
    assert main(["summary", str(out)]) == 0
    assert [world["unit"] for world in data_of(out / "summary.html")["worlds"]] == ["m", "m"]
    truth = read_tum(image_folder.parent / "truth.txt")
    truth.poses_wc[:, :3] *= 2
    write_tum(tmp_path / "other.txt", truth)
    assert main(["summary", str(out), "--groundtruth", str(tmp_path / "other.txt")]) == 0
    text = (out / "summary.html").read_text()
    shown = re.search(r"<h2>Segments</h2>.*?</table>", text, re.DOTALL)[0]
    assert "ATE after SE(3)" in text and str(tmp_path / "other.txt") in text
    cells = [float(cell) for cell in re.findall(r"<td>([0-9.e-]+)</td>", shown)]
    assert max(old) < 1e-6 and max(cells[3::5][:2]) > 0.01, "a segment of half the size, in metres"


def test_a_run_without_a_pose(given, image_folder, tmp_path):
    given(lost=tuple(range(20)))
    assert main(arguments(image_folder, tmp_path / "out")) == 1
    assert [state[2:] for state in data_of(tmp_path / "out" / "summary.html")["states"]] == [
        ["lost", "black image", 20]
    ]
    assert main(["summary", str(tmp_path / "out")]) == 0


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("run.json", "[1]", "not the description of a run"),
        ("run.json", "{", "not JSON"),
        ("run.json", '{"breaks": 3}', "has no valid"),
        ("map.ply", "ply\n", "not a map of dvo"),
        ("frames.csv", "a,b\n", "not a table of frames"),
        ("trajectory.txt", "1 2\n", "trajectory.txt"),
    ],
)
def test_a_folder_with_a_spoilt_file(run, capsys, file, content, message):
    out = run()
    (out / file).write_text(content)
    assert main(["summary", str(out)]) == 2
    (line,) = errors(capsys.readouterr().err)
    assert message in line and file in line


def test_a_segment_outside_of_the_folder_is_not_read(run, capsys):
    out = run()
    facts = summary(out)
    facts["segments"][0]["file"] = "../clip/truth.txt"
    (out / "run.json").write_text(json.dumps(facts))
    assert main(["summary", str(out)]) == 2
    assert "unknown file" in capsys.readouterr().err


def test_no_results_folder_and_no_place_for_the_page(run, tmp_path, capsys):
    out = run()
    assert main(["summary", str(tmp_path / "none")]) == 2
    assert main(["summary", str(tmp_path)]) == 2
    assert main(["summary", str(out), "--out", str(tmp_path / "no" / "page.html")]) == 2
    first, second, third = errors(capsys.readouterr().err)
    assert "not a results folder" in first and "run.json" in second and "cannot be written" in third


def test_a_setting_without_a_value_has_a_dash():
    settings = {"selection": "", "scale": {"distances": [], "tilt": 30}, "patches": 24}
    text = tables({"config": settings}, 0.0)
    assert "<td>–</td>" in text and "distances –, tilt 30" in text and "<td>24</td>" in text
