"""Positions of a satellite receiver."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvo.data.positions import Positions


def positions(degrees: np.ndarray, times: np.ndarray, has_fix: np.ndarray | None = None) -> Positions:
    fix = np.ones(len(times), bool) if has_fix is None else has_fix
    states = tuple("3D" if state else "none" for state in fix)
    return Positions(times, degrees, np.full(len(times), 20.0), fix, states, np.full(len(times), 1.5), "DOP", "here")


@given(st.floats(-80, 80), st.floats(-180, 180), st.floats(-300, 300), st.floats(-300, 300))
def test_metres_are_those_of_the_great_circle(latitude, longitude, north, east):
    """Against the haversine formula."""
    radius = 6_371_008.8 + 20
    there = latitude + np.degrees(north / radius)
    across = longitude + np.degrees(east / radius / np.cos(np.radians(latitude)))
    across = (across + 180) % 360 - 180
    found = positions(np.array([[latitude, longitude], [there, across]]), np.arange(2.0)).metres()[1]
    a, b = np.radians([latitude, there])
    half = np.sin((b - a) / 2) ** 2 + np.cos(a) * np.cos(b) * np.sin(np.radians(across - longitude) / 2) ** 2
    assert np.hypot(*found[:2]) == pytest.approx(2 * radius * np.arcsin(np.sqrt(half)), abs=0.2)
    assert found[:2] == pytest.approx([east, north], abs=1e-3)


@pytest.mark.parametrize("noise", [0.0, 1e-6])
def test_the_length_of_the_way_is_not_that_of_the_noise(noise):
    """Eighteen positions a second, each a decimetre off, along 100 m to the north."""
    times = np.arange(361) / 18
    degrees = np.column_stack([np.degrees(5 * times / 6_371_028.8), np.full(361, 7.0)])
    degrees += np.random.default_rng(0).normal(0, noise, degrees.shape)
    facts = positions(degrees, times).summary()
    assert facts["length"] == pytest.approx(100, abs=0.3) and facts["with_fix"] == 361


def test_positions_without_a_fix_are_left_out():
    has_fix = np.array([False, True, True, False])
    found = positions(np.array([[0, 0], [1, 1], [1.00001, 1], [5, 5.0]]), np.arange(4.0), has_fix)
    facts = found.summary()
    assert (facts["count"], facts["with_fix"], facts["fix"]) == (4, 2, {"3D": 2, "none": 2})
    assert facts["length"] == pytest.approx(1.112, abs=1e-3)
    assert "2 with a fix, 1.112 m of way, median precision 1.5 DOP" in found.describe()
    empty = positions(np.zeros((2, 2)), np.arange(2.0), np.zeros(2, bool))
    assert empty.summary()["length"] is None and empty.metres().shape == (0, 3)
