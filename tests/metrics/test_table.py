"""Errors as they are printed."""

import math

from dvo.metrics.table import shown


def test_small_errors_keep_their_digits():
    found = {"ate_rmse": 0.000123456, "rpe_trans": 1.2e-6, "rpe_rot_deg": math.nan, "ate_percent": None}
    assert [(metric.name, text) for metric, text in shown(found)] == [
        ("ate_rmse", "0.000123"),
        ("rpe_trans", "1.2e-06"),
    ]
