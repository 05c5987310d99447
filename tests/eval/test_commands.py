"""``python -m eval``: its verbs, the short form without one, and mistakes."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from dvo.data.trajectory import read_tum, write_tum
from eval.__main__ import main

pytest.importorskip("evo", reason="evo is in the extra 'eval'")


@pytest.mark.long
def test_short_form_is_run(tmp_path, image_folder, suite_file, capsys, no_figures):
    out = tmp_path / "results"
    options = ["--suite", str(suite_file), "--data", str(tmp_path), "--out", str(out), "--systems", "null"]
    assert main([*options, "--threads", "1"]) == 0
    table = capsys.readouterr().out
    assert table.startswith("**made for a test**") and "| clip | null | 0/1 |" in table
    assert (out / "table.md").read_text() == table and (out / "report.html").is_file()
    assert (out / "axes.md").read_text().startswith("| axis | median | null |")
    (record,) = out.glob("predictions/null/tiny/clip/seed0-*/prediction.json")
    assert json.loads(record.read_text())["status"] == "ok"
    before = (out / "results.csv").read_bytes()
    for again in ([*options, "--threads", "1", "--score-only"], ["score", str(out)], ["run", *options, "--no-report"]):
        assert main(again) == 0
        assert (out / "results.csv").read_bytes() == before  # timings are kept with the prediction
    assert capsys.readouterr().out.count("**made for a test**") == 3


@pytest.mark.long
def test_runs_with_weights_of_a_file_are_labelled_by_it(tmp_path, image_folder, suite_file, capsys):
    weights = tmp_path / "night.safetensors"
    weights.write_bytes(b"none")
    out = tmp_path / "results"
    options = ["--suite", str(suite_file), "--data", str(tmp_path), "--out", str(out), "--no-report"]
    assert main(["run", *options, "--systems", "dvo-small,null", "--weights", str(weights)]) == 0
    told = capsys.readouterr()
    assert "dvo:night" in told.out and "dvo-small" not in told.out + told.err
    manifest = json.loads((out / "run.json").read_text())
    assert manifest["systems"] == ["dvo:night", "null"] and "dvo:night" in manifest["facts"]
    assert "dvo-small" not in (out / "results.csv").read_text() + (out / "table.md").read_text()
    assert len(list(out.glob("predictions/dvo_night/tiny/clip/seed0-*/prediction.json"))) == 1


def test_benchmark_without_data_says_what_is_missing(tmp_path, capsys):
    options = ["run", "--suite", "euroc", "--data", str(tmp_path), "--out", str(tmp_path / "o"), "--systems", "null"]
    assert main([*options, "--no-report"]) == 0
    told = capsys.readouterr()
    lines = [line for line in told.out.splitlines() if line.startswith("- null, ")]
    assert len(lines) == 11 and all("no data" in line and "https://projects.asl.ethz.ch" in line for line in lines)
    assert str(tmp_path / "MH_01_easy") in lines[0] and len((tmp_path / "o/results.csv").read_text().splitlines()) == 12


@pytest.mark.long
def test_folder_of_ones_own(tmp_path, image_folder, capsys):
    clip = image_folder.parent
    write_tum(clip / "groundtruth_tum.txt", read_tum(clip / "truth.txt"))
    options = ["run", "--suite", str(clip), "--systems", "null", "--out", str(tmp_path / "o"), "--no-report"]
    assert main(options) == 0
    assert "| clip | null | 0/1 |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--systems", "monoslam9"], "no system 'monoslam9'"),
        (["--systems", ","], "--systems: no system"),
        (["--systems", "a/x.py:A,b/x.py:A"], "two systems of the name 'x.py:A'"),
        (["--sequences", "nowhere"], "no sequence 'nowhere'"),
        (["--seeds", "0"], "--seeds"),
        (["--workers", "0"], "--workers"),
        (["--seeds", "many"], "invalid int value"),
        (["--colour", "red"], "unrecognized arguments"),
        (["--suite", "none"], "no such suite"),
        (["--data", "nowhere"], "no such data folder"),
        (["--score-only"], "no evaluation in this folder"),
    ],
)
def test_bad_commands_exit_2_with_one_line(tmp_path, image_folder, suite_file, capsys, options, words):
    base = ["--suite", str(suite_file), "--data", str(tmp_path), "--out", str(tmp_path / "o")]
    assert main([*base, *options]) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("eval: error:") and words in error and "\n" not in error


def test_bad_folders_exit_2_with_one_line(tmp_path, capsys):
    assert main(["report", str(tmp_path)]) == 2 and "no evaluation in this folder" in capsys.readouterr().err
    (tmp_path / "run.json").write_text("{}")
    assert main(["score", str(tmp_path)]) == 2 and "not written by this version" in capsys.readouterr().err
    assert main(["report"]) == 2
    error = capsys.readouterr().err.strip()
    assert "required: DIR" in error and "\n" not in error


@pytest.mark.long
def test_list(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DVO_DATA", str(tmp_path))
    assert main(["list"]) == 0
    told = capsys.readouterr().out
    assert "klt-pnp        MIT        available" in told and "MH_01 " in told
    assert "\n  inertial " in told and "\n  inertial_dark " in told  # a group with the name of its first axis
    assert f"missing: {tmp_path / 'MH_01_easy'}" in told and "data: https://www.cvlibs.net" in told
    assert main(["--list"]) == 0 and capsys.readouterr().out == told


@pytest.mark.long
def test_a_reader_that_has_seen_enough_ends_it_quietly(repository):
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "eval", "list"], cwd=repository, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 0
