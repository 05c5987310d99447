"""Every bad input: exit code 2, one line on stderr that names the culprit, no traceback, no results folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import dvo
from dvo.cli import main


@pytest.fixture(autouse=True)
def fake(monkeypatch, fake_odometry):
    monkeypatch.setitem(vars(dvo), "load", lambda *args, **options: fake_odometry())


def error_of(command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    out = tmp_path / "never"
    assert main([*command, "--out", str(out)]) == 2
    said = capsys.readouterr()
    (line,) = said.err.strip().splitlines()
    assert "error: " in line and "Traceback" not in line
    assert not out.exists(), "a failed run leaves nothing behind"
    return line


def calibration(folder: Path, text: str = "50 50 31.5 23.5") -> str:
    file = folder / "some_calibration.txt"
    file.write_text(text + "\n")
    return str(file)


@pytest.mark.parametrize("suffix", [".tif", ".pgm", ".bmp"])
def test_damaged_images_are_one_line(tmp_path, suffix):
    """In a process of its own: OpenCV prints lines of its own, and asks for its level of logging once."""
    code = cv2.imencode(suffix, np.random.default_rng(0).integers(0, 256, (48, 64, 1), np.uint8))[1].tobytes()
    (tmp_path / "images").mkdir()
    for index in range(3):
        (tmp_path / "images" / f"{index}{suffix}").write_bytes(code[: len(code) - 20])
    command = [sys.executable, "-m", "dvo", "run", str(tmp_path / "images"), "--calib", calibration(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "none of the 3 images decodes" in done.stderr


def in_a_process(*command: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    found = {**os.environ, "PYTHONPATH": str(Path(dvo.__file__).parents[1]), **variables}
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, cwd=folder, env=found)


def test_a_name_that_begins_with_a_dash(tmp_path):
    (tmp_path / "-x.mp4").write_bytes(b"")
    done = in_a_process("-m", "dvo", "run", "-x.mp4", folder=tmp_path)
    assert done.returncode == 2 and "the file -x.mp4 is ./-x.mp4" in done.stderr and done.stderr.count("\n") == 1


def test_a_working_directory_that_is_gone(tmp_path):
    """Libraries end the process there with lines of their own."""
    (tmp_path / "gone").mkdir()
    leave = "import os, sys; os.rmdir(os.getcwd()); import dvo.cli; sys.exit(dvo.cli.main(['run', 'v.mp4']))"
    done = in_a_process("-c", leave, folder=tmp_path / "gone")
    assert done.returncode == 2 and "the working directory is gone" in done.stderr and done.stderr.count("\n") == 1


def test_a_home_that_cannot_be_written_is_no_matter(image_folder, tmp_path):
    (tmp_path / "home").write_bytes(b"")
    plot = (
        "import dvo.cli, numpy as np; from pathlib import Path; dvo.cli.main(['--version']); "
        "from dvo.viz.plot import *; from dvo.data.trajectory import Trajectory; "
        "plot_trajectory(Path('a.png'), Trajectory(np.arange(3.0), np.eye(7)[[0, 1, 6]] + np.eye(7)[6]))"
    )
    done = in_a_process("-c", plot, folder=tmp_path, HOME=str(tmp_path / "home"))
    assert done.returncode == 0 and done.stderr == "" and (tmp_path / "a.png").exists()


def test_missing_source(tmp_path, capsys):
    assert "nowhere.mp4" in error_of(["run", str(tmp_path / "nowhere.mp4")], tmp_path, capsys)


def test_an_empty_source_is_not_the_working_directory(image_folder, tmp_path, capsys, monkeypatch):
    """As of a variable of a script that is not set."""
    monkeypatch.chdir(image_folder)
    assert "source: an empty text" in error_of(["run", ""], tmp_path, capsys)


def test_calibration_file_missing(image_folder, tmp_path, capsys):
    assert "gone.txt" in error_of(["run", str(image_folder), "--calib", "gone.txt"], tmp_path, capsys)


@pytest.mark.parametrize("text", ["", "50 50", "a b c d", "50 50 31.5 nan", "-50 50 31.5 23.5"])
def test_malformed_calibration(image_folder, tmp_path, capsys, text):
    file = calibration(tmp_path, text)
    assert "some_calibration.txt" in error_of(["run", str(image_folder), "--calib", file], tmp_path, capsys)


def test_intrinsics_that_do_not_fit_the_image(image_folder, tmp_path, capsys):
    file = calibration(tmp_path, "525 525 319.5 239.5")
    assert "64x48" in error_of(["run", str(image_folder), "--calib", file], tmp_path, capsys)


def test_video_that_does_not_decode(tmp_path, capsys):
    video = tmp_path / "noise.mp4"
    video.write_bytes(np.random.default_rng(0).bytes(4000))
    assert "noise.mp4" in error_of(["run", str(video), "--calib", calibration(tmp_path)], tmp_path, capsys)


def test_video_without_frames(tmp_path, capsys):
    video = tmp_path / "empty.avi"
    cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48)).release()
    assert "empty.avi" in error_of(["run", str(video), "--calib", calibration(tmp_path)], tmp_path, capsys)


def test_empty_file(tmp_path, capsys):
    (tmp_path / "zero.mp4").write_bytes(b"")
    command = ["run", str(tmp_path / "zero.mp4"), "--calib", calibration(tmp_path)]
    assert "zero.mp4" in error_of(command, tmp_path, capsys)


def test_folder_without_images(tmp_path, capsys):
    (tmp_path / "bare").mkdir()
    assert "bare" in error_of(["run", str(tmp_path / "bare"), "--calib", calibration(tmp_path)], tmp_path, capsys)


def test_folder_whose_images_do_not_decode(image_folder, tmp_path, capsys):
    for file in image_folder.iterdir():
        file.write_bytes(b"not an image")
    command = ["run", str(image_folder), "--calib", calibration(tmp_path)]
    assert "decode" in error_of(command, tmp_path, capsys)


def test_times_of_another_length(image_folder, tmp_path, capsys):
    times = tmp_path / "short.txt"
    times.write_text("0.0\n0.1\n")
    command = ["run", str(image_folder), "--calib", calibration(tmp_path), "--times", str(times)]
    assert "short.txt" in error_of(command, tmp_path, capsys)


def test_groundtruth_that_is_none(image_folder, tmp_path, capsys):
    truth = tmp_path / "truth.txt"
    truth.write_text("hello world\n")
    command = ["run", str(image_folder), "--calib", calibration(tmp_path), "--groundtruth", str(truth)]
    assert "truth.txt" in error_of(command, tmp_path, capsys)


@pytest.mark.parametrize(
    "options",
    [
        ["--stride", "0"],
        ["--stride", "two"],
        ["--fps", "-3"],
        ["--fps", "3", "--times", "t.txt"],
        ["--device", "nonsense"],
        ["--seed", "-1"],
        ["--seed", str(2**63)],
        ["--no-such-option"],
    ],
    ids=" ".join,
)
def test_bad_options(image_folder, tmp_path, capsys, options):
    error_of(["run", str(image_folder), "--calib", calibration(tmp_path), *options], tmp_path, capsys)


@pytest.mark.parametrize("spelling", ["{}", "{}/../images", "{}/.."])
def test_results_among_the_images(image_folder, tmp_path, capsys, spelling):
    """Their pictures would be images of the sequence the next time."""
    clip = shutil.copytree(image_folder, tmp_path / "own" / "images")
    source = clip.parent if spelling.endswith("..") else clip
    line = ["run", str(source), "--calib", str(image_folder.parent / "calib.txt"), "--fps", "10"]
    assert main([*line, "--out", spelling.format(clip)]) == 2
    assert "among which the pictures of the results would be read" in capsys.readouterr().err
    assert sorted(clip.iterdir()) == sorted(clip / file.name for file in image_folder.iterdir())
    assert main([*line, "--out", str(clip / "results")]) == 0


def test_out_that_is_a_file(image_folder, tmp_path, capsys):
    (tmp_path / "taken").write_text("")
    command = ["run", str(image_folder), "--calib", calibration(tmp_path), "--out", str(tmp_path / "taken")]
    assert main(command) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "taken" in line


@pytest.mark.parametrize("command", [[], ["fly"], ["weights"], ["run"]], ids=str)
def test_incomplete_commands(command, capsys):
    assert main(command) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
