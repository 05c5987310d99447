"""Table of self-calibration against rendered cameras."""

import math
from dataclasses import replace

import pytest

from dvo.data.calibration.focal_guess import guess_from_angle
from dvo.odometry.calibration.camera_estimate import SELF_CALIBRATED, SelfCalibration
from eval.benchmarks.self_calibration import clip, errors, row

GUESS = guess_from_angle(320, 240)


def test_errors_are_in_deviations_of_what_was_told():
    found = SelfCalibration(200.0, 4.0, SELF_CALIBRATED, 320, 240, 60, "", GUESS, (3.0, 0.0), (0.5, math.inf))
    assert errors(found, 198.0, 162.0, 110.0) == pytest.approx([0.5, 1.0])
    assert row("hall 0", found, 198.0, 162.0, 110.0) == (
        "| hall 0 | 198.0 | 200.0 +- 4.0 | 162.0 | 162.5 +- 0.5 | 110.0 | \u2013 | \u2013 |"
    )
    bent = replace(found, bend=0.4, bend_deviation=0.02)
    assert row("hall 0", bent, 198.0, 162.0, 110.0, (0.1, 0.25)).endswith("| 0.40 +- 0.02 | 0.10, 0.25 |")
    kept = SelfCalibration(256.0, 64.0, "prior", 320, 240, 60, "the motion does not tell", GUESS)
    assert errors(kept, 198.0, 162.0, 110.0) == [] and "cannot tell" in row("a", kept, 198.0, 162.0, 110.0)


@pytest.mark.long
def test_clips_have_cameras_of_their_own():
    cameras = [next(iter(clip(number, 2))).camera for number in (0, 1, 4)]
    assert [camera.needs_undistortion for camera in cameras] == [False, False, True]
    assert cameras[0].fx != cameras[1].fx and cameras[0].cx != cameras[1].cx
