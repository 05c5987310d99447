"""Interruptions that frames tell of, through every odometry."""

from __future__ import annotations

from dataclasses import replace

import pytest

import dvo
from dvo.odometry.load import build_odometry
from tests.support.tiny_members import MEMBERS, SETTINGS, frames, network


@pytest.mark.long
@pytest.mark.parametrize("name", [*MEMBERS, "klt-pnp"])
def test_a_clock_that_was_set_back_is_one_break_with_its_reason(name):
    """Ten seconds back in the middle; every frame after it is tracked."""
    learned = name in MEMBERS
    odometry = build_odometry(network(name), seed=1, **SETTINGS.get(name, {})) if learned else dvo.load(name)
    images = [replace(f, timestamp=f.timestamp + (20.0 if f.index < 7 else 10.0)) for f in frames(0, count=14)]
    done = dvo.run(odometry, dvo.stream(images))
    assert done.frames_fed == done.result.frames_read == 14
    told = [one for one in done.result.breaks if one.start is not None and one.start < 20.65 <= one.end]
    assert [one.reason for one in told] == ["clock set back by 9.90 s"], done.result.breaks
