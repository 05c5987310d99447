"""Programs that end when their time is out, with whatever they have started, or with the process that starts them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_FOREVER = 1e9  # seconds
_BOUND = (
    "import ctypes, os, sys\n"
    "ctypes.CDLL(None).prctl(1, 9, 0, 0, 0)\n"  # PR_SET_PDEATHSIG, SIGKILL
    "if os.getppid() == int(sys.argv[1]): os.execvp(sys.argv[2], sys.argv[2:])"  # else it was too late
)
_running: set[subprocess.Popen[bytes]] = set()
_lock = threading.RLock()  # a handler of a signal may take it while its thread has it
_closed = threading.Event()
_ended = threading.Event()


class StoppedError(Exception):
    """The program was not started, or was ended, together with all others, for no fault of its own."""


@dataclass(frozen=True)
class Ending:
    """End of a program.

    Attributes:
        code: exit code, minus the number of the signal that killed it; None if the time ran out.
        last_line: of its output.
    """

    code: int | None
    last_line: str

    def __str__(self) -> str:
        if self.code is None:
            return "out of time"
        how = f"killed by {signal.Signals(-self.code).name}" if self.code < 0 else f"exit {self.code}"
        return f"{how} {self.last_line}".strip()


def run_limited(command: list[str], environment: dict[str, str], seconds: float | None, log: Path) -> Ending:
    """Run a program; what it writes goes to ``log``. When the time is out it ends with all that it has started.

    Args:
        command: program and arguments.
        environment: variables of the program.
        seconds: time limit; None for none.
        log: file for its output, to which it is appended.

    Returns:
        Exit code and last line of output.

    Raises:
        StoppedError: :func:`end_all` or, before it was started, :func:`close` was called.
    """
    with _lock, open(log, "ab") as file:
        if _closed.is_set():
            raise StoppedError
        process = subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True
        )
        _running.add(process)
    try:
        # With a limit Python looks every 50 ms, so that an exception from another thread, as Ray's, arrives.
        code: int | None = process.wait(_FOREVER if seconds is None else seconds)
    except subprocess.TimeoutExpired:
        code = None
    finally:
        _end(process)
        with _lock:
            _running.discard(process)
    if _ended.is_set():
        raise StoppedError
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return Ending(code, lines[-1] if lines else "")


def close(number: int) -> None:
    """Send a signal to every program that :func:`run_limited` waits for, and start no more until :func:`begin`.

    Args:
        number: of a signal that the programs handle; those that they have started are not told.
    """
    _closed.set()
    with _lock:
        for process in _running:
            process.send_signal(number)


def end_all() -> None:
    """End every program that :func:`run_limited` waits for, and start no more until :func:`begin`."""
    _closed.set()
    _ended.set()
    with _lock:
        for process in _running:
            _end(process)


def begin() -> None:
    """Programs may run (again)."""
    _closed.clear()
    _ended.clear()


def bound(command: Sequence[str]) -> list[str]:
    """Command of a program that ends when the thread which starts it is gone, even if that is killed (Linux).

    A process between asks the kernel for it, and becomes the program. Elsewhere it is the same command.

    Args:
        command: program and arguments.
    """
    before = [sys.executable, "-I", "-S", "-c", _BOUND, str(os.getpid())] if sys.platform == "linux" else []
    return [*before, *command]


def die_with_parent() -> None:
    """End this process of :mod:`multiprocessing` at once when the one that has started it is gone, even if killed."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)  # a thread cannot end the process in another way

    threading.Thread(target=watch, daemon=True).start()


def stop_with_parent(parent: int) -> None:
    """Send SIGTERM to this process within a second after its parent has died, from a thread that watches.

    That of the kernel comes several times, once for each thread of the parent, and a second one aborts a run.

    Args:
        parent: process number.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill a process with its session; a child that it left behind may outlive it, so also when it is done."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        process.poll()
    else:
        process.wait()
