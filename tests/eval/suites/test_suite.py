"""Suites from files, the reference of the frames that were fed, the data folder."""

from __future__ import annotations

import numpy as np
import pytest

from dvo.data.root import data_root
from dvo.data.trajectory import Trajectory
from dvo.errors import DvoError
from eval.suites.suite import read_suite, reference_for


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
        data_root()
    assert data_root(tmp_path) == tmp_path
