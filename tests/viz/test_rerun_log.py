"""Log of a run for Rerun. Those tests that read it back need the package (extra ``viz``)."""

from __future__ import annotations

import socket
import sys
import time

import numpy as np
import pytest

from dvo.cli import main
from dvo.commands.view_options import VIEWER
from dvo.viz.rerun_log import loop_lines
from tests.support.command_line import arguments, errors, names


@pytest.fixture
def rerun():
    """The package, or a skip."""
    return pytest.importorskip("rerun", reason="needs rerun-sdk (pip install 'dvo[viz]')")


@pytest.mark.parametrize(("option", "value"), [("--rerun", "a.rrd"), ("--rerun-connect", "127.0.0.1:9876")])
def test_without_the_package_the_remedy_is_named(option, value, given, image_folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    odometry = given()
    assert main(arguments(image_folder, tmp_path / "out", option, str(tmp_path / value))) == 2
    (line,) = errors(capsys.readouterr().err)
    assert f"error: {option}: the package rerun-sdk is not installed" in line and "pip install 'dvo[viz]'" in line
    assert not odometry.asked and not (tmp_path / "out").exists(), "before the weights load"


def test_a_source_after_the_option_is_no_file(given, image_folder, tmp_path, capsys):
    given()
    assert main(["run", "--rerun", str(image_folder), "--out", str(tmp_path / "out")]) == 2
    assert "put --rerun after SOURCE" in capsys.readouterr().err


def test_the_option_without_a_file_asks_for_the_viewer():
    from dvo.cli import build_parser

    parse = build_parser().parse_args
    assert parse(["run", "a", "--rerun"]).rerun == VIEWER and parse(["run", "a"]).rerun is None
    assert parse(["run", "a", "--rerun", "x.rrd"]).rerun == "x.rrd"


def entities(file) -> set[str]:
    """Entities of a recording."""
    RrdReader = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk with a reader of its files").RrdReader
    found: set[str] = set()
    for chunk in RrdReader(file).stream():
        found.add(str(chunk.entity_path))
    return found


def test_an_odometry_without_a_graph_logs_poses_and_images(rerun, given, image_folder, tmp_path):
    given(lost=(4, 5), new_segment=(12,))
    file = tmp_path / "clip.rrd"
    assert main(arguments(image_folder, tmp_path / "out", "--rerun", str(file))) == 0
    found = entities(file)
    assert {"/world/camera", "/world/camera/image", "/confidence", "/status", "/final/map"} <= found
    assert {"/world/trajectory/0/0", "/world/trajectory/1/0", "/final/trajectory/0"} <= found
    assert not {path for path in found if "edges" in path or "matches" in path}
    assert names(tmp_path / "out") == [
        "frames.csv", "map.ply", "run.json", "summary.html", "trajectory-0.txt", "trajectory-1.txt", "trajectory.png",
        "trajectory.txt",
    ]  # fmt: skip


def test_a_file_that_cannot_be_written(rerun, given, image_folder, tmp_path, capsys):
    odometry = given()
    below_a_file = str(image_folder.parent / "calib.txt" / "a.rrd")
    assert main(arguments(image_folder, tmp_path / "out", "--rerun", below_a_file)) == 2
    (line,) = errors(capsys.readouterr().err)
    assert "a.rrd" in line and "--rerun" in line and not odometry.asked


@pytest.fixture
def without_display(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("dvo.viz.rerun_log._answers", lambda host, port: False)


def test_without_a_display_the_run_is_written(rerun, without_display, given, image_folder, tmp_path, capsys):
    given()
    assert main(arguments(image_folder, tmp_path / "out", "--rerun")) == 0
    said = capsys.readouterr().err
    assert "no display" in said and "run.rrd" in said
    assert "run.rrd" in names(tmp_path / "out") and "/world/camera" in entities(tmp_path / "out" / "run.rrd")
    assert main(arguments(image_folder, tmp_path / "out", "--overwrite")) == 0
    assert "run.rrd" not in names(tmp_path / "out"), "it was of the run before"


def test_where_no_viewer_answers(rerun, given, image_folder, tmp_path, capsys):
    odometry = given()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        closed = f"127.0.0.1:{free.getsockname()[1]}"
    for address, said in ((closed, "no viewer answers"), ("http://a:1", "no address"), ("a:b:c", "no address")):
        assert main(arguments(image_folder, tmp_path / "out", "--rerun-connect", address)) == 2
        (line,) = errors(capsys.readouterr().err)
        assert said in line and "--rerun-connect" in line and not odometry.asked


def test_a_viewer_that_takes_nothing_does_not_hold_the_run(rerun, given, image_folder, tmp_path, capsys, monkeypatch):
    """It is connected, and reads nothing: rerun would wait for it without a limit."""
    given()
    monkeypatch.setattr("dvo.viz.rerun_log.VIEWER_LIMIT", 0.3)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen(5)
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        began = time.monotonic()
        assert main(arguments(image_folder, tmp_path / "out", "--rerun-connect", address)) == 0
        assert time.monotonic() - began < 30, "it would never end"
    assert (tmp_path / "out" / "trajectory.txt").exists()


def test_both_ways_to_a_viewer_are_refused(image_folder, capsys):
    assert main(["run", str(image_folder), "--rerun", "a.rrd", "--rerun-connect", "a:1"]) == 2
    assert "not allowed with" in capsys.readouterr().err


def test_loops_join_the_positions_of_both_visits(fake_odometry):
    from dataclasses import replace

    from dvo.data.trajectory import Trajectory

    result = fake_odometry().finish()
    poses = np.arange(35.0).reshape(5, 7)
    result = replace(result, trajectory=Trajectory(np.arange(5.0), poses), info={"loops": [{"from": 4.0, "to": 1.0}]})
    np.testing.assert_array_equal(loop_lines(result), [[poses[4, :3], poses[1, :3]]])
    assert loop_lines(replace(result, info={"loops": [{"from": 4.0, "to": 9.0}]})).shape == (0, 2, 3)
