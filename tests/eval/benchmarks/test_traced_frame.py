"""Files whose code runs while a frame is tracked."""

import sys
from pathlib import Path

import torch

from dvo.geometry import se3
from eval.benchmarks.traced_frame import Traced
from tests.support.tiny_tracker import frames, tracker


def test_it_notes_the_functions_of_the_library_alone():
    with Traced() as traced:
        se3.exp(torch.zeros(6))
        sorted([3, 1], key=lambda value: -value)
    assert sys.getprofile() is None
    assert Path("geometry/se3.py") in traced.functions and "exp" in traced.functions[Path("geometry/se3.py")]
    assert {file.parts[0] for file in traced.functions} == {"geometry"}


def test_a_frame_of_a_tracker():
    odometry, (*before, last) = tracker(), frames(8)
    for frame in before:
        odometry.track(frame)
    with Traced() as traced:
        odometry.track(last)
    found = {file.as_posix() for file in traced.functions}
    assert {"odometry/patch/tracker.py", "odometry/window/patch_window.py", "models/step.py"} <= found
    assert not any(file.startswith(("cli", "commands", "synth", "odometry/droid")) for file in found)
