"""Programs with a time limit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from dvo.core.processes import StoppedError, begin, bound, close, run_limited


def is_alive(process: int) -> bool:
    """Of a process whose parent may not ask for its end."""
    try:
        os.kill(process, 0)
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False


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


SLEEP = "bound(['sh', '-c', 'echo $$ > $0; exec sleep 600', {file!r}])"
PARENTS = {
    "a program": f"import subprocess; subprocess.run({SLEEP})",
    "a limited one": "from pathlib import Path; import os; "
    f"run_limited({SLEEP}, dict(os.environ), None, Path({{file!r}} + '.log'))",
    "a fresh process": "from eval.execution.fresh_processes import in_fresh_processes; from tests.core.test_processes"
    " import sleeping; list(in_fresh_processes(sleeping, [{file!r}]))",
}


def sleeping(file: str) -> None:
    Path(file).write_text(f"{os.getpid()}\n")
    time.sleep(600)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel of Linux is asked")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("case", PARENTS)
def test_a_program_ends_with_the_process_that_has_started_it(tmp_path, case, number):
    file = tmp_path / "child"
    script = f"from dvo.core.processes import bound, run_limited; {PARENTS[case].format(file=str(file))}"
    parent = subprocess.Popen([sys.executable, "-c", script], cwd=Path(__file__).parents[2])
    try:
        while not (file.is_file() and file.read_text().endswith("\n")):
            assert parent.poll() is None
            time.sleep(0.02)
        child = int(file.read_text())
        assert is_alive(child)
    finally:
        parent.send_signal(number)
        parent.wait()
    while is_alive(child):
        time.sleep(0.02)


def test_a_program_that_is_bound_is_itself(tmp_path):
    done = subprocess.run(bound(["sh", "-c", "echo $$ $1; exit 3", "sh", "a b"]), capture_output=True, text=True)
    assert (done.returncode, done.stdout.split(maxsplit=1)[1]) == (3, "a b\n")
