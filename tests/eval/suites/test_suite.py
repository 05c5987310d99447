"""Suites from files, the reference of the frames that were fed, the data folder."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.files.root import data_root
from dvo.data.trajectory import Trajectory
from eval.suites.selection import settle
from eval.suites.suite import Sequence, open_sequence, read_suite, reference_for


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


GOOD = "name: a\nlabel: b\nsequences:\n  - {name: c, path: d}\n"
SUITE = {
    "a date for the name": ("name: a", "name: 2024-01-31", "name: must be text"),
    "a number for the name": ("name: a", "name: 7", "name: must be text, got 7. Put it in quotes"),
    "a number for the label": ("label: b", "label: 1.5", "label: must be text, got 1.5"),
    "a list for the label": ("label: b", "label: [b]", "label: must be text, got a list"),
    "nothing for the label": ("label: b", "label:", "label: must be text, got None"),
    "an empty name": ("name: a", "name: ''", "name: empty"),
    "a long name": ("name: a", "name: " + "a" * 5000, "name: longer than 100 characters"),
    "a very long label": ("label: b", "label: " + "b" * 20_000, "label: must be text of 10000 characters at most"),
    "no label": ("label: b\n", "", "incomplete suite: no label"),
    "a number for a key": ("label: b", "label: b\n3: 4", "unknown setting 3"),
    "a table of sequences": ("  - {name: c, path: d}", "  c: d", "no list of sequences"),
    "sequences that are texts": ("{name: c, path: d}", "c", r"sequences\[0\]: expected a table of settings .sequence."),
    "sequences that are lists": ("{name: c, path: d}", "[c, d]", r"sequences\[0\]: expected .* got a list"),
    "sequences that are nothing": ("{name: c, path: d}", "", r"sequences\[0\]: expected .* got None"),
    "a number for a sequence": ("name: c", "name: 3", r"sequences\[0\]: name: must be text, got 3"),
    "a boolean for a sequence": ("name: c", "name: yes", r"sequences\[0\]: name: must be text, got True"),
    "a number for a path": ("path: d", "path: 3", r"sequences\[0\]: path: must be text, got 3"),
    "a list for a path": ("path: d", "path: [d]", r"sequences\[0\]: path: must be text, got a list"),
    "a number for a calibration": ("path: d", "path: d, calib: 3", r"sequences\[0\]: calib: must be text, got 3"),
    "a table for the judge": ("path: d", "path: d, judged_by: {a: b}", r"judged_by: unknown: a table"),
    "a text for a rendering": ("path: d", "rendered: yes", r"sequences\[0\]: rendered: must be a list"),
    "a rendering of texts": ("path: d", "rendered: [seed]", r"rendered\[0\]: must be a list of 2"),
    "a sequence twice": (
        "  - {name: c, path: d}",
        "  - {name: c, path: d}\n  - {name: c, path: e}",
        "twice the name 'c'",
    ),
    "an empty sequence": ("name: c", "name: ''", r"sequences\[0\]: name: empty"),
    "no sequence": ("sequences:\n  - {name: c, path: d}", "sequences: []", "sequences: empty"),
    "a text for a number": ("label: b", "label: b\nstride: two", "stride: must be a whole number, got 'two'"),
    "a boolean for a number": ("label: b", "label: b\nstride: yes", "stride: must be a whole number, got True"),
    "a part for a whole number": ("label: b", "label: b\nrpe_gap: 1.5", "rpe_gap: must be a whole number, got 1.5"),
    "a stride of 0": ("label: b", "label: b\nstride: 0", "stride: out of range: 0. Give a number from 1"),
    "an infinite limit": ("label: b", "label: b\ntime_limit: .inf", "time_limit: must be a number, got inf"),
    "no number": ("label: b", "label: b\nlost_below: .nan", "lost_below: must be a number, got nan"),
    "a share above 1": ("label: b", "label: b\nlost_below: 2", "lost_below: out of range: 2"),
    "a list for a choice": ("label: b", "label: b\nalignment: [sim3]", "alignment: unknown: a list"),
    "an impossible date": ("label: b", "label: 2024-13-45", "line 2: not valid YAML .not a date: 2024-13-45"),
    "a huge number": ("label: b", "label: b\nstride: " + "9" * 5000, "line 3: not valid YAML"),
    "nested": ("label: b", "label: " + "[" * 5000, "32 levels"),
    "a list": (GOOD, "[a, b]", "no list of sequences"),
    "a text": (GOOD, "a", "no list of sequences"),
    "nothing": (GOOD, "", "no list of sequences"),
}


@pytest.mark.parametrize("case", SUITE)
def test_entries_of_a_wrong_type(tmp_path, case):
    path = tmp_path / "suite.yaml"
    path.write_text(GOOD)
    assert read_suite(path).sequences[0].path == "d"
    old, new, message = SUITE[case]
    assert old in GOOD
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(DvoError, match=message) as error:
        read_suite(path)
    assert str(error.value).startswith(f"{path}: ") and error.value.remedy
    assert len(str(error.value)) < len(str(path)) + 300


def test_a_suite_in_another_encoding(tmp_path):
    path = tmp_path / "suite.yaml"
    path.write_bytes(GOOD.replace("label: b", "label: Zürich").encode("latin-1"))
    with pytest.raises(DvoError, match="suite.yaml: line 2: not UTF-8 text"):
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


def test_a_part_of_a_recording_with_depth_or_right_images(image_folder):
    root = image_folder.parent
    for name in ("depth", "right"):
        (root / name).mkdir()
        for number in range(20):
            image = np.full((48, 64), 1000 + number, np.uint16) if name == "depth" else np.zeros((48, 64, 3), np.uint8)
            cv2.imwrite(str(root / name / f"{number:04d}.png"), image)
    files = {"calib": "../calib.txt", "times": "../times.txt", "groundtruth": "../truth.txt"}
    one = Sequence("one", "clip/images", start="4f", end="0.6", depth="../depth", **files)
    frames = list(open_sequence(one, root.parent, 1)[0])
    assert [frame.index for frame in frames] == [4, 5]
    assert frames[0].depth is not None and frames[0].depth[0, 0] == pytest.approx(1.004) and frames[0].right is None
    pair = replace(one, depth=None, right="../right", baseline=0.25)
    (frame, _) = open_sequence(pair, root.parent, 1)[0]
    assert frame.depth is None and frame.right is not None and frame.right.baseline == 0.25
    with pytest.raises(DvoError, match="--baseline"):
        open_sequence(replace(pair, baseline=None), root.parent, 1)


def test_recordings_in_metres(data_root):
    suite = read_suite("metric")
    assert suite.alignment == "se3" and "validation" in suite.label
    for sequence in suite.sequences:
        source, _ = open_sequence(settle(suite, sequence, data_root), data_root, 1)
        frame = next(iter(source))
        assert (frame.right is not None) == ("stereo" in sequence.name), sequence.name
        assert (frame.depth is not None) == ("depth" in sequence.name), sequence.name
