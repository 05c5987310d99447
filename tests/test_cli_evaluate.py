"""``dvo evaluate``."""

import json

import cv2
import numpy as np
import pytest

from dvo.cli import main
from dvo.data.trajectory import Trajectory, write_tum
from dvo.geometry.poses import invert_poses, pose_matrices
from tests.support.fake_odometry import curve

TIMES = 0.1 * np.arange(60)
TRUTH = Trajectory(TIMES, np.array([curve(time) for time in TIMES]))


def changed(scale=1.0, noise=0.0, seconds=0.0):
    poses = TRUTH.poses_wc.copy()
    poses[:, :3] = scale * poses[:, :3] + noise * np.random.default_rng(0).normal(size=(len(poses), 3))
    return Trajectory(TIMES + seconds, poses)


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    write_tum("truth.txt", TRUTH)
    write_tum("half.txt", changed(0.5))
    write_tum("run/trajectory.txt", changed(noise=0.01))
    write_tum("late.txt", changed(seconds=100.0))


def test_several_against_one(files, capsys):
    assert main(["evaluate", "truth.txt", "half.txt", "run", "--out", "all.png"]) == 0
    first, second, picture = capsys.readouterr().out.splitlines()
    assert first.startswith("half.txt: ATE ") and "60 poses, scale 2" in first and "(0.00 %" in first
    assert second.startswith("run: ATE ") and "(0.00 %" not in second
    assert "all.png" in picture and cv2.imread("all.png").std() > 1


def test_a_reference_of_the_world_in_the_camera_is_told(files, capsys):
    write_tum("inverse.txt", Trajectory(TIMES, invert_poses(TRUTH.poses_wc)))
    assert main(["evaluate", "inverse.txt", "half.txt"]) == 0
    assert "inverse.txt looks like poses of the world in the camera (T_cw)" in capsys.readouterr().err
    assert main(["evaluate", "truth.txt", "run"]) == 0
    assert not capsys.readouterr().err


def rows_of(trajectory, file):
    matrices = pose_matrices(trajectory.poses_wc)[:, :3].reshape(-1, 12)
    np.savetxt(file, matrices)


def test_files_without_times_are_compared_row_by_row(files, capsys):
    """As KITTI's tool does; with a file that has times, or has other rows, nothing tells which rows belong together."""
    rows_of(TRUTH, "00.txt")
    rows_of(changed(0.5), "est.txt")
    assert main(["evaluate", "00.txt", "est.txt"]) == 0
    assert "60 poses, scale 2" in capsys.readouterr().out
    numbered = np.column_stack([np.arange(60)[5:], np.loadtxt("est.txt")[5:]])
    np.savetxt("numbered.txt", numbered)
    assert main(["evaluate", "00.txt", "numbered.txt"]) == 0
    assert "55 poses, scale 2" in capsys.readouterr().out
    rows_of(Trajectory(TIMES[1:], TRUTH.poses_wc[1:]), "short.txt")
    for other, said in (
        ("short.txt", "59 rows without times, but 00.txt has 60"),
        ("half.txt", "half.txt: times, but"),
    ):
        assert main(["evaluate", "00.txt", "est.txt", other]) == 2
        assert said in capsys.readouterr().err
    assert main(["evaluate", "half.txt", "00.txt"]) == 2
    assert "60 rows without times, but half.txt has times" in capsys.readouterr().err


def test_results_up_to_scale_have_no_metres(files, tmp_path, capsys):
    facts = {
        "odometry": "a",
        "source": "b",
        "frames": {"read": 60, "lost": 0},
        "segments": [],
        "breaks": [],
        "info": {},
    }
    (tmp_path / "run" / "run.json").write_text(json.dumps(facts))
    assert main(["evaluate", "run", "half.txt"]) == 0
    assert "run is up to scale" in capsys.readouterr().out
    assert main(["evaluate", "truth.txt", "run"]) == 0
    assert "up to scale" not in capsys.readouterr().out


def test_the_folder_of_a_data_set_is_a_reference(files, tmp_path, capsys):
    images = tmp_path / "data" / "images"
    images.mkdir(parents=True)
    for k in range(len(TIMES)):
        cv2.imwrite(str(images / f"{k:04d}.png"), np.zeros((12, 16, 3), np.uint8))
    assert main(["evaluate", "data", "half.txt"]) == 2
    assert "data: a data set without ground truth" in capsys.readouterr().err
    write_tum(tmp_path / "data" / "groundtruth_tum.txt", TRUTH)
    assert main(["evaluate", "data", "half.txt"]) == 0
    of_folder = capsys.readouterr().out.replace("data", "truth.txt")
    assert main(["evaluate", "truth.txt", "half.txt"]) == 0
    assert capsys.readouterr().out.split() == of_folder.split()
    assert main(["evaluate", "truth.txt", "data"]) == 2  # it has no estimate
    assert "trajectory.txt: no such file" in capsys.readouterr().err


def test_what_cannot_be_compared(files, capsys):
    assert main(["evaluate", "truth.txt", "late.txt", "--out", "none.png"]) == 1
    assert "late.txt: no error" in capsys.readouterr().err
    assert main(["evaluate", "truth.txt", "late.txt", "half.txt"]) == 0


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (["truth.txt", "missing.txt"], "missing.txt: no such file"),
        (["truth.txt", "half.txt", "--out", "a.txt"], "not the name of a picture"),
        (["truth.txt"], "required: ESTIMATE"),
        (["truth.txt", "half.txt", "--max-dt", "abc"], "expected a number, got 'abc'"),
    ],
)
def test_wrong_arguments(line, said, files, capsys):
    assert main(["evaluate", *line]) == 2
    assert said in capsys.readouterr().err
