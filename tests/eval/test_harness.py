"""Predict, score, report and the command line, on twenty small images with ground truth."""

from __future__ import annotations

import csv
import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvo.data.trajectory import Trajectory
from dvo.errors import DvoError
from dvo.odometry.protocol import Odometry
from eval import predict as predict_module
from eval.__main__ import main
from eval.predict import Job, predict, predict_here, read_prediction, read_trajectory
from eval.report import markdown
from eval.runner import Plan, predict_all, report, score_all
from eval.score import COLUMNS, Row, evo_metrics
from eval.sequences import Sequence, Suite, data_folder, read_suite, reference_for
from eval.systems import System, find_system, list_systems

REQUIRED_COLUMNS = [
    *("system", "version", "suite", "sequence", "seed", "status", "frames", "tracked", "alignment"),
    *("ate_rmse", "rpe_trans", "rpe_rot_deg", "completeness", "fps", "latency_p95_ms", "peak_memory_mb"),
]

pytest.importorskip("evo", reason="evo is in the extra 'eval'")


@pytest.fixture
def sequence() -> Sequence:
    return Sequence("clip", "clip/images", calib="../calib.txt", times="../times.txt", groundtruth="../truth.txt")


@pytest.fixture
def suite(sequence) -> Suite:
    return Suite("tiny", "made for a test", (sequence,))


@pytest.fixture
def suite_file(tmp_path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(
        "name: tiny\nlabel: made for a test\nsequences:\n"
        "  - {name: clip, path: clip/images, calib: ../calib.txt, times: ../times.txt, groundtruth: ../truth.txt}\n"
    )
    return path


@pytest.fixture
def job(tmp_path, image_folder, sequence) -> Job:
    (tmp_path / "run").mkdir()
    return Job("null", sequence, str(tmp_path), str(tmp_path / "run"), threads=1)


@pytest.fixture
def systems(monkeypatch):
    """``systems(name=odometry, ...)`` puts odometries into the registry; a string is a reason to be missing."""

    def register(**entries: Odometry | str) -> None:
        table = {
            name: System(
                name,
                "MIT",
                "for a test",
                lambda seed, device, thing=thing: thing,  # type: ignore[misc]
                lambda: "9.9",
                lambda thing=thing: thing if isinstance(thing, str) else None,  # type: ignore[misc]
            )
            for name, thing in entries.items()
        }

        def find(name: str, weights: str | None = None) -> System:
            return table[name] if name in table else find_system(name, weights)

        monkeypatch.setattr(predict_module, "find_system", find)
        monkeypatch.setattr("eval.runner.find_system", find)

    return register


def stop() -> None:
    raise RuntimeError("boom | with a bar\nand two lines")


# --- registry and suites ----------------------------------------------------------------------------------------------


def test_registry():
    names = [system.name for system in list_systems()]
    assert {"dvo-small", "klt-pnp", "null"} <= set(names)
    for name in ("klt-pnp", "null"):
        system = find_system(name)
        assert system.missing() is None
        odometry = system.build(0, "cpu")
        assert isinstance(odometry, Odometry) and odometry.name == name
    with pytest.raises(DvoError, match="orb-slam9"):
        find_system("orb-slam9")


def test_missing_weights_are_a_reason_not_an_error(tmp_path):
    reason = find_system(f"dvo:{tmp_path / 'none.safetensors'}").missing()
    assert reason is not None and "no such weights" in reason


def test_validation_suite_of_the_checkout():
    suite = read_suite("validation")
    assert suite.label == "validation, used to choose" and suite.alignment == "sim3"
    judges = {sequence.name: sequence.judged_by for sequence in suite.sequences}
    assert len(judges) == 4 and judges["tum_fr1_rpy_60"] == "rpe_rot_deg" and judges["kitti00_120"] == "ate_percent"
    assert [s.name for s in suite.only(["tum_fr1_rpy_60", "kitti00_120"]).sequences] == [
        "tum_fr1_rpy_60",
        "kitti00_120",
    ]
    with pytest.raises(DvoError, match="nowhere"):
        suite.only(["nowhere"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name: a\nlabel: b\n", "sequences"),
        ("name: a\nlabel: b\nsequences: [{name: c}]\n", "path"),
        ("name: a\nlabel: b\nsequences: [{name: c, path: d, colour: e}]\n", "colour"),
        ("name: a\nlabel: b\nspeed: 3\nsequences: []\n", "speed"),
        ("name: a\nlabel: b\nalignment: sim4\nsequences: []\n", "sim4"),
        ("name: a\nlabel: b\nsequences: [{name: c, path: d, judged_by: beauty}]\n", "beauty"),
        ("name: [\n", "YAML"),
    ],
)
def test_bad_suites_say_what_is_wrong(tmp_path, text, words):
    path = tmp_path / "suite.yaml"
    path.write_text(text)
    with pytest.raises(DvoError, match=words):
        read_suite(path)


def test_reference_has_the_rows_of_the_frames_fed():
    truth = Trajectory(np.arange(10.0), np.tile([0, 0, 0, 0, 0, 0, 1.0], (10, 1)))
    reference = reference_for(truth, np.array([0.0, 3.001, 6.0, 20.0]))
    assert reference.timestamps.tolist() == [0.0, 3.001, 6.0]


def test_missing_data_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("DVO_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(DvoError, match="nowhere"):
        data_folder()
    assert data_folder(tmp_path) == tmp_path


# --- predict ----------------------------------------------------------------------------------------------------------


def test_a_run_in_its_own_process(job):
    prediction = predict(job)
    assert prediction.status == "ok" and prediction.tracked == len(prediction.stamps) == 20
    assert prediction.resolution == "64x48" and prediction.fps and prediction.fps > 0
    assert prediction.peak_memory_mb and 10 < prediction.peak_memory_mb < 2000
    assert len(read_trajectory(job.folder)) == 20
    assert read_prediction(job.folder) == prediction


def test_stride_feeds_fewer_frames(job):
    assert predict_here(replace(job, stride=3)).stamps == pytest.approx(10 + 0.3 * np.arange(7))


def test_time_limit(job):
    prediction = predict(replace(job, time_limit=0.01))
    assert prediction.status == "timeout" and "0.01 s" in prediction.reason


def test_death_of_the_process(job, monkeypatch):
    def die(*_args, **_options):
        return subprocess.CompletedProcess([], -11, "", "noise\nlast words")

    monkeypatch.setattr(predict_module.subprocess, "run", die)
    prediction = predict(job)
    assert prediction.status == "crashed" and prediction.reason == "killed by SIGSEGV last words"


def test_exception_of_a_system(job, fake_odometry, systems):
    systems(bad=fake_odometry(at_frame={7: stop}))
    prediction = predict_here(replace(job, system="bad"))
    assert prediction.status == "crashed" and prediction.reason.startswith("RuntimeError: boom")
    assert len(read_trajectory(job.folder)) == 0


def test_poses_that_are_not_finite(job, fake_odometry, systems):
    systems(bad=fake_odometry(motion=lambda t: np.full(7, np.nan if t > 11 else 0.5)))
    prediction = predict_here(replace(job, system="bad"))
    assert prediction.status == "invalid" and "9 poses are not finite" in prediction.reason
    assert len(read_trajectory(job.folder)) == 0


def test_missing_data_is_a_status(job):
    prediction = predict_here(replace(job, sequence=replace(job.sequence, path="elsewhere")))
    assert prediction.status == "no data" and "elsewhere" in prediction.reason


# --- score and report -------------------------------------------------------------------------------------------------


@pytest.fixture
def plan(tmp_path, suite) -> Plan:
    names = ("good", "lossy", "bad", "absent", "null")
    (tmp_path / "out").mkdir()
    return Plan(suite, names, (0, 1), tmp_path, tmp_path / "out", threads=1)


def here(job: Job):
    Path(job.folder).mkdir(parents=True, exist_ok=True)
    system = predict_module.find_system(job.system)
    if system.missing():
        return predict(job)
    return predict_here(job)


@pytest.fixture
def rows(plan, image_folder, fake_odometry, systems) -> list[Row]:
    class Fresh:
        """A fake that can be used for one run after the other."""

        name = "fresh"

        def __init__(self, **options) -> None:
            self.options = options
            self.inner = fake_odometry(**options)

        def track(self, frame):
            return self.inner.track(frame)

        def finish(self):
            done, self.inner = self.inner.finish(), fake_odometry(**self.options)
            return done

    systems(
        good=Fresh(lost=(3, 4)),
        lossy=Fresh(lost=tuple(range(12))),
        bad=fake_odometry(at_frame={5: stop}),
        absent="needs a thing",
    )
    said: list[str] = []
    predict_all(plan, said.append, here)
    assert len(said) == 10
    return score_all(plan)


def test_every_run_is_a_row(rows):
    assert len(rows) == 10
    by_name = {row.system: row for row in rows}
    assert {name: row.status for name, row in by_name.items()} == {
        "good": "ok",
        "lossy": "lost",
        "bad": "crashed",
        "absent": "unavailable",
        "null": "ok",
    }
    good = by_name["good"]
    assert good.ate_rmse < 1e-6 and good.rpe_rot_deg < 1e-3 and good.rotation_error_ratio < 1e-3
    assert (good.frames, good.tracked, good.completeness) == (20, 18, 0.9)
    assert good.version == "9.9" and good.resolution == "64x48" and good.stride == 1 and good.alignment == "sim3"
    assert by_name["lossy"].reason == "8 of 20 frames have a pose"
    assert by_name["null"].rotation_error_ratio == pytest.approx(1) and by_name["null"].ate_percent > 1
    assert np.isnan(by_name["bad"].ate_rmse) and by_name["absent"].reason == "needs a thing"


def test_report(plan, rows):
    table = report(plan, rows)
    assert "**made for a test**" in table and "Alignment sim3; stride 1; seeds 0, 1" in table
    lines = [line for line in table.splitlines() if line.startswith("|")]
    assert len(lines) == 2 + 5 and len({line.count("|") for line in lines}) == 1
    assert [line.split("|")[3].strip() for line in lines[2:]] == ["0/2", "2/2", "2/2", "2/2", "0/2"]
    good, lossy = lines[2], lines[3]
    assert "**0.00**" in good and "| – |" in lossy and table.count("**") == 4
    assert table.count("- bad, clip, seed") == 2
    with open(plan.out / "results.csv", newline="") as file:
        written = list(csv.DictReader(file))
    assert list(written[0])[:16] == REQUIRED_COLUMNS and tuple(written[0]) == COLUMNS
    assert len(written) == 10 and float(written[0]["completeness"]) == 0.9
    crashed = next(row for row in written if row["system"] == "bad")
    assert crashed["ate_rmse"] == "" and crashed["reason"] == "RuntimeError: boom | with a bar and two lines"
    assert (plan.out / "clip.png").read_bytes()[:4] == b"\x89PNG"


def test_median_and_range_over_seeds(suite, rows):
    row = next(row for row in rows if row.system == "null")
    three = [replace(row, seed=seed, ate_percent=value) for seed, value in enumerate((3.0, 1.0, 8.0))]
    assert "**3.00 [1.00–8.00]**" in markdown(suite, three, 1, "cpu")
    one_lost = [*three[:2], replace(three[2], status="crashed")]
    assert "3.00 [1.00–∞]" in markdown(suite, one_lost, 1, "cpu")
    two_lost = [replace(r, status="crashed") if r.seed else r for r in three]
    assert "3.00" not in markdown(suite, two_lost, 1, "cpu")


def test_judged_by_rotation(suite, rows):
    null, good = (next(row for row in rows if row.system == name) for name in ("null", "good"))
    turned = replace(suite, sequences=(replace(suite.sequences[0], judged_by="rpe_rot_deg"),))
    table = markdown(turned, [replace(null, rpe_rot_deg=0.25), replace(good, rpe_rot_deg=0.75)], 1, "cpu")
    assert "**0.250**" in table and "clip by RPE in degrees" in table


def test_line_is_scored_although_evo_refuses_to_align_it():
    path = np.column_stack([np.sin(np.arange(30) / 5), np.zeros(30), np.arange(30) / 5, np.zeros((30, 3)), np.ones(30)])
    line = path.copy()
    line[:, 0] = 0
    stamps = np.arange(30.0)
    metrics = evo_metrics(Trajectory(stamps, line), Trajectory(stamps, path), "sim3")
    assert 0 < metrics.ate_rmse < 1 and metrics.reason is None


# --- the command line -------------------------------------------------------------------------------------------------


def test_command(tmp_path, image_folder, suite_file, capsys):
    out = tmp_path / "results"
    options = ["--suite", str(suite_file), "--data", str(tmp_path), "--out", str(out), "--systems", "null"]
    assert main([*options, "--threads", "1"]) == 0
    table = capsys.readouterr().out
    assert table.startswith("**made for a test**") and "| clip | null | 0/1 |" in table
    assert (out / "table.md").read_text() == table.rstrip("\n") + "\n"
    assert json.loads((out / "predictions/null/clip/seed0/prediction.json").read_text())["status"] == "ok"
    before = (out / "results.csv").read_bytes()
    assert main([*options, "--threads", "1", "--score-only"]) == 0
    assert (out / "results.csv").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--systems", "monoslam9"], "no system 'monoslam9'"),
        (["--sequences", "nowhere"], "no sequence 'nowhere'"),
        (["--seeds", "0"], "--seeds"),
        (["--suite", "none"], "no such suite"),
        (["--data", "nowhere"], "no such data folder"),
        (["--score-only", "--systems", "null"], "no such prediction"),
    ],
)
def test_bad_commands_exit_2_with_one_line(tmp_path, image_folder, suite_file, capsys, options, words):
    base = ["--suite", str(suite_file), "--data", str(tmp_path), "--out", str(tmp_path / "o")]
    assert main([*base, *options]) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("eval: error:") and words in error and "\n" not in error


def test_list(capsys):
    assert main(["--list"]) == 0
    assert "klt-pnp" in capsys.readouterr().out
