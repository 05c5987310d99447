"""Calibration from images with a stand-in for the odometry and for the estimate of the focal length."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import create_autospec

from dvo.odometry.calibration import calibrate
from dvo.odometry.global_ba.rolling_shutter import Shutter
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.tracker import PatchOdometry


def replace_tracking(monkeypatch, track, profile, members=lambda: 60):
    """Replace what :func:`dvo.calibrate` tracks and measures with.

    Args:
        monkeypatch: of the test.
        track: called with each frame that is tracked, in place of the method of the odometry.
        profile: called without arguments after each round, gives the profile of the focal length.
        members: called without arguments after each round, gives the number of frames of the segment.
    """
    odometry = create_autospec(PatchOdometry, instance=True)
    odometry.track.side_effect = track
    odometry.state = SimpleNamespace(adjustable=[0], info={}, shutter=Shutter(0.0, 36.0))
    odometry.config = TrackerConfig()
    monkeypatch.setattr(calibrate, "load", lambda *_, **__: odometry)
    monkeypatch.setattr(calibrate, "closed_graph", lambda _: SimpleNamespace(members=lambda segment: range(members())))
    monkeypatch.setattr(calibrate, "adjust_segments", lambda *_: {"readout": 0.0})
    monkeypatch.setattr(calibrate, "find_focal", lambda *_, **__: profile())
