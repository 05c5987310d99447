"""``dvo demo`` with an odometry that knows the answer; the learned one is judged by the evaluation."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

import dvo
from dvo.cli import main
from dvo.commands import kernels
from dvo.data.trajectory import read_tum
from dvo.demo import RenderedClip, rendering


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr(kernels, "available_cores", lambda: 2)
    monkeypatch.setattr(kernels, "memory_of_group", lambda *_: None)


@pytest.mark.long
def test_another_process_renders_the_same_clip_and_it_moves(two_cores):
    with rendering(5) as renderer:
        assert renderer is not None
        clips = RenderedClip(5), RenderedClip(5, renderer)
        first, second = (list(clip) for clip in clips)
        assert [list(clip) for clip in clips] == [first, second]  # they can be read again
    assert len(first) == len(second) == clips[0].frame_count == clips[1].frame_count == 5
    for a, b in zip(first, second, strict=True):
        assert a.index == b.index and a.timestamp == b.timestamp and a.camera == b.camera
        assert a.image.shape == (240, 320, 3)
        np.testing.assert_array_equal(a.image, b.image)
    truths = [clip.groundtruth for clip in clips]
    assert truths[0] is not None and truths[1] is not None
    np.testing.assert_array_equal(truths[0].poses_wc, truths[1].poses_wc)
    assert np.abs(np.diff([frame.image.astype(float) for frame in first], axis=0)).mean() > 0.5
    assert truths[0].path_length > 0.01


@pytest.mark.long
def test_what_the_process_does_not_bring_is_rendered_here(two_cores):
    expected = list(RenderedClip(4))
    with rendering(4) as renderer:
        assert renderer is not None
        clip = RenderedClip(4, renderer)
        renderer.close()
        for a, b in zip(clip, expected, strict=True):
            np.testing.assert_array_equal(a.image, b.image)
        assert len(list(RenderedClip(4, renderer))) == 4  # from the beginning


def test_no_process_without_a_core_or_memory_for_it(two_cores, monkeypatch):
    for change in ("available_cores", lambda: 1), ("memory_of_group", lambda *_: 900 * 2**20):
        with monkeypatch.context() as patch:
            patch.setattr(kernels, *change)
            with rendering(3) as renderer:
                assert renderer is None


@pytest.mark.long
def test_demo_reports_the_error_against_ground_truth(monkeypatch, fake_odometry, tmp_path, capsys):
    truth = RenderedClip(12).groundtruth
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
