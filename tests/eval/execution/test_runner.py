"""Whole evaluations: killed and resumed, in parallel, with runs that hang."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from dvo.core.errors import DvoError
from dvo.data.files.output import only_writer
from eval.__main__ import main
from eval.execution.plan import read_manifest
from eval.execution.predict import Job, predict_here
from eval.execution.runner import predict_all
from eval.suites.suite import ROOT

pytest.importorskip("evo", reason="evo is in the extra 'eval'")

SLOW_SYSTEM = """
import time
from pathlib import Path
import numpy as np
from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status

class Walk:
    name = "walk"
    def __init__(self, seed):
        self.seed, self.times = seed, []
    def track(self, frame):
        time.sleep(PAUSE)
        self.times.append(frame.timestamp)
        return Estimate(frame.timestamp, None, Status.TRACKING)
    def finish(self):
        with open(Path(__file__).with_suffix(".log"), "a") as file:
            file.write(f"{self.seed}\\n")
        s = np.array(self.times) - self.times[0]
        poses = np.column_stack([np.sin(s + self.seed), s, s**2, *[0 * s] * 3, 0 * s + 1])
        return Result(Trajectory(np.array(self.times), poses), SparseMap(), len(s), 0)
"""


@pytest.fixture
def walk(tmp_path) -> str:
    """A system in a file, which writes a line into ``walk.log`` for each run that it finishes."""
    (tmp_path / "walk.py").write_text(SLOW_SYSTEM.replace("PAUSE", "0.0"))
    return f"{tmp_path / 'walk.py'}:Walk"


def finished(tmp_path: Path) -> list[str]:
    log = tmp_path / "walk.log"
    return sorted(log.read_text().split()) if log.is_file() else []


def command(tmp_path: Path, suite_file: Path, system: str, out: str, *more: str) -> list[str]:
    base = ["run", "--suite", str(suite_file), "--systems", system, "--seeds", "2", "--threads", "1"]
    return [*base, "--data", str(tmp_path), "--out", str(tmp_path / out), "--no-report", *more]


def table_without_timings(out: Path) -> list[list[str]]:
    lines = [line.split(",") for line in (out / "results.csv").read_text().splitlines()]
    drop = {lines[0].index(name) for name in ("fps", "latency_p95_ms", "peak_memory_mb", "parallel")}
    return [[value for i, value in enumerate(line) if i not in drop] for line in lines]


@pytest.mark.long
def test_kill_and_resume(tmp_path, image_folder, plan, suite_file, walk, capsys):
    """Killed in the middle of the second run: the first is kept, nothing is done twice, the table is the same."""
    (tmp_path / "whole").mkdir()
    predict_all(replace(plan, systems=(walk,), out=tmp_path / "whole"), lambda text: None, predict_here)
    assert main(["score", str(tmp_path / "whole")]) == 0
    assert finished(tmp_path) == ["0", "1"]
    (tmp_path / "walk.log").unlink()

    slow = SLOW_SYSTEM.replace("PAUSE", "0.0 if self.seed == 0 or HURRY.exists() else 0.5")
    (tmp_path / "walk.py").write_text(
        slow.replace("class Walk", f"HURRY = Path({str(tmp_path / 'hurry')!r})\nclass Walk")
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    killed = subprocess.Popen(
        [sys.executable, "-m", "eval", *command(tmp_path, suite_file, walk, "out")],
        env=environment,
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    place = tmp_path / "out/predictions"
    patience = time.monotonic() + 120
    while not (list(place.rglob("seed0-*/prediction.json")) and list(place.rglob(".part-seed1-*/job.json"))):
        assert killed.poll() is None and time.monotonic() < patience
        time.sleep(0.05)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert finished(tmp_path) == ["0"]
    (record,) = place.rglob("seed0-*/prediction.json")
    before = record.stat().st_mtime_ns
    (tmp_path / "hurry").touch()

    arguments = command(tmp_path, suite_file, walk, "out")
    assert main(arguments) == 0
    assert finished(tmp_path) == ["0", "1"] and record.stat().st_mtime_ns == before
    assert not list(place.rglob(".part-*"))
    # The whole run had another file: only the version tells them apart.
    tables = [table_without_timings(tmp_path / name) for name in ("whole", "out")]
    assert [[*row[:1], *row[2:]] for row in tables[0]] == [[*row[:1], *row[2:]] for row in tables[1]]

    table = (tmp_path / "out/results.csv").read_bytes()
    capsys.readouterr()
    assert main(arguments) == 0  # nothing to do: the same bytes, timings and all
    assert finished(tmp_path) == ["0", "1"] and (tmp_path / "out/results.csv").read_bytes() == table
    assert capsys.readouterr().err.count("(was there)") == 2


def test_score_of_an_unfinished_evaluation_says_so(plan, image_folder, capsys):
    plan = replace(plan, systems=("null",))

    def stops(job: Job) -> Prediction:
        if job.seed == 1:
            raise KeyboardInterrupt
        return predict_here(job)

    with pytest.raises(KeyboardInterrupt):
        predict_all(plan, lambda text: None, stops)
    assert main(["score", str(plan.out)]) == 0
    assert "- null, clip, seed 1: not run: the evaluation was stopped before" in capsys.readouterr().out


@pytest.mark.slow
def test_parallel_is_serial(tmp_path, image_folder, suite_file, walk):
    assert main(command(tmp_path, suite_file, walk, "serial")) == 0
    assert main(command(tmp_path, suite_file, walk, "parallel", "--workers", "3")) == 0
    assert table_without_timings(tmp_path / "serial") == table_without_timings(tmp_path / "parallel")
    header, first = (line.split(",") for line in (tmp_path / "parallel/results.csv").read_text().splitlines()[:2])
    assert first[header.index("parallel")] == "3"
    assert "taken with 3 runs at a time" in (tmp_path / "parallel/table.md").read_text()
    assert read_manifest(tmp_path / "parallel").workers == 3


def test_two_evaluations_do_not_share_a_folder(plan, image_folder):
    with only_writer(plan.out, "--out"), pytest.raises(DvoError, match="another run is writing"):
        predict_all(replace(plan, systems=("null",)), lambda text: None, predict_here)


def test_an_evaluation_that_was_killed_before_its_manifest_goes_on(plan, image_folder, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("eval.execution.runner.open_once", killed)
        predict_all(replace(plan, systems=("null",)), lambda text: None, predict_here)
    (plan.out / "groundtruth" / "clip").mkdir(parents=True, exist_ok=True)
    with pytest.raises(DvoError, match="not written by this version"):
        read_manifest(plan.out)
    predict_all(replace(plan, systems=("null",)), lambda text: None, predict_here)
    assert read_manifest(plan.out).systems == ("null",)


@pytest.mark.parametrize("name", ["results.csv", "run.json", "predictions", "report.html"])
def test_files_that_no_evaluation_has_written_stay(plan, image_folder, name):
    """Also run.json of a results folder of dvo."""
    (plan.out / name).mkdir() if name == "predictions" else (plan.out / name).write_text('{"frames": 3}')
    with pytest.raises(DvoError, match="not of an evaluation") as caught:
        predict_all(replace(plan, systems=("null",)), lambda text: None, predict_here)
    assert caught.value.file == plan.out / name and [file.name for file in plan.out.iterdir()] == [name]


@pytest.mark.long
def test_hang_and_nan_are_rows(tmp_path, image_folder, suite_file, capsys):
    (tmp_path / "nan.py").write_text(SLOW_SYSTEM.replace("PAUSE", "0").replace("np.sin(s + self.seed)", "s * np.nan"))
    (tmp_path / "hang.py").write_text("import time\ndef Hang():\n    time.sleep(600)\n")
    options = ["--suite", str(suite_file), "--data", str(tmp_path), "--out", str(tmp_path / "o"), "--no-report"]
    assert main(["run", *options, "--systems", f"{tmp_path / 'nan.py'}:Walk"]) == 0
    assert "- nan.py:Walk, clip, seed 0: invalid: 20 poses are not finite" in capsys.readouterr().out
    suite_file.write_text(suite_file.read_text().replace("sequences:", "time_limit: 0.5\nsequences:"))
    assert main(["run", *options, "--systems", f"{tmp_path / 'hang.py'}:Hang,{tmp_path / 'nan.py'}:Walk"]) == 0
    told = capsys.readouterr().out
    assert "- hang.py:Hang, clip, seed 0: timeout: not done after 0.5 s" in told
    assert "nan.py:Walk, clip, seed 0: invalid" in told  # the run of before, although the limit is shorter now
