"""The fuzzer fails when a reader is broken, and goes on after it."""

from __future__ import annotations

import multiprocessing
import resource
from functools import partial
from pathlib import Path

import pytest

from tests.fuzz import __main__ as program
from tests.fuzz import worker
from tests.fuzz.broken_readers import READERS
from tests.fuzz.worker import Limits, Outcome, run_cases

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="the limits need Linux")
RESIDENT = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def run(folder, *names, seeds=(-1, 0), seconds=1.0, resident=None) -> dict[tuple[str, int], Outcome]:
    cases = [(READERS[name], seed) for name in names for seed in seeds]
    limits = Limits(seconds, resident or 10**10)
    return {(outcome.target, outcome.seed): outcome for outcome in run_cases(cases, folder, jobs=2, limits=limits)}


@pytest.mark.long
def test_refused_and_accepted(tmp_path):
    found = run(tmp_path, "good", "accepting", seeds=(-1, 0, 1, 2))
    assert [found["good", seed].verdict for seed in (-1, 0, 1, 2)] == ["accepted"] + ["refused"] * 3
    assert {found["accepting", seed].verdict for seed in (-1, 0, 1, 2)} == {"accepted"}
    assert found["good", 0].mutation and "malformed" in found["good", 0].reason
    assert not list(tmp_path.glob("case*"))  # inputs are removed


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("key_error", "KeyError: 'missing'"),
        ("hang", "hang: more than 1 s"),
        ("loop", "hang: more than 1 s"),
        ("crash", "crash: SIGABRT"),
        ("leave", "SystemExit: 0"),
        ("die", "exit: code 3"),
        ("wrong_truth", "WrongResult: quaternions"),
    ],
)
def test_a_broken_reader_is_a_failure_and_the_next_case_runs(tmp_path, name, reason):
    found = run(tmp_path, name, "good")
    assert found[name, -1].verdict == "accepted"
    assert found[name, 0].verdict == "failed" and reason in found[name, 0].reason
    assert found["good", 0].verdict == "refused"


def resident_now():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def test_memory_is_bounded(tmp_path):
    with multiprocessing.get_context("fork").Pool(1) as pool:  # a fork has not all pages of files of its parent
        current = pool.apply(resident_now)
    found = run(tmp_path, "memory", "good", seconds=30.0, resident=current + 200 * 10**6)
    assert found["memory", 0].verdict == "failed" and found["memory", 0].reason.startswith("memory: ")
    assert found["good", 0].verdict == "refused"


@pytest.mark.long
def test_a_refused_valid_input_and_a_failure_end_with_code_1(tmp_path, monkeypatch, capsys):
    # The limit is for the program in a process of its own; here its children begin with the memory of all tests so far.
    monkeypatch.setattr(worker, "Limits", partial(Limits, resident=10**10))

    def code(*names, arguments=("--cases", "4", "--jobs", "1")):
        monkeypatch.setattr(program, "all_targets", lambda: [READERS[name] for name in names])
        return program.main(list(arguments)), capsys.readouterr().out

    assert code("good", "accepting")[0] == 0
    result, table = code("good", "key_error")
    assert result == 1 and "failed key_error:1" in table
    rows = {line.split()[0]: line.split()[1:] for line in table.splitlines() if line.split()[1:2] > ["0"]}
    assert rows["good"] == ["2", "2", "0", "0"]
    assert rows["key_error"] == ["2", "0", "0", "2"]
    assert rows["total"] == ["4", "2", "0", "2"]
    result, table = code("good", "refusing")
    assert result == 1 and "valid input refused" in table
    result, table = code("good", "key_error", arguments=("--case", "key_error:1"))
    assert result == 1 and "in key_error" in table and "Traceback" in table
