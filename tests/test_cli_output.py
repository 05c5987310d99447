"""Files and output of a run after failures of the system, and with several segments."""

from __future__ import annotations

import errno
import io
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import dvo
from dvo.cli import main
from dvo.commands.console import describe_status
from dvo.commands.report import advice_for_segments, describe_breaks
from dvo.data.trajectory import Trajectory, read_tum
from dvo.odometry.protocol import Break, Estimate, Result, Segment, SparseMap, Status
from tests.support.command_line import arguments, errors, names, summary

resource = pytest.importorskip("resource")


# -- failures of the system ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_a_folder_that_cannot_be_written_is_found_before_the_weights_load(
    given, image_folder, tmp_path, monkeypatch, capsys, code
):
    def fail(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    odometry = given()
    monkeypatch.setattr(os, "fsync", fail)
    assert main(arguments(image_folder, tmp_path / "out")) == 2
    assert not odometry.asked and not odometry.frames and not (tmp_path / "out").exists()
    (line,) = errors(capsys.readouterr().err)
    assert os.strerror(code) in line and str(tmp_path / "out") in line


@pytest.fixture
def small_files():
    """``small_files(size)`` lets no file grow beyond ``size`` bytes, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_disk_that_gets_full_midway(given, image_folder, tmp_path, capsys, small_files):
    """Tracking goes on with one warning; at the end one line, exit code 2, and what was written is there."""
    odometry = given(at_frame={6: lambda: small_files(700)})
    assert main(arguments(image_folder, tmp_path / "out")) == 2
    assert len(odometry.frames) == 20
    kept = read_tum(tmp_path / "out" / "trajectory.txt")
    assert 4 <= len(kept) < 10
    warning, error = errors(capsys.readouterr().err)
    assert "tracking goes on" in warning and "error: " in error and "trajectory.txt" in error
    assert not [name for name in names(tmp_path / "out") if name.startswith(".part-")]


def test_a_disk_that_is_full_at_the_end(given, image_folder, tmp_path, capsys, small_files):
    """Picture and page do not fit; everything else does, and says that it is not all."""
    given(plots=True, at_frame={19: lambda: small_files(8000)})
    assert main(arguments(image_folder, tmp_path / "out")) == 2
    (error,) = errors(capsys.readouterr().err)
    assert "trajectory.png" in error and "File too large" in error and "--out" in error
    assert names(tmp_path / "out") == ["frames.csv", "map.ply", "run.json", "trajectory.txt"]
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 20
    assert summary(tmp_path / "out")["finished"] is False


def test_no_file_handle_is_free_at_the_end(given, image_folder, tmp_path, capsys, monkeypatch):
    def none_left(path: Path) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE), str(path))

    given(at_frame={19: lambda: monkeypatch.setattr("dvo.session.results.replaced", none_left)})
    assert main(arguments(image_folder, tmp_path / "out")) == 2
    (error,) = errors(capsys.readouterr().err)
    assert "Too many open files" in error
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 20, "the rows written before stay"


def test_an_error_of_the_odometry_keeps_what_was_written(given, image_folder, tmp_path):
    """A bug still shows itself, but what was tracked is there."""

    def fail() -> None:
        raise ZeroDivisionError("a bug")

    given(at_frame={7: fail})
    with pytest.raises(ZeroDivisionError):
        main(arguments(image_folder, tmp_path / "out"))
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 7
    assert "ZeroDivisionError: a bug" in summary(tmp_path / "out")["warnings"][0]


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (OSError(errno.EIO, "Input/output error", "clip.mp4"), "dvo: error: clip.mp4: Input/output error."),
        (OSError("no number"), "dvo: error: no number."),
        (PermissionError(), "dvo: error: PermissionError."),
    ],
    ids=["file", "text", "bare"],
)
def test_every_error_of_the_system_is_one_line(monkeypatch, image_folder, tmp_path, capsys, error, expected):
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setitem(vars(dvo), "open", fail)
    assert main(arguments(image_folder, tmp_path / "out")) == 2
    assert errors(capsys.readouterr().err) == [expected]


class Unread(io.TextIOWrapper):
    """Text stream into a pipe whose reader has gone."""

    def __init__(self, *, write_through: bool) -> None:
        reader, writer = os.pipe()
        os.close(reader)
        super().__init__(os.fdopen(writer, "wb", 0 if write_through else -1), write_through=write_through)


@pytest.mark.parametrize("write_through", [False, True])
@pytest.mark.parametrize("both", [False, True])
@pytest.mark.parametrize("code", [0, 143])
def test_a_reader_that_closes_the_pipe(given, image_folder, tmp_path, monkeypatch, capsys, write_through, both, code):
    """``dvo run ... | true``, and with ``2>&1``: the results are there and the exit code is that of the run."""
    given(at_frame={9: lambda: os.kill(os.getpid(), signal.SIGTERM)} if code else {})
    (image_folder / "0003.png").write_bytes(b"not an image")  # a warning on stderr
    (image_folder.parent / "times.txt").unlink()  # another one, before tracking
    streams = [Unread(write_through=write_through) for _ in range(1 + both)]
    for name, stream in zip(("stdout", "stderr"), streams, strict=False):
        monkeypatch.setattr(sys, name, stream)
    line = ["run", str(image_folder), "--calib", str(image_folder.parent / "calib.txt"), "--out", str(tmp_path / "out")]
    assert main([*line, "--device", "cpu"]) == code
    for stream in streams:
        stream.close()  # as the interpreter does at its end
    monkeypatch.undo()
    assert not [line for line in errors(capsys.readouterr().err) if "error" in line or "ipe" in line]
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == (9 if code else 19)
    assert summary(tmp_path / "out")["finished"] is True


def python_m_dvo(repository: Path, *line: str, stdout: object) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    return subprocess.run(
        [sys.executable, "-m", "dvo", *line], stdout=stdout, stderr=subprocess.PIPE, text=True, cwd=repository,
        env=environment,
    )  # fmt: skip


def test_help_into_a_closed_pipe(repository):
    reader, writer = os.pipe()
    os.close(reader)
    done = python_m_dvo(repository, "--help", stdout=writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_stdout_on_a_full_disk(repository, given, image_folder, tmp_path, monkeypatch, capsys):
    with open("/dev/full", "w") as full:
        done = python_m_dvo(repository, "--help", stdout=full)
    assert (done.returncode, done.stderr) == (2, "dvo: error: standard output: No space left on device.\n")
    given()
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", open("/dev/full", "w"))  # noqa: SIM115
        assert main(arguments(image_folder, tmp_path / "out")) == 2
        sys.stdout.close()
    assert errors(capsys.readouterr().err) == ["dvo: error: standard output: No space left on device."]
    assert summary(tmp_path / "out")["finished"] is True


# -- segments and breaks -------------------------------------------------------------------------------------------


def test_breaks_and_segments_are_told(given, image_folder, tmp_path, capsys):
    given(lost=(5, 6, 7), new_segment=(6,))
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    out = capsys.readouterr().out
    assert "tracked 17 of 20 frames" in out
    assert "1 break: 10.40-10.80 s black image (3 frames), new segment at 10.80 s" in out.splitlines()
    assert "2 segments" in out and "trajectory-0.txt, trajectory-1.txt" in out
    written = summary(tmp_path / "out")
    assert written["frames"] == {"read": 20, "fed": 20, "tracked": 17, "lost": 3}
    assert [s["frames"] for s in written["segments"]] == [5, 12] and written["breaks"][0]["frames"] == 3
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == 12
    assert "ate_rmse" not in written["segments"][0]


def test_each_segment_is_compared_with_the_ground_truth(given, image_folder, tmp_path, capsys):
    """Every segment has a world and a scale of its own: aligned on its own it is exact, all together they are not."""
    given(new_segment=(8,))
    truth = str(image_folder.parent / "truth.txt")
    assert main(arguments(image_folder, tmp_path / "out", "--groundtruth", truth)) == 0
    written = summary(tmp_path / "out")
    assert [s["matched"] for s in written["segments"]] == [8, 12]
    assert max(s["ate_rmse"] for s in written["segments"]) < 1e-6
    assert written["metrics"]["matched"] == 12 and written["metrics"]["scale"] == pytest.approx(1.25, rel=1e-6)
    assert "of the longest segment" in capsys.readouterr().out


def test_a_run_with_one_segment_says_nothing_of_segments(given, image_folder, tmp_path, capsys):
    given()
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    said = capsys.readouterr().out
    assert " segment" not in said and "trajectory-" not in said and " break" not in said


def test_exit_code_1_only_if_no_segment_has_a_pose(given, image_folder, tmp_path, capsys):
    given(lost=tuple(range(19)), new_segment=(19,))
    assert main(arguments(image_folder, tmp_path / "a")) == 0
    given(lost=tuple(range(20)))
    assert main(arguments(image_folder, tmp_path / "b")) == 1
    assert "1 break: all of the time black image (20 frames)" in capsys.readouterr().out
    assert summary(tmp_path / "b")["segments"] == [] and summary(tmp_path / "b")["finished"] is True


def test_breaks_as_text():
    breaks = tuple(Break(float(k), k + 1.0, k, "white image", new_segment=k == 1) for k in range(1, 9))
    text = describe_breaks(breaks)
    assert text.startswith("8 breaks: 1.00-2.00 s white image (1 frame), new segment at 2.00 s; 2.00-3.00 s white")
    assert text.endswith("(5 frames); 3 more in run.json") and "\n" not in text
    ends = (Break(None, 0.5, 15, "noise", False), Break(7.0, None, 3, "black image", False))
    assert (
        describe_breaks(ends)
        == "2 breaks: until 0.50 s noise (15 frames); from 7.00 s to the end black image (3 frames)"
    )


@pytest.mark.parametrize(
    ("joined", "info", "told"),
    [((None, None), {"loops": []}, True), ((None, 0), {"loops": []}, False), ((None, None), {}, False),
     ((None,), {"loops": []}, False)],
)  # fmt: skip
def test_advice_for_segments_that_stay_apart(joined, info, told):
    rows = Trajectory(np.arange(3.0), np.tile([0, 0, 0, 0, 0, 0, 1.0], (3, 1)))
    parts = tuple(Segment(rows, 0.0, 2.0, joined_to=world) for world in joined)
    advice = advice_for_segments(Result(rows, SparseMap(), 6, 0, info, parts))
    assert ("overlap" in advice) == told and (told or not advice)


def test_a_short_clip_ends_as_tracked(given, image_folder, tmp_path, capsys):
    """Poses that only ``finish`` gives: the last state of the progress bar is the outcome."""
    odometry = given()
    track = odometry.track
    odometry.track = lambda frame: replace(track(frame), pose_wc=None, status=Status.INITIALISING)
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    shown = capsys.readouterr().err.splitlines()[-1]
    assert "20/20" in shown and "20 tracked" in shown and "initialising" not in shown


def test_status_as_text():
    lost = Estimate(0.0, None, Status.LOST, 0.0, 2, "black [image]")
    assert describe_status(lost) == r"lost: black \[image], segment 2"
    assert describe_status(Estimate(0.0, np.ones(7), Status.TRACKING)) == "tracking"


@pytest.mark.long
def test_the_picture_shows_segments_apart(given, image_folder, tmp_path):
    """Without ground truth a panel each, with it one panel in which every segment has its colour."""
    given(plots=True, new_segment=(6, 13))
    truth = str(image_folder.parent / "truth.txt")
    assert main(arguments(image_folder, tmp_path / "a")) == 0
    assert main(arguments(image_folder, tmp_path / "b", "--groundtruth", truth)) == 0
    for name in ("a", "b"):
        picture = cv2.imread(str(tmp_path / name / "trajectory.png"))[:, :, ::-1].astype(int)
        for colour in ([0xE4, 0x57, 0x2E], [0x8E, 0x4E, 0xC6], [0xB0, 0x89, 0x00]):
            assert (np.abs(picture - colour).max(axis=2) < 30).sum() > 300


def test_atomic_files_are_used_for_everything(given, image_folder, tmp_path, monkeypatch):
    """Every file of the folder takes its name by a replacement, so that no reader meets half of one."""
    moved: set[str] = set()
    move = os.replace
    monkeypatch.setattr(os, "replace", lambda a, b: (moved.add(Path(b).name), move(a, b))[1])
    given(new_segment=(6,))
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    assert moved == set(names(tmp_path / "out"))
