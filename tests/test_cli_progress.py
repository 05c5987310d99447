"""What is printed while a command works, and where its time went."""

import time

import numpy as np
import pytest

from dvo.cli import main
from dvo.commands.console import TrackingProgress, spoken_time
from dvo.commands.report import describe_seconds
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.odometry.protocol import Estimate, Status
from tests.support.command_line import arguments

FRAME = Frame(0, 0.0, np.zeros((48, 64, 3), np.uint8), Camera(50.0, 50.0, 31.5, 23.5, 64, 48))


@pytest.mark.parametrize(
    ("seconds", "line"),
    [
        ({"calibrating": 61.2, "reading": 7.0, "tracking": 22.4, "finishing": 5.6},
         "96 s: calibration 61, reading 7, tracking 22, final 6"),
        ({"reading": 0.01, "tracking": 1.5, "finishing": 0.3}, "1.8 s: tracking 1.5, final 0.3"),
        ({"checking": 12.0, "tracking": 30.0}, "42 s: tracking 30, check 12"),
        ({}, "0.0 s"),
    ],
)  # fmt: skip
def test_the_last_line(seconds, line):
    assert describe_seconds(seconds) == line


def test_phases_and_totals():
    progress = TrackingProgress(40)
    assert progress.line.startswith("tracking, ") and "so far" in progress.line
    for _ in range(10):
        progress.update(FRAME, Estimate(0.0, None, Status.LOST, reason="black image"))
    assert progress.line.startswith("tracking, 10 of 40 frames, ") and progress.line.endswith("s left")
    progress.begin_round(2, 5, 60)
    progress.update(FRAME, None)
    assert progress.line.startswith("calibrating, round 2 of at most 5, 1 of 60 frames, ")
    for _ in range(60):
        progress.update(FRAME, None)
    assert progress.line.startswith("calibrating, round 2 of at most 5, 61 frames, ") and "left" not in progress.line
    progress.name("adjusting")
    assert progress.line == "adjusting, 0 s so far"


def test_plain_lines_without_a_terminal(given, image_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("dvo.commands.console.PLAIN_INTERVAL", 0.05)
    given(at_frame={k: lambda: time.sleep(0.1) for k in range(5, 9)})
    assert main(arguments(image_folder, tmp_path / "out")) == 0
    said = capsys.readouterr()
    lines = [line for line in said.err.splitlines() if line.startswith("dvo: progress: tracking, ")]
    assert lines and any("of 20 frames" in line and "s left" in line for line in lines)
    assert any(" s: " in line or line.endswith(" s") for line in said.out.splitlines()[-2:])


def test_the_rounds_of_a_calibration_are_told(monkeypatch):
    """The first one before its first frame."""
    import dvo
    from tests.support.tiny_tracker import frames

    rounds = []
    dvo.calibrate(frames(6), on_round=lambda *numbers: rounds.append(numbers))
    assert rounds[0][:2] == (1, 5) or rounds[0][0] == 1
    assert [number for number, _, _ in rounds] == list(range(1, len(rounds) + 1)) and 0 < rounds[0][2] <= 300


@pytest.mark.parametrize(
    ("total", "second", "told"),
    [(9000, 0.08, "about 12 min for 9,000 frames"), (700, 0.08, ""), (None, 5.0, ""), (20, 5.0, "")],
)
def test_a_long_run_is_told_in_advance(total, second, told, monkeypatch, capsys):
    """Once, after the first frames, of which the very first one is not typical; nothing of a short or endless one."""
    clock = [0.0]
    monkeypatch.setattr("dvo.commands.console.time.perf_counter", lambda: clock[0])
    progress = TrackingProgress(total)
    for number in range(min(total or 100, 100)):
        clock[0] += 40.0 if number == 0 else second
        progress.update(FRAME, None)
    lines = [line for line in capsys.readouterr().err.splitlines() if "about" in line]
    assert lines == ([f"dvo: note: {told}"] if told else [])


@pytest.mark.parametrize(("seconds", "text"), [(61, "1 min"), (7140, "119 min"), (12000, "3 h 20 min")])
def test_time_in_words(seconds, text):
    assert spoken_time(seconds) == text
