"""When a prediction is made again and when not, what a kill leaves behind, and runs at the same time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dvo.errors import DvoError
from eval.__main__ import main
from eval.execution import cache, versions
from eval.execution.cache import data_fingerprint, digest_of, job_key, obtain, reusable, sweep, system_facts
from eval.execution.plan import read_manifest
from eval.execution.predict import Job, Prediction, predict_here, write_prediction
from eval.execution.process import begin, run_limited
from eval.execution.runner import predict_all
from eval.execution.versions import code_digest, feels_threads, source_files
from eval.suites.suite import ROOT, open_sequence
from eval.systems.registry import find_system

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


# --- keys -------------------------------------------------------------------------------------------------------------


def test_key_changes_with_everything_that_matters(job, tmp_path):
    facts = system_facts("null")
    source, _ = open_sequence(job.sequence, tmp_path, 1)
    data = data_fingerprint(source, job.sequence)
    rendered = {"name": "tiny", "version": 1}

    def digest(job: Job = job, facts=facts, data: str = data, suite=rendered) -> str:
        return digest_of(job_key(job, facts, data, suite))

    others = {
        "system": digest(replace(job, system="klt-pnp")),
        "version or weights": digest(facts=replace(facts, version="0.1.0+0badcafe")),
        "code": digest(facts=replace(facts, code="1234")),
        "library": digest(facts=replace(facts, libraries={"numpy": "1.0"})),
        "seed": digest(replace(job, seed=1)),
        "stride": digest(replace(job, stride=2)),
        "device": digest(replace(job, device="elsewhere")),
        "data": digest(data="5678"),
        "version of the suite": digest(suite={"name": "tiny", "version": 2}),
    }
    assert len({digest(), *others.values()}) == 1 + len(others), others
    same = (replace(job, folder="x"), replace(job, time_limit=3.0), replace(job, parallel=4), replace(job, threads=7))
    told = replace(job, sequence=replace(job.sequence, about="other words", judged_by="rpe_rot_deg"))
    assert {digest(one) for one in (*same, told)} == {digest()}
    threaded = replace(facts, threads=True)
    assert digest(job, threaded) != digest(replace(job, threads=7), threaded)


def test_fingerprint_follows_images_and_calibration(job, tmp_path, image_folder):
    def now() -> str:
        source, _ = open_sequence(job.sequence, tmp_path, 1)
        return data_fingerprint(source, job.sequence)

    before = now()
    os.utime(image_folder / "0003.png", (1, 1))
    assert now() == before  # a copy with other times is the same small sequence
    image = cv2.imread(str(image_folder / "0003.png"))
    cv2.imwrite(str(image_folder / "0003.png"), 255 - image)
    changed = now()
    assert changed != before
    (image_folder.parent / "calib.txt").write_text("51 50 31.5 23.5\n")
    assert now() not in (before, changed)


def test_fingerprint_of_large_sequences_follows_sizes_and_times(job, tmp_path, image_folder, monkeypatch):
    monkeypatch.setattr(cache, "CONTENT_LIMIT", 1000)
    source, _ = open_sequence(job.sequence, tmp_path, 1)
    before = data_fingerprint(source, job.sequence)
    assert data_fingerprint(source, job.sequence) == before
    os.utime(image_folder / "0003.png", (1, 1))
    assert data_fingerprint(source, job.sequence) != before


def test_code_of_a_system_is_what_it_imports(monkeypatch):
    names = {str(file.relative_to(ROOT)) for file in source_files(find_system("klt-pnp"))}
    assert {"eval/baselines/klt_pnp.py", "eval/baselines/klt.py", "eval/baselines/two_view.py"} <= names
    assert "eval/baselines/null.py" not in names and not any("dvo/nets" in name for name in names)
    learned = {str(file.relative_to(ROOT)) for file in source_files(find_system("dvo-small"))}
    assert {"dvo/odometry/tracker.py", "dvo/nets/patch_vo.py", "dvo/ba/layer.py"} <= learned
    assert feels_threads(find_system("dvo-small")) and not feels_threads(find_system("klt-pnp"))

    before = {name: code_digest(find_system(name)) for name in ("klt-pnp", "null")}
    read = versions._content
    monkeypatch.setattr(versions, "_content", lambda file: read(file) + b"#" * (file.name == "two_view.py"))
    assert code_digest(find_system("klt-pnp")) != before["klt-pnp"]
    assert code_digest(find_system("null")) == before["null"]


def test_weights_are_part_of_the_version(tmp_path):
    torch = pytest.importorskip("torch")
    from dvo.models.weights import find_weights, weights_info

    first = tmp_path / "first.safetensors"
    first.write_bytes(find_weights("small").read_bytes())
    before = system_facts("dvo-small", str(first)).version
    assert before.endswith(weights_info(first).sha256[:8]) and torch
    content = bytearray(first.read_bytes())
    content[-1] ^= 1
    first.write_bytes(bytes(content))
    assert system_facts("dvo-small", str(first)).version != before


# --- what lies in the folder ------------------------------------------------------------------------------------------


def test_a_run_is_made_once(job, tmp_path):
    made: list[str] = []

    def run(job: Job) -> Prediction:
        made.append(job.folder)
        return predict_here(job)

    job = replace(job, folder=str(tmp_path / "p" / "seed0-abc"))
    first, old = obtain(job, {"a": 1}, run=run)
    again, older = obtain(job, {"a": 1}, run=run)
    assert (old, older) == (False, True) and len(made) == 1 and again == first
    assert sorted(path.name for path in (tmp_path / "p").iterdir()) == ["seed0-abc"]  # nothing half done beside it
    assert json.loads((tmp_path / "p/seed0-abc/key.json").read_text()) == {"a": 1}


def test_failures_stay_unless_they_can_have_passed(job, tmp_path):
    def left(status: str, limit: float = 10.0) -> Prediction | None:
        write_prediction(replace(job, time_limit=limit), Prediction(status))
        return reusable(replace(job, time_limit=20.0))

    assert left("ok") and left("crashed") and left("invalid") and left("timeout", limit=20.0)
    assert left("timeout") is None and left("unavailable") is None and left("no data") is None
    write_prediction(job, Prediction("crashed"))
    assert reusable(job, retry=True) is None
    write_prediction(job, Prediction("ok"))
    assert reusable(job, retry=True)


def test_halves_are_swept(tmp_path):
    (tmp_path / "null/.part-seed0-abc-1-2").mkdir(parents=True)
    (tmp_path / "null/seed0-abc").mkdir()
    sweep(tmp_path)
    assert [path.name for path in (tmp_path / "null").iterdir()] == ["seed0-abc"]


# --- whole evaluations ------------------------------------------------------------------------------------------------


def command(tmp_path: Path, suite_file: Path, system: str, out: str, *more: str) -> list[str]:
    base = ["run", "--suite", str(suite_file), "--systems", system, "--seeds", "3", "--threads", "1"]
    return [*base, "--data", str(tmp_path), "--out", str(tmp_path / out), "--no-report", *more]


def table_without_timings(out: Path) -> list[list[str]]:
    lines = [line.split(",") for line in (out / "results.csv").read_text().splitlines()]
    drop = {lines[0].index(name) for name in ("fps", "latency_p95_ms", "peak_memory_mb", "parallel")}
    return [[value for i, value in enumerate(line) if i not in drop] for line in lines]


def test_kill_and_resume(tmp_path, image_folder, suite_file, walk, capsys):
    """Killed in the middle of the second run: the first is kept, nothing is done twice, the table is the same."""
    (tmp_path / "walk.py").write_text(SLOW_SYSTEM.replace("PAUSE", "0.0"))
    arguments = command(tmp_path, suite_file, walk, "whole")
    assert main(arguments) == 0
    whole = (tmp_path / "whole/results.csv").read_bytes()
    assert finished(tmp_path) == ["0", "1", "2"]
    assert main(arguments) == 0  # nothing to do: the same bytes, timings and all
    assert finished(tmp_path) == ["0", "1", "2"] and (tmp_path / "whole/results.csv").read_bytes() == whole
    assert capsys.readouterr().err.count("(was there)") == 3
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

    assert main(command(tmp_path, suite_file, walk, "out")) == 0
    assert finished(tmp_path) == ["0", "1", "2"] and record.stat().st_mtime_ns == before
    assert not list(place.rglob(".part-*"))
    # The whole run had another file: only the version tells them apart.
    tables = [table_without_timings(tmp_path / name) for name in ("whole", "out")]
    assert [[*row[:1], *row[2:]] for row in tables[0]] == [[*row[:1], *row[2:]] for row in tables[1]]


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


def test_parallel_is_serial(tmp_path, image_folder, suite_file, walk):
    assert main(command(tmp_path, suite_file, walk, "serial")) == 0
    assert main(command(tmp_path, suite_file, walk, "parallel", "--workers", "3")) == 0
    assert table_without_timings(tmp_path / "serial") == table_without_timings(tmp_path / "parallel")
    header, first = (line.split(",") for line in (tmp_path / "parallel/results.csv").read_text().splitlines()[:2])
    assert first[header.index("parallel")] == "3"
    assert "taken with 3 runs at a time" in (tmp_path / "parallel/table.md").read_text()
    assert read_manifest(tmp_path / "parallel").workers == 3


def test_two_evaluations_do_not_share_a_folder(plan, image_folder):
    fcntl = pytest.importorskip("fcntl")
    with open(plan.out / ".lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(DvoError, match="another evaluation"):
            predict_all(replace(plan, systems=("null",)), lambda text: None, predict_here)


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


def test_time_limit_ends_the_children_too(tmp_path):
    begin()
    script = f"sleep 600 & echo $! > {tmp_path / 'child'}; echo before the end; wait"
    ending = run_limited(["sh", "-c", script], dict(os.environ), 1.5, tmp_path / "log.txt")
    assert ending.code is None and ending.last_line == "before the end"
    with pytest.raises(ProcessLookupError):
        for _ in range(200):
            os.kill(int((tmp_path / "child").read_text()), 0)
            time.sleep(0.05)


def test_ray_missing_and_packed_runs(job, tmp_path, image_folder, monkeypatch, plan):
    from eval.execution import cluster

    job = replace(job, folder=str(tmp_path / "p/seed0-abc"))
    monkeypatch.setattr(cluster, "predict", predict_into_new_folder)
    done = cluster.unpack(cluster.run_packed(job), job, {"k": 1})
    assert done.status == "ok" and done.tracked == 20 and reusable(job) == done
    assert np.isfinite(np.loadtxt(tmp_path / "p/seed0-abc/trajectory.txt")).all()

    asked: list[str] = []
    monkeypatch.setattr(cluster.importlib, "import_module", lambda name: PretendedRay(asked))
    said: list[str] = []
    predict_all(replace(plan, systems=("null",), ray="ray://head:1"), said.append)
    assert asked == ["init ray://head:1", "cpus 1", "run 0", "run 1", "shutdown"]
    assert [text.split(": ")[1] for text in said] == ["20/20 frames"] * 2

    def absent(name: str):
        raise ImportError(name)

    monkeypatch.setattr(cluster.importlib, "import_module", absent)
    with pytest.raises(DvoError, match="Ray is not installed"):
        predict_all(replace(plan, systems=("null",), seeds=(7,), ray="auto"), lambda text: None)


def predict_into_new_folder(job: Job) -> Prediction:
    Path(job.folder).mkdir(parents=True)
    return predict_here(job)


class PretendedRay:
    """The part of Ray that is used, in this process; the last run asked for is done first."""

    def __init__(self, asked: list[str]) -> None:
        self.asked = asked

    def init(self, address: str, **options) -> None:
        self.asked.append(f"init {address}")

    def remote(self, **options):
        self.asked.append(f"cpus {options['num_cpus']}")

        def wrap(function):
            def start(job: Job) -> tuple:
                self.asked.append(f"run {job.seed}")
                return (function, job)

            return type("Remote", (), {"remote": staticmethod(start)})

        return wrap

    def wait(self, waiting: list, num_returns: int) -> tuple[list, list]:
        return waiting[-num_returns:], waiting[:-num_returns]

    def get(self, reference: tuple) -> bytes:
        return reference[0](reference[1])

    def shutdown(self) -> None:
        self.asked.append("shutdown")
