"""The registry, the suites, one run, and the rows and tables made of it, on twenty small images with ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dvo.data.trajectory import Trajectory
from dvo.errors import DvoError
from dvo.odometry.protocol import Odometry
from eval.execution.plan import read_manifest
from eval.execution.predict import predict, predict_here, read_prediction, read_trajectory
from eval.reporting.tables import axis_table, markdown
from eval.scoring.metrics import evo_metrics
from eval.scoring.score import COLUMNS, Row
from eval.suites.suite import data_folder, read_suite, reference_for
from eval.systems.registry import find_system, list_systems

REQUIRED_COLUMNS = [
    *("system", "version", "suite", "sequence", "seed", "status", "frames", "tracked", "alignment"),
    *("ate_rmse", "rpe_trans", "rpe_rot_deg", "completeness", "fps", "latency_p95_ms", "peak_memory_mb"),
]

pytest.importorskip("evo", reason="evo is in the extra 'eval'")


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


def test_death_of_the_process(job, tmp_path):
    prediction = predict(replace(job, system=f"{tmp_path / 'dying.py'}:Dies"))
    assert prediction.status == "unavailable"
    (tmp_path / "dying.py").write_text(
        "import os, signal, sys\n"
        "def Dies():\n"
        "    print('last words', file=sys.stderr, flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGSEGV)\n"
    )
    prediction = predict(replace(job, system=f"{tmp_path / 'dying.py'}:Dies"))
    assert prediction.status == "crashed" and prediction.reason == "killed by SIGSEGV last words"


def test_exception_of_a_system(job, fake_odometry, systems, boom):
    systems(bad=fake_odometry(at_frame={7: boom}))
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


# --- rows and tables --------------------------------------------------------------------------------------------------


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
    # Two lost frames break four pairs of frames two apart, of eighteen.
    assert good.auc == pytest.approx(1) and good.pose_auc_10 == pytest.approx(14 / 18, abs=1e-4)
    assert by_name["lossy"].reason == "8 of 20 frames have a pose" and by_name["lossy"].auc == 0
    assert by_name["null"].rotation_error_ratio == pytest.approx(1) and by_name["null"].ate_percent > 1
    assert np.isnan(by_name["bad"].ate_rmse) and by_name["absent"].reason == "needs a thing"
    assert by_name["bad"].auc == 0 and np.isnan(by_name["absent"].auc)


def test_columns():
    assert list(COLUMNS)[:16] == REQUIRED_COLUMNS
    assert list(COLUMNS)[16:18] == ["stride", "resolution"]
    assert {"scale_drift", "t_rel", "r_rel", "auc", "pose_auc_5", "ate_per_frame_scale", "recovery_s"} <= set(COLUMNS)


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
    assert "**0.250**" in markdown(manifest, turned, two) and "by RPE in degrees" in markdown(manifest, turned, two)
    assert "| tiny | RPE ° | 0.750 |" in axis_table(manifest, two)


def test_line_is_scored_although_evo_refuses_to_align_it():
    path = np.column_stack([np.sin(np.arange(30) / 5), np.zeros(30), np.arange(30) / 5, np.zeros((30, 3)), np.ones(30)])
    line = path.copy()
    line[:, 0] = 0
    stamps = np.arange(30.0)
    metrics = evo_metrics(Trajectory(stamps, line), Trajectory(stamps, path), "sim3")
    assert 0 < metrics.ate_rmse < 1 and metrics.reason is None
