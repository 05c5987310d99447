"""Tests of the process that compiles kernels ahead."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from dvo.core import ahead
from dvo.core.ahead import Helper, brought, compiled_by

SLOW = """
import sys, threading, time
print("start a", flush=True); print("done a", flush=True)
print("start b", flush=True)
time.sleep(0.5)
print("done b", flush=True)
print("told", sys.stdin.readline().strip(), flush=True)
sys.stdin.read()
"""
STUCK = "import time; print('start a', flush=True); time.sleep(600)"
PARENT = """
import sys, time
from dvo.core.ahead import Helper
helper = Helper([sys.executable, "-c", "import os, sys; print('start', os.getpid(), flush=True); sys.stdin.read()"])
while not helper._said:
    time.sleep(0.01)
print(*helper._said, flush=True)
time.sleep(600)
"""


def started(program: str, name: str) -> Helper:
    """A helper that has said a name."""
    helper = Helper([sys.executable, "-c", program])
    end = time.monotonic() + 30
    while name not in helper._said and time.monotonic() < end:
        time.sleep(0.01)
    return helper


def is_alive(process: int) -> bool:
    """Tell if a process is there and no zombie."""
    try:
        with open(f"/proc/{process}/stat", encoding="ascii") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_waits_for_what_is_started_and_takes_over_what_is_not():
    helper = started(SLOW, "b")
    try:
        assert helper.brings("a") and helper.brings("b") and not helper.brings("c")
        end = time.monotonic() + 30
        while helper._said.get("c") != "told" and time.monotonic() < end:
            time.sleep(0.01)
        assert helper._said["c"] == "told"
    finally:
        helper.close()
    assert helper._process.poll() is not None
    assert not helper.brings("d")


def test_one_that_is_closed_is_told_nothing():
    helper = started(STUCK, "a")
    with helper._changed:  # the thread that listens does not see the end before the question
        helper.close()
        assert not helper.brings("b")


def test_one_that_does_not_run_is_given_up(monkeypatch):
    monkeypatch.setattr(ahead, "PATIENCE", 0.2)
    helper = started(STUCK, "a")
    try:
        assert not helper.brings("a")
        assert helper._process.wait(30) != 0
    finally:
        helper.close()


@pytest.mark.parametrize(
    "program", ["import sys; sys.exit(1)", "print('start a')", "import os; os.write(1, b'\\xff\\n x')"]
)
def test_one_that_fails_is_none(program):
    with compiled_by([sys.executable, "-c", program]):
        for name in ("a", "b"):
            assert not brought(name)
    assert not brought("a")


def test_one_that_cannot_be_started_is_none(monkeypatch):
    with compiled_by(["/no/such/program"]):
        assert not brought("a")

    def limited(*_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("threading.Thread.start", limited)
    with compiled_by([sys.executable, "-c", STUCK]):
        assert not brought("a")


def test_it_ends_with_its_parent_however_that_ends():
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        process = int(parent.stdout.readline())
        assert is_alive(process)
        parent.kill()
    end = time.monotonic() + 30
    while is_alive(process) and time.monotonic() < end:
        time.sleep(0.01)
    assert not is_alive(process) and os.getpid() != process
