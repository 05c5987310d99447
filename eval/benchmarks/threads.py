"""Speed of tracking by the number of threads and how they wait, on an idle machine and with every core busy.

``python -m eval.benchmarks.threads [--frames 60] [--rounds 3] [--clip kitti00_120] [--weights small]``

Every measurement is a new process; the cases take turns, so that varying load of the machine affects all alike. In the
busy half, one endless loop per core runs beside it. The output is the median of the rounds:

- ``before``: as torch comes, one spinning thread per core;
- ``dvo``: what dvo chooses when nothing is set (:mod:`dvo.core.threads`);
- ``one thread``; and ``one per core, passive``.
"""

from __future__ import annotations

import argparse
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.core.processes import bound
from dvo.core.threads import available_cores
from dvo.data.files.root import data_root
from eval.suites.suite import ROOT

_SCRIPT = Path(__file__).with_name("clip_speed.py")
_SPEED = re.compile(r"SPEED ([0-9.]+) ([0-9]+) (.*)")
_VARIABLES = ("OMP_", "MKL_", "GOMP_", "KMP_", "OPENBLAS_")
STATES = ("idle", "busy")


@dataclass(frozen=True)
class Case:
    """One way to choose threads.

    Attributes:
        name: in the table.
        variables: of the environment, on top of one without any about threads.
        before: import torch before dvo, which then cannot choose how threads wait, and keep torch's number.
    """

    name: str
    variables: tuple[tuple[str, str], ...] = ()
    before: bool = False


@dataclass(frozen=True)
class Speed:
    """Result of one measurement.

    Attributes:
        rate: frames per second inside ``track``.
        threads: of torch.
        policy: how they wait.
    """

    rate: float
    threads: int
    policy: str


def cases(cores: int) -> tuple[Case, ...]:
    """The cases on a machine.

    Args:
        cores: that the process may use.
    """
    every = ("OMP_NUM_THREADS", str(cores))
    return (
        Case("before", before=True),
        Case("dvo"),
        Case("one thread", (("OMP_NUM_THREADS", "1"),)),
        Case("one per core, passive", (every, ("OMP_WAIT_POLICY", "PASSIVE"))),
    )


def environment_of(case: Case, environment: Mapping[str, str]) -> dict[str, str]:
    """Environment of a case.

    Args:
        case: to measure.
        environment: to start from; its variables about threads are left out.
    """
    kept = {name: value for name, value in environment.items() if not name.startswith(_VARIABLES)}
    return {**kept, "PYTHONPATH": str(ROOT), **dict(case.variables)}


@contextmanager
def busy_processes(count: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Endless loops that run inside the context.

    Args:
        count: number of processes.

    Returns:
        Context manager that yields the processes.
    """
    running: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(count):
            running.append(subprocess.Popen(bound([sys.executable, "-c", "while True: pass"])))
        yield running
    finally:
        for process in running:
            process.kill()
            process.wait()


def measure(case: Case, options: list[str]) -> Speed:
    """Measure a case once, in a new process.

    Args:
        case: to measure.
        options: of ``clip_speed.py``.

    Returns:
        The speed.

    Raises:
        DvoError: the process failed.
    """
    command = [sys.executable, str(_SCRIPT), *options, *(["--before"] if case.before else [])]
    done = subprocess.run(bound(command), env=environment_of(case, os.environ), capture_output=True, text=True)
    found = _SPEED.search(done.stdout)
    if done.returncode or found is None:
        last = (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1]
        raise DvoError(f"measurement failed: {last}", field=case.name, remedy=f"run it by hand: {' '.join(command)}")
    return Speed(float(found[1]), int(found[2]), found[3])


def table(results: Mapping[tuple[str, str], list[Speed]]) -> str:
    """Table of medians.

    Args:
        results: measurements by name of the case and state; ``before`` and ``one thread`` are among the cases.

    Returns:
        A row per case: threads, policy, and for each state frames/s and their ratio to ``before`` and ``one thread``.
    """
    rates = {key: statistics.median(speed.rate for speed in speeds) for key, speeds in results.items()}
    states = [state for state in STATES if any(key[1] == state for key in results)]
    head = f"{'case':22} {'threads':>7} {'waiting':>18}"
    head += "".join(f" {f'{state}: frames/s':>15} {'/ before':>9} {'/ one thr.':>10}" for state in states)
    lines = [head]
    for name in dict.fromkeys(key[0] for key in results):
        first = results[name, states[0]][0]
        line = f"{name:22} {first.threads:7d} {first.policy:>18}"
        for state in states:
            rate = rates[name, state]
            line += f" {rate:15.2f} {rate / rates['before', state]:9.2f} {rate / rates['one thread', state]:10.2f}"
        lines.append(line)
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the measurements and print the table.

    Args:
        arguments: of the command line; None for those of the process.

    Returns:
        Exit code: 0, or 2 for invalid input.
    """
    line = OneLineParser(prog="python -m eval.benchmarks.threads", description=__doc__,
                                   formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    line.add_argument("--clip", default="kitti00_120", help="name under the data folder, or a path (kitti00_120)")
    line.add_argument("--data", type=Path, metavar="DIR", help="folder of the recordings ($DVO_DATA, ../shared/data)")
    line.add_argument("--weights", default="small", metavar="NAME|FILE", help="weights (small)")
    line.add_argument("--frames", type=int, default=60, metavar="N", help="frames of a measurement (60)")
    line.add_argument("--warmup", type=int, default=12, metavar="N", help="those of them before timing starts (12)")
    line.add_argument("--rounds", type=int, default=3, metavar="N", help="measurements of each case (3)")
    line.add_argument(
        "--seconds",
        type=float,
        default=60.0,
        metavar="S",
        help="longest time of measurement and warm-up, each (60)",
    )
    line.add_argument("--states", default=",".join(STATES), help=f"separated by commas ({','.join(STATES)})")
    given = line.parse_args(arguments)
    try:
        states = [state for state in given.states.split(",") if state]
        if not states or not set(states) <= set(STATES):
            raise DvoError(f"'{given.states}'", field="--states", remedy=f"choose from {', '.join(STATES)}")
        if given.rounds < 1 or not 0 <= given.warmup < given.frames:
            raise DvoError("no frame to measure", field="--frames", remedy="give more frames than --warmup")
        clip = Path(given.clip)
        if not clip.exists():
            clip = data_root(given.data) / given.clip
        options = [str(clip.resolve()), "--weights", given.weights, "--frames", str(given.frames)]
        options += ["--warmup", str(given.warmup), "--seconds", str(given.seconds)]
        cores = available_cores()
        print(f"{clip.name}, {given.weights}, {given.frames - given.warmup} frames, {cores} cores", flush=True)
        results: dict[tuple[str, str], list[Speed]] = {}
        for number in range(given.rounds):
            for state in states:
                for case in cases(cores):
                    with busy_processes(cores if state == "busy" else 0):
                        speed = measure(case, options)
                    results.setdefault((case.name, state), []).append(speed)
                    print(f"round {number + 1}, {state}, {case.name}: {speed.rate:.2f} frames/s", flush=True)
        print(table(results))
    except DvoError as error:
        print(f"threads: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
