"""Rows of an evaluation: one for each run, failed runs included."""

from __future__ import annotations

import numpy as np
import pytest

from eval.scoring.score import COLUMNS

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


def test_columns():
    assert list(COLUMNS)[:16] == REQUIRED_COLUMNS
    assert list(COLUMNS)[16:18] == ["stride", "resolution"]
    assert {"scale_drift", "t_rel", "r_rel", "auc", "pose_auc_5", "ate_per_frame_scale", "recovery_s"} <= set(COLUMNS)
