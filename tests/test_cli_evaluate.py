"""``dvo evaluate``."""

import cv2
import numpy as np
import pytest

from dvo.cli import main
from dvo.data.trajectory import Trajectory, write_tum
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
