"""Programs with a time limit."""

from __future__ import annotations

import os
import time

import pytest

from dvo.core.processes import begin, run_limited


def test_time_limit_ends_the_children_too(tmp_path):
    begin()
    script = f"sleep 600 & echo $! > {tmp_path / 'child'}; echo before the end; wait"
    ending = run_limited(["sh", "-c", script], dict(os.environ), 1.5, tmp_path / "log.txt")
    assert ending.code is None and ending.last_line == "before the end"
    with pytest.raises(ProcessLookupError):
        for _ in range(200):
            os.kill(int((tmp_path / "child").read_text()), 0)
            time.sleep(0.05)
