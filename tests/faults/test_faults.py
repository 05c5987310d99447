"""Short forms of the trials."""

import sys

import pytest

from tests.faults import signals, soak, writers

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, forks")]


def test_writers(tmp_path):
    text, failed = writers.trial(tmp_path, 15.0)
    assert not failed, text


def test_signals(tmp_path):
    text, failed = signals.trial(tmp_path, 3, 0)
    assert not failed, text


def test_soak(tmp_path):
    text, failed = soak.trial(tmp_path, 0.0)
    assert "different trajectories: 1" in text and "files left: 0" in text, text
    assert not failed, text
