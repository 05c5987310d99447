"""Rows of an evaluation: one for each run, failed runs included."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dvo.data.trajectory import read_tum
from eval.execution.plan import read_manifest
from eval.execution.predict import predict_here, read_segments
from eval.scoring import score as score_module
from eval.scoring.metric_table import false_pose_share
from eval.scoring.score import COLUMNS, Row, score

REQUIRED_COLUMNS = [
    *("system", "version", "suite", "sequence", "seed", "status", "frames", "tracked", "alignment"),
    *("ate_rmse", "rpe_trans", "rpe_rot_deg", "completeness", "fps", "latency_p95_ms", "peak_memory_mb"),
]

pytest.importorskip("evo", reason="evo is in the extra 'eval'")


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


def test_an_error_while_a_run_is_scored_costs_no_other(rows, plan, monkeypatch):
    """The truth about loops of a rendered sequence comes from a renderer, which may fail."""
    calls, judge = [], score_module.loop_errors

    def broken(*given):
        calls.append(given)
        if len(calls) == 2:
            raise RuntimeError("no memory\nfor the scene")
        return judge(*given)

    monkeypatch.setattr(score_module, "loop_errors", broken)
    again = score_module.score_all(plan.out, read_manifest(plan.out))
    assert len(calls) > 2
    second = [row for row in rows if row.status in ("ok", "lost")][1]
    for before, after in zip(rows, again, strict=True):
        if before is second:
            assert (after.status, after.reason) == ("failed", "scoring ended by RuntimeError: no memory for the scene")
            assert (after.frames, after.auc) == (before.frames, 0) and np.isnan(after.ate_rmse) and after.failed
        else:
            assert repr(after) == repr(before)


def test_columns():
    assert list(COLUMNS)[:16] == REQUIRED_COLUMNS
    assert list(COLUMNS)[16:18] == ["stride", "resolution"]
    assert {"scale_drift", "t_rel", "r_rel", "auc", "pose_auc_5", "ate_per_frame_scale", "recovery_s"} <= set(COLUMNS)
    assert {"segments", "scored", "unseen", "false_poses"} <= set(COLUMNS)


@pytest.fixture
def scored(job, suite, sequence, systems, image_folder):
    """``scored(odometry)``: the row of its run."""

    def make(odometry, **changes) -> Row:
        name = f"system{len(list(Path(job.folder).parent.glob('run*')))}"
        systems(**{name: odometry})
        folder = Path(job.folder).with_name(f"run-{name}")
        folder.mkdir()
        prediction = replace(predict_here(replace(job, system=name, folder=str(folder))), **changes)
        truth = read_tum(image_folder.parent / "truth.txt")
        return score(prediction, read_segments(folder), truth, system=name, suite=suite, sequence=sequence, seed=0)

    return make


def test_two_segments_are_scored_together(scored, pieces):
    row = scored(pieces((0, 10), (10, 20)))
    # Twenty frames allow one segment, and half of the frames are enough.
    assert (row.segments, row.tracked, row.completeness, row.scored) == (2, 20, 1.0, 0.5)
    assert row.status == "ok" and row.ate_rmse < 1e-6 and "1 of 2 segments not scored" in row.reason
    joined = scored(pieces((0, 10), (12, 20), joined={1: 0}))
    assert (joined.segments, joined.completeness, joined.scored) == (1, 0.9, 0.9) and joined.ate_rmse < 1e-6


def test_tiny_segments_are_a_failure(scored, pieces):
    row = scored(pieces(*((start, start + 4) for start in range(0, 20, 4))))
    assert (row.segments, row.completeness, row.scored, row.status) == (5, 1.0, 0.0, "lost")
    assert row.reason == "5 of 5 segments not scored (20 of 20 poses)" and row.auc == 0 and row.failed


def test_poses_in_the_dark_are_counted(scored, pieces, image_folder):
    scene = np.full((48, 64, 3), 255, np.uint8) * np.linspace(0.2, 0.8, 64)[None, :, None]
    for number in range(20):
        image = np.zeros((48, 64, 3)) if 8 <= number < 13 else scene
        cv2.imwrite(str(image_folder / f"{number:04d}.png"), image.astype(np.uint8))
    rows = [scored(pieces(*bounds)) for bounds in (((0, 20),), ((0, 8), (13, 20)), ((0, 10), (12, 20)))]
    assert [row.unseen for row in rows] == [5, 5, 5]
    assert [row.false_poses for row in rows] == pytest.approx([1.0, 0.0, 3 / 5])
    assert np.isnan(scored(pieces((0, 20)), unseen=[]).false_poses)
    assert np.isnan(scored(pieces((0, 20)), status="crashed").false_poses)
    assert scored(pieces((0, 10), (10, 20))).scored == 1.0  # the dark in the middle allows a second segment


def test_share_of_false_poses():
    assert np.isnan(false_pose_share([], [])) and false_pose_share([1.0, 2.0], []) == 0
