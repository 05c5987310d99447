"""``dvo demo`` with an odometry that knows the answer; the learned one is judged by the evaluation."""

from __future__ import annotations

import json
import subprocess
import sys
import threading

import numpy as np
import pytest

import dvo
from dvo.cli import main
from dvo.data.trajectory import read_tum
from dvo.demo import _frames, render_clip
from dvo.synth.sequence import make_sequence


@pytest.mark.long
def test_the_clip_is_the_same_every_time_and_moves():
    first, second = render_clip(5), render_clip(5)
    assert first.frame_count == 5 and first.groundtruth is not None
    for a, b in zip(first, second, strict=True):
        assert a.timestamp == b.timestamp and a.image.shape == (240, 320, 3)
        np.testing.assert_array_equal(a.image, b.image)
    assert np.abs(np.diff([frame.image.astype(float) for frame in first], axis=0)).mean() > 0.5
    assert first.groundtruth.path_length > 0.01


@pytest.mark.long
def test_threads_render_what_one_does_and_stop_when_asked_to(monkeypatch):
    sequence = make_sequence(0, frames=40, family="room")
    for one, several in zip(_frames(sequence, 1), [*zip(range(6), _frames(sequence, 3), strict=False)], strict=False):
        assert one.index == several[0] == several[1].index
        np.testing.assert_array_equal(one.image, several[1].image)
    rendered, stop = [], threading.Event()

    def slow(_, index):
        rendered.append(index)
        if index > 1:
            stop.wait(30)

    monkeypatch.setattr(type(sequence), "frame", slow)
    frames = _frames(sequence, 2)
    next(frames), next(frames)
    threading.Timer(0.2, stop.set).start()  # when all others are cancelled
    frames.close()
    assert len(rendered) < 20


@pytest.mark.long
def test_demo_reports_the_error_against_ground_truth(monkeypatch, fake_odometry, tmp_path, capsys):
    truth = render_clip(12).groundtruth
    assert truth is not None

    def motion(stamp: float) -> np.ndarray:
        pose = truth.poses_wc[int(np.argmin(np.abs(truth.timestamps - stamp)))].copy()
        pose[:3] *= 3
        return pose

    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: fake_odometry(motion=motion))
    assert main(["demo", "--frames", "12", "--device", "cpu", "--out", str(tmp_path / "out")]) == 0
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 12
    written = json.loads((tmp_path / "out" / "run.json").read_text())["metrics"]
    assert written["ate_rmse"] == pytest.approx(0, abs=1e-6) and written["scale"] == pytest.approx(1 / 3, rel=1e-6)
    said = capsys.readouterr().out
    assert "ATE" in said and str(tmp_path / "out") in said


@pytest.mark.slow
def test_demo_with_the_shipped_weights(tmp_path, repository):
    """The real command, as after an install."""
    command = [sys.executable, "-m", "dvo", "demo", "--device", "cpu", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "ATE" in done.stdout and (tmp_path / "out" / "trajectory.png").is_file()
