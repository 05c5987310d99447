"""Verdict of a finished sequence, with measures and a profile of the focal length that are given."""

from __future__ import annotations

import pytest

from dvo.odometry.global_ba.focal_length import FocalProfile
from dvo.odometry.global_ba.self_calibration import Minimum
from dvo.odometry.patch import finishing
from dvo.odometry.quality import Quality, leaves_doubt
from tests.support.tiny_tracker import frames, tracker

SURE = Quality("good", tracked=1.0, agreement=1.0, deviation=0.0, check=1.0, checks=9)


@pytest.mark.parametrize(
    ("step", "contrast", "bend", "verdict"),
    [(0.0, 0.1, 0.0, "good"), (0.0, 0.1, 0.4, "doubtful"), (0.3, 0.1, 0.0, "doubtful"), (0.3, 0.0, 0.0, "good")],
)
def test_a_result_without_any_doubt_is_asked_for_its_camera(
    step: float, contrast: float, bend: float, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    profile = FocalProfile(Minimum(step, 0.01, 0.1), contrast, bend=Minimum(bend, 0.02, 0.1))
    monkeypatch.setattr(finishing, "measure_quality", lambda *_, **__: SURE)
    monkeypatch.setattr(finishing, "find_focal", lambda *_, **__: profile)
    odometry = tracker()
    for frame in frames(8):
        odometry.track(frame)
    found = odometry.finish().quality
    assert not leaves_doubt(SURE) and found is not None
    assert found.verdict == verdict and bool(found.reason) == (verdict == "doubtful")
