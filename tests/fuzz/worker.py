"""Cases run in processes of their own, forked from this one, in which everything is imported already.

A process that exceeds its limits is killed; the case counts as failed, and the next one gets a new process.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import importlib
import json
import os
import resource
import selectors
import shutil
import signal
import sys
import time
import traceback
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from dvo.core.errors import DvoError
from tests.fuzz.target import CleanExit, Target

Verdict = Literal["refused", "accepted", "failed"]
TICK = 0.02  # seconds between two looks at the running processes


@dataclass(frozen=True)
class Limits:
    """Bounds of one case.

    Attributes:
        seconds: of processor time, or of waiting without using the processor.
        resident: largest resident memory of the process, bytes, imported modules included.
    """

    seconds: float = 10.0
    resident: int = 2 * 10**9


@dataclass(frozen=True)
class Outcome:
    """Result of a case.

    Attributes:
        target: name of the reader.
        seed: of the mutation; -1 for the valid input.
        verdict: ``failed`` for another exception, a hang, much memory, a crash or a wrong result.
        reason: error in one line.
        mutation: change of the input.
        seconds: processor time.
        resident: largest resident memory, bytes.
        trace: traceback of a failure.
    """

    target: str
    seed: int
    verdict: Verdict
    reason: str = ""
    mutation: str = ""
    seconds: float = 0.0
    resident: int = 0
    trace: str = ""


@dataclass
class _Process:
    pid: int
    target: Target
    seed: int
    folder: Path
    begin: float
    pipe: int
    said: bytes = b""
    killed: str = ""
    used: float = 0.0  # seconds of the processor
    active: float = 0.0  # when these grew last


def warm(targets: Iterable[Target]) -> None:
    """Import what the targets need, once for all cases.

    Args:
        targets: to be run.
    """
    import cv2

    cv2.setNumThreads(1)  # a pool of threads does not survive a fork
    for module in sorted({module for target in targets for module in target.modules}):
        importlib.import_module(module)
    if "torch" in sys.modules:
        importlib.import_module("torch").set_num_threads(1)
    gc.collect()
    gc.freeze()  # a collection in a child would copy every page of the parent


def run_cases(
    cases: Iterable[tuple[Target, int]], folder: Path, *, jobs: int = 1, limits: Limits | None = None
) -> Iterator[Outcome]:
    """Run cases, in the order in which they end.

    Args:
        cases: targets with the seeds of mutations; -1 leaves the input valid.
        folder: empty; receives the valid inputs, and the input of each case while it runs.
        jobs: processes at a time.
        limits: of each case.

    Yields:
        An outcome for each case.
    """
    limits = limits or Limits()
    waiting, running = iter(cases), {}  # type: tuple[Iterator[tuple[Target, int]], dict[int, _Process]]
    selector, number, more = selectors.DefaultSelector(), 0, True
    try:
        while more or running:
            while more and len(running) < jobs:
                case = next(waiting, None)
                if case is None:
                    more = False
                    break
                number += 1
                template = _template(case[0], folder)
                process = _start(*case, template, folder / f"case{number}", limits)
                running[process.pid] = process
                selector.register(process.pipe, selectors.EVENT_READ, process)
            for key, _ in selector.select(TICK):
                process = key.data
                part = os.read(process.pipe, 1 << 16)
                process.said += part
                if not part:
                    selector.unregister(process.pipe)
                    del running[process.pid]
                    yield _end(process, limits)
            for process in running.values():
                if not process.killed and (reason := _excess(process, limits)):
                    process.killed = reason
                    _kill(process)
    finally:
        for process in running.values():
            _kill(process)
            os.waitpid(process.pid, 0)
            os.close(process.pipe)
        selector.close()


def _template(target: Target, folder: Path) -> Path:
    """Folder of the valid input of a target, written when it is first needed."""
    place = folder / f"valid_{target.name}"
    if not place.is_dir():
        place.mkdir(parents=True)
        target.build(place)
    return place


def _start(target: Target, seed: int, template: Path, folder: Path, limits: Limits) -> _Process:
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reading)
        _child(target, seed, template, folder, writing, limits)
    os.close(writing)
    return _Process(pid, target, seed, folder, time.monotonic(), reading)


def _child(target: Target, seed: int, template: Path, folder: Path, pipe: int, limits: Limits) -> None:
    """Run one case and say its outcome; never returns."""
    os.setpgid(0, 0)
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    faulthandler.disable()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # Far above the limit of resident memory: a stop for what is faster than the looks of the parent.
    data = 4 * limits.resident
    resource.setrlimit(resource.RLIMIT_DATA, (data, data))
    os.environ["DVO_CACHE"] = str(folder.parent / "cache")
    np.seterr(all="ignore")
    said = {"verdict": "accepted", "reason": "", "mutation": "", "trace": ""}
    try:
        shutil.copytree(template, folder, symlinks=True)
        os.chdir(folder)
        random = np.random.default_rng([zlib.crc32(target.name.encode()), seed + 1])
        said["mutation"] = _mutated(target, folder, random) if seed >= 0 else "none"
        os.write(pipe, json.dumps({"mutation": said["mutation"]}).encode() + b"\n")  # known even if it is killed
        target.read(folder, random if seed >= 0 else None)
    except (DvoError, CleanExit) as error:
        said |= {"verdict": "refused", "reason": str(error)}
    except BaseException as error:  # noqa: B036 (an exit or an interrupt by a reader is a failure too)
        trace = traceback.format_exc(limit=-12)
        said |= {"verdict": "failed", "reason": f"{type(error).__name__}: {error}"[:500], "trace": trace[-6000:]}
    with open(pipe, "wb") as out:
        out.write(json.dumps(said).encode() + b"\n")
    os._exit(0)


def _mutated(target: Target, folder: Path, random: np.random.Generator) -> str:
    try:
        return target.mutate(folder, random)
    except Exception as error:
        raise RuntimeError(f"the mutation itself failed: {error!r}") from error


def _excess(process: _Process, limits: Limits) -> str:
    """Reason to kill a running process, or nothing."""
    try:
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    state, used = fields[0], (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    resident = int(fields[21]) * resource.getpagesize()
    now = time.monotonic()
    if used > process.used:
        process.used, process.active = used, now
    if resident > limits.resident:
        return "memory"
    # On a busy machine a process may wait long for its turn, then its state is R, or for the disk, between two turns.
    idle = now - max(process.active, process.begin) > limits.seconds and state in "SDT"
    if used > limits.seconds or idle or now - process.begin > 12 * limits.seconds:
        return "hang"
    return ""


def _kill(process: _Process) -> None:
    for kill in (os.killpg, os.kill):
        try:
            kill(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            continue


def _end(process: _Process, limits: Limits) -> Outcome:
    os.close(process.pipe)
    _, status, usage = os.wait4(process.pid, 0)
    shutil.rmtree(process.folder, ignore_errors=True)
    seconds, resident = usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024
    name, seed = process.target.name, process.seed
    said = {"reason": "", "mutation": "", "trace": ""}
    for text in process.said.splitlines():
        with contextlib.suppress(ValueError):  # cut, because the process was killed
            said |= json.loads(text)
    if "verdict" not in said:
        said["verdict"] = "failed"
        if not process.killed:
            code = os.waitstatus_to_exitcode(status)
            said["reason"] = f"crash: {signal.Signals(-code).name}" if code < 0 else f"exit: code {code}"
    if process.killed == "hang" or seconds > limits.seconds:
        said |= {"verdict": "failed", "reason": f"hang: more than {limits.seconds:g} s. {said['reason']}"}
    if process.killed == "memory" or resident > limits.resident:
        said |= {"verdict": "failed", "reason": f"memory: {resident / 1e9:.1f} GB. {said['reason']}"}
    return Outcome(name, seed, seconds=seconds, resident=resident, **said)
