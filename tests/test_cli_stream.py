"""``dvo run`` on a camera and on a pipe."""

from __future__ import annotations

import io
import os
import signal
import threading
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dvo.cli import main
from dvo.data.trajectory import read_tum
from tests.support.command_line import errors, summary
from tests.support.stand_in_camera import StandInCamera

COMMON = ["--device", "cpu"]


@pytest.fixture
def calib(tmp_path):
    (tmp_path / "calib.txt").write_text("50 50 31.5 23.5\n")
    return str(tmp_path / "calib.txt")


def images(count):
    draw = np.random.default_rng(0)
    return [draw.integers(0, 256, (48, 64, 3), dtype=np.uint8) for _ in range(count)]


@pytest.fixture
def piped(monkeypatch):
    data = b"".join(cv2.imencode(".jpg", image)[1].tobytes() for image in images(20))
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(data)))


def test_a_pipe(given, piped, calib, tmp_path, capsys):
    given()
    assert main(["run", "-", "--fps", "10", "--calib", calib, "--out", str(tmp_path / "out"), *COMMON]) == 0
    assert np.allclose(read_tum(tmp_path / "out" / "trajectory.txt").timestamps, 0.1 * np.arange(20))
    written = summary(tmp_path / "out")
    assert written["live"] == {"received": 20, "dropped": 0} and written["frames"]["tracked"] == 20
    assert written["clock"] == {"times": "fps", "to_unix": None} and written["source"] == "-"
    said = capsys.readouterr()
    assert "received 20 frames, dropped 0 of them" in said.out and errors(said.err) == []


class HangingCamera(StandInCamera):
    """Sends an image, 499 more when ``go`` is set, and then nothing until ``wake`` is set."""

    def __init__(self, *_):
        self.pictures = images(4)

    def grab(self):
        super().grab()
        if self.index in (1, 500):
            (self.go if self.index == 1 else self.wake).wait(20)
        return True

    def retrieve(self):
        return True, self.pictures[self.index % 4].copy()


def test_ctrl_c_ends_a_camera_that_sends_nothing_more(given, monkeypatch, calib, tmp_path, capsys):
    """The main thread waits for an image when the signal comes; results are written, and dropped frames counted."""
    camera = type("Camera", (HangingCamera,), {"go": threading.Event(), "wake": threading.Event()})
    monkeypatch.setattr(cv2, "VideoCapture", camera)
    monkeypatch.setattr("dvo.data.streams.live.JOIN_TIMEOUT", 0.01)  # the camera hangs

    def at_first():
        camera.go.set()
        (reader,) = (thread for thread in threading.enumerate() if thread.name.startswith("dvo stream"))
        reader.join(0.5)  # does not end: time for the other 499

    def at_last():
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()

    given(at_frame={0: at_first, 499: at_last})
    assert main(["run", "webcam:0", "--calib", calib, "--out", str(tmp_path / "out"), *COMMON]) == 130
    camera.wake.set()
    written = summary(tmp_path / "out")
    live, frames = written["live"], written["frames"]
    assert live["received"] == 500 == live["dropped"] + frames["fed"] and frames["tracked"] == frames["fed"] >= 2
    assert written["finished"] is True and written["interrupted"] is True and written["clock"]["times"] == "arrival"
    assert len(read_tum(tmp_path / "out" / "trajectory.txt")) == frames["fed"]
    said = capsys.readouterr()
    assert f"received 500 frames, dropped {live['dropped']} of them" in said.out
    assert "the stream is faster than tracking" in said.err and f"interrupted after {frames['fed']} frames" in said.err


def test_no_camera_is_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(HangingCamera, "isOpened", lambda self: False)
    monkeypatch.setattr(cv2, "VideoCapture", HangingCamera)
    assert main(["run", "webcam:0", "--out", str(tmp_path / "out")]) == 2
    (line,) = errors(capsys.readouterr().err)
    assert line.startswith("dvo: error: webcam:0: no camera of number 0 can be opened.")
    assert not (tmp_path / "out").exists()


def test_a_queue_is_for_streams(tmp_path, image_folder, capsys):
    assert main(["run", str(image_folder), "--queue", "2"]) == 2
    assert "queue: frames of a recording do not wait" in capsys.readouterr().err
    assert main(["run", "-", "--queue", "-1"]) == 2
    assert "must be 0 to 100000" in capsys.readouterr().err
