"""Public benchmarks, folders of the user's own, and the ground truth formats that are rewritten."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvo.core.errors import DvoError
from dvo.data.trajectory import Trajectory, read_tum, write_tum
from dvo.geometry.poses import pose_matrices
from dvo.metrics import evaluate
from eval.suites.selection import config_names, folder_of_data, load_suites, settle, suite_from, suite_of_folder
from eval.suites.suite import SUITES, Sequence, Suite, open_sequence

PUBLIC = {"tum_fr1": 9, "euroc": 11, "tartanair_test": 16, "kitti": 11, "icl_nuim": 8}


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_public_benchmarks_are_ready(name):
    (suite,) = load_suites([name])
    assert suite.name == name and len(suite.sequences) == PUBLIC[name]
    assert len({sequence.path for sequence in suite.sequences}) == PUBLIC[name]
    assert suite.download.startswith("https://") and "benchmark" in suite.label
    assert all((SUITES / s.calib).is_file() for s in suite.sequences if s.calib)


def test_every_config_parses():
    assert {"validation", *PUBLIC} <= set(config_names())
    for name in config_names():
        assert load_suites([name])


def test_several_suites_and_chosen_sequences():
    suites = load_suites(["validation", "kitti"], ["kitti00_120", "kitti07"], stride=3)
    assert [(s.name, [q.name for q in s.sequences], s.stride) for s in suites] == [
        ("validation", ["kitti00_120"], 3),
        ("kitti", ["kitti07"], 3),
    ]
    with pytest.raises(DvoError, match="no sequence 'kitti99' in the suite 'validation, kitti'"):
        load_suites(["validation", "kitti"], ["kitti99"])
    with pytest.raises(DvoError, match="twice"):
        load_suites(["kitti", str(SUITES / "kitti.yaml")])


def test_a_name_that_stands_for_several_suites(monkeypatch):
    a = Sequence("a", "", rendered=(("seed", 1),))
    made = [Suite("plain", "l", (a,)), Suite("fast", "l", (a,))]
    monkeypatch.setattr("eval.suites.selection.read_suites", lambda text: made)
    assert load_suites(["axes"]) == made
    assert folder_of_data(made, None) == Path()  # rendered sequences need no data folder


def test_suite_survives_its_json_form():
    import json
    from dataclasses import asdict

    (suite,) = load_suites(["icl_nuim"])
    assert suite_from(json.loads(json.dumps(asdict(suite)))) == suite


def images(folder: Path, count: int, pattern: str = "{:06d}.png", width: int = 64, height: int = 48) -> None:
    folder.mkdir(parents=True)
    for number in range(count):
        cv2.imwrite(str(folder / pattern.format(number)), np.full((height, width, 3), 10 * number, np.uint8))


def walk(count: int, rate: float) -> Trajectory:
    s = np.arange(count) / rate
    turns = Rotation.from_rotvec(s[:, None] * [0.1, 0.4, 0.2]).as_quat()
    return Trajectory(s, np.column_stack([np.sin(s), 0.3 * s, s**2, turns]))


def opened(name: str, number: int, data: Path) -> tuple[Sequence, Trajectory, int]:
    (suite,) = load_suites([name])
    there = settle(suite, suite.sequences[number], data)
    source, truth = open_sequence(there, data, 1)
    return there, truth, len(list(source))


def test_kitti_layout_also_one_folder_deeper(tmp_path):
    images(tmp_path / "kitti/sequences/00/image_0", 5)
    rows = " ".join(map(str, [500, 0, 31.5, 0, 0, 500, 23.5, 0, 0, 0, 1, 0]))
    (tmp_path / "kitti/sequences/00/calib.txt").write_text(f"P0: {rows}\n")
    (tmp_path / "kitti/sequences/00/times.txt").write_text("".join(f"{0.1 * i}\n" for i in range(5)))
    (tmp_path / "kitti/poses").mkdir()
    truth = walk(5, 10)
    np.savetxt(tmp_path / "kitti/poses/00.txt", pose_matrices(truth.poses_wc)[:, :3].reshape(5, 12))
    there, found, frames = opened("kitti", 0, tmp_path)
    assert there.path == "kitti/sequences/00" and frames == 5
    assert np.allclose(found.poses_wc, truth.poses_wc, atol=1e-6)


def test_tartanair_test_layout(tmp_path):
    """NED rows without times come out as camera poses at the images' times."""
    images(tmp_path / "mono/ME001", 6, width=640, height=480)
    truth = walk(6, 10)
    # Camera x right, y down, z forward is NED's y, z, x.
    ned = truth.poses_wc[:, [2, 0, 1, 5, 3, 4, 6]]
    (tmp_path / "mono/mono_gt").mkdir()
    np.savetxt(tmp_path / "mono/mono_gt/ME001.txt", ned)
    there, found, frames = opened("tartanair_test", 1, tmp_path)
    assert there.name == "ME001" and frames == 6
    assert np.allclose(found.timestamps, np.arange(6) / 10)
    metrics = evaluate(found, truth, "se3")  # the world's axes stay NED's, the camera's do not
    assert metrics.ate_rmse < 1e-6 and metrics.rpe_rot_deg_rmse < 1e-4 and metrics.rpe_trans_rmse < 1e-6


def test_icl_nuim_layout(tmp_path):
    """Stamps that count frames from 1 become the times of the images, in natural order."""
    images(tmp_path / "living_room_traj2_loop", 12, "{}.png", 640, 480)
    (tmp_path / "TrajectoryGT").mkdir()
    truth = walk(11, 30)
    counted = Trajectory(np.arange(1.0, 12.0), truth.poses_wc)
    write_tum(tmp_path / "TrajectoryGT/livingRoom2.gt.freiburg", counted)
    there, found, frames = opened("icl_nuim", 2, tmp_path)
    assert there.name == "living_room2" and frames == 12
    assert np.allclose(found.timestamps, np.arange(11) / 30)
    assert np.allclose(found.positions, truth.positions, atol=1e-6)


def test_folders_of_ones_own(tmp_path, image_folder):
    clip = image_folder.parent
    truth = read_tum(clip / "truth.txt")
    write_tum(clip / "groundtruth_tum.txt", truth)
    (suite,) = load_suites([str(clip)])
    assert suite.name == "clip" and len(suite.sequences) == 1
    source, found = open_sequence(suite.sequences[0], tmp_path / "elsewhere", 1)
    assert len(list(source)) == 20 and np.allclose(found.poses_wc, truth.poses_wc, atol=1e-6)
    shutil.copytree(clip, tmp_path / "all" / "second")
    shutil.copytree(clip, tmp_path / "all" / "first")
    (tmp_path / "all" / "notes").mkdir()
    (several,) = load_suites([str(tmp_path / "all")])
    assert several.name == "all" and [one.name for one in several.sequences] == ["first", "second"]
    shutil.rmtree(image_folder)
    with pytest.raises(DvoError, match="no sequence in this folder"):
        suite_of_folder(clip)


@pytest.mark.parametrize(
    ("folder", "kind"),
    [("kitti00_120", "sequence"), ("tartanair_v1_60", "tartanair"), ("tum_fr1_rpy_60", "tum")],
)
def test_real_folders_of_ones_own(data_root, folder, kind):
    if not (data_root / folder).is_dir():
        pytest.skip(f"no {folder}")
    (suite,) = load_suites([str(data_root / folder)])
    source, truth = open_sequence(suite.sequences[0], Path(), 1)
    assert source.kind == kind and len(truth)
