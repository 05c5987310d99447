"""Programs with a time limit."""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from dvo.core.processes import StoppedError, begin, close, run_limited


@pytest.mark.long
def test_time_limit_ends_the_children_too(tmp_path):
    begin()
    script = f"sleep 600 & echo $! > {tmp_path / 'child'}; echo before the end; wait"
    ending = run_limited(["sh", "-c", script], dict(os.environ), 1.5, tmp_path / "log.txt")
    assert ending.code is None and ending.last_line == "before the end"
    with pytest.raises(ProcessLookupError):
        for _ in range(200):
            os.kill(int((tmp_path / "child").read_text()), 0)
            time.sleep(0.05)


def test_a_closed_room_tells_those_that_run_and_starts_no_more(tmp_path):
    begin()
    script = f"trap 'echo told; exit 3' TERM; echo > {tmp_path / 'ready'}; while true; do sleep 0.05; done"
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(run_limited, ["sh", "-c", script], dict(os.environ), None, tmp_path / "log.txt")
        while not (tmp_path / "ready").exists():
            time.sleep(0.01)
        close(signal.SIGTERM)
        ending = running.result()
    assert (ending.code, ending.last_line) == (3, "told")
    with pytest.raises(StoppedError):
        run_limited(["sh", "-c", f"echo > {tmp_path / 'second'}"], dict(os.environ), None, tmp_path / "log.txt")
    assert not (tmp_path / "second").exists()
    begin()
    assert run_limited(["sh", "-c", "exit 4"], dict(os.environ), None, tmp_path / "log.txt").code == 4
