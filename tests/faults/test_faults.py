"""Short forms of the trials."""

import re
import sys

import pytest

from tests.faults import signals, soak, writers

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, forks")]


def test_writers(tmp_path):
    text, failed = writers.trial(tmp_path, 5.0)
    assert not failed, text


def test_signals(tmp_path):
    text, failed = signals.trial(tmp_path, 3, 0)
    assert not failed, text


def test_soak(tmp_path):
    text, _ = soak.trial(tmp_path, 0.0)  # too short for a verdict on the memory
    assert "different trajectories: 1\n" in text and text.endswith("files left: 0"), text
    assert re.search(r"descriptors: (\d+), \1\n", text) and re.search(r"threads: (\d+), \1\n", text), text
