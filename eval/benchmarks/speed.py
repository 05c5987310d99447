"""Speed, memory and accuracy of systems side by side, on one thread: ``python -m eval.benchmarks.speed``.

Each run has a process of its own; the systems take turns, ``--rounds`` times, and the medians of the rounds are printed
in one table. Time is that of ``track`` alone, of images that were read and decoded before. The columns:

- frames/s, median, 95th percentile and maximum of ``track`` in ms;
- ``cpu``: processor time of the process by ``track``, ms a frame. It tells of threads beside the one that tracks, which
  ORB-SLAM3 has in any case, and hardly depends on other load of the machine;
- ``finish``: ms of ``finish`` a frame; ``MB``: largest memory of the process, without the decoded images;
- aten calls of ``track``, mean by kind of frame, counted in a run without a clock: the network has measured the frame,
  and it stays as a keyframe or is dropped; it was aligned with the keyframes instead; all; and of all those that
  compute: views and conversions that copy nothing (four calls for a tensor to numpy) left out. Of networks alone;
- ``poses``: frames with a pose; ATE after alignment in Sim(3), each world on its own, in cm and % of the path.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from dvo.core.command_line import OneLineParser, names, positive_int
from dvo.core.errors import DvoError
from dvo.core.processes import bound, run_limited
from dvo.core.threads import process_environment
from dvo.data.files.output import scratch_folder
from eval.benchmarks.timed_run import KINDS, Job, Timed
from eval.suites.selection import folder_of_data, load_suites, settle, suite_of_folder
from eval.suites.suite import ROOT, Suite, suite_names
from eval.suites.suite import Sequence as Recording
from eval.systems.registry import find_system

SYSTEMS = ("dvo-small+preset=fast", "dvo-small", "dvo-small+preset=accurate", "keyframe", "klt-pnp", "orbslam3")
SEQUENCES = ("7scenes_redkitchen_400", "tum_fr1_rpy_60")
_SHOWN = (
    ("frames/s", 1), ("p50", 1), ("p95", 1), ("max", 1), ("cpu", 1), ("finish", 1), ("MB", 0), *((k, 0) for k in KINDS),
    ("all", 0), ("computing", 0), ("poses", 2), ("ATE cm", 2), ("ATE %", 2),
)  # fmt: skip


def find_sequences(wanted: Sequence[str]) -> list[tuple[Suite, Recording]]:
    """Sequences with their suites.

    Args:
        wanted: names of sequences in the suites of configs/eval, or folders of sequences.

    Raises:
        DvoError: no such sequence.
    """
    known: dict[str, tuple[Suite, Recording]] = {}
    for suite in load_suites(list(dict.fromkeys(["validation", *suite_names()]))):
        known = {sequence.name: (suite, sequence) for sequence in suite.sequences} | known
    found = []
    for name in dict.fromkeys(wanted):
        if name not in known and not Path(name).is_dir():
            raise DvoError(f"no sequence '{name}'", field="--sequences", remedy="see: python -m eval list")
        if name in known:
            found.append(known[name])
        else:
            own = suite_of_folder(Path(name))
            found.append((own, own.sequences[0]))
    return found


def run_once(job: Job) -> Timed:
    """Run a job in a process of its own.

    Args:
        job: what is run.

    Raises:
        DvoError: the run failed.
    """
    with scratch_folder("dvo-speed") as folder:
        files = [folder / "job.json", folder / "result.json"]
        files[0].write_text(json.dumps(asdict(job)), encoding="utf-8")
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        command = [sys.executable, "-m", "eval.benchmarks.timed_run", *map(str, files)]
        ending = run_limited(bound(command), process_environment(1, environment), None, folder / "log.txt")
        if not files[1].is_file():
            raise DvoError(f"failed: {ending}", field=job.system, remedy="run it by: python -m eval run")
        return Timed(**json.loads(files[1].read_text(encoding="utf-8")))


def values(rounds: Sequence[Timed]) -> dict[str, float]:
    """Columns of a row: medians of the rounds, the largest memory, and calls of the round that counted them.

    Args:
        rounds: of one system on one sequence, one or more.
    """

    def median(of: list[float]) -> float:
        return statistics.median(of)

    calls = next((run.calls for run in rounds if run.calls), {})
    return {
        "frames/s": median([1e3 * len(run.track_ms) / sum(run.track_ms) for run in rounds]),
        **{f"p{k}": median([float(np.percentile(run.track_ms, k)) for run in rounds]) for k in (50, 95)},
        "max": median([max(run.track_ms) for run in rounds]),
        "cpu": median([run.processor_ms for run in rounds]),
        "finish": median([run.finish_ms for run in rounds]),
        "MB": max(run.peak_mb for run in rounds),
        **calls,
        "poses": median([run.tracked for run in rounds]),
        "ATE cm": median([100 * run.ate_m for run in rounds]),
        "ATE %": median([run.ate_percent for run in rounds]),
    }


def table(rows: dict[tuple[str, str], dict[str, float]]) -> str:
    """Table in Markdown.

    Args:
        rows: columns of :func:`values` by sequence and system.
    """
    head = " | ".join(["sequence", "system", *(name for name, _ in _SHOWN)])
    lines = [f"| {head} |", "|---|---|" + "--:|" * len(_SHOWN)]
    for (sequence, system), found in rows.items():
        numbers = [(found.get(name, float("nan")), digits) for name, digits in _SHOWN]
        cells = [f"{number:.{digits}f}" if np.isfinite(number) else "–" for number, digits in numbers]
        lines.append(f"| {sequence} | {system} | {' | '.join(cells)} |")
    return "\n".join(lines)


def compare(
    systems: Sequence[str], sequences: Sequence[tuple[Suite, Recording]], data: Path, frames: int | None, rounds: int
) -> dict[tuple[str, str], dict[str, float]]:
    """Run systems in turns.

    Args:
        systems: names; what cannot run here, or fails, is told and left out.
        sequences: with their suites.
        data: folder of the recordings.
        frames: of a sequence; None for all.
        rounds: of each system on each sequence.

    Returns:
        Columns by sequence and system.
    """
    there = []
    for system in systems:
        reason = find_system(system).missing()
        if reason is None:
            there.append(system)
        else:
            print(f"{system}: {reason}", flush=True)
    runs: dict[tuple[str, str], list[Timed]] = {(s.name, system): [] for _, s in sequences for system in there}
    for number in range(rounds):
        for suite, sequence in sequences:
            for system in there:
                key = sequence.name, system
                if key not in runs:
                    continue
                try:
                    done = run_once(Job(system, settle(suite, sequence, data), str(data), frames, count=number == 0))
                except DvoError as error:
                    del runs[key]
                    print(f"{sequence.name}, {error}", flush=True)
                    continue
                runs[key].append(done)
                speed = 1e3 * len(done.track_ms) / sum(done.track_ms)
                print(f"round {number + 1}, {sequence.name}, {system}: {speed:.1f} frames/s", flush=True)
    return {key: values(found) for key, found in runs.items()}


def main(arguments: list[str] | None = None) -> int:
    """Run the systems and print the table.

    Args:
        arguments: of the command line; None for those of the process.

    Returns:
        Exit code: 0, or 2 for invalid input.
    """
    line = OneLineParser(prog="python -m eval.benchmarks.speed", description=__doc__,
                                   formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    line.add_argument("--systems", type=names, default=list(SYSTEMS), metavar="NAMES",
                      help=f"with commas between, see: python -m eval list ({','.join(SYSTEMS)})")  # fmt: skip
    line.add_argument("--sequences", type=names, default=[], metavar="NAMES",
                      help=f"of suites, or folders, beside {', '.join(SEQUENCES)}")  # fmt: skip
    line.add_argument("--frames", type=positive_int, default=200, metavar="N", help="of a sequence (%(default)s)")
    line.add_argument("--rounds", type=positive_int, default=3, metavar="N", help="of each system (%(default)s)")
    line.add_argument("--data", type=Path, metavar="DIR", help="folder of the recordings ($DVO_DATA, ../shared/data)")
    given = line.parse_args(arguments)
    try:
        sequences = find_sequences([*SEQUENCES, *given.sequences])
        data = folder_of_data([suite for suite, _ in sequences], given.data)
        print(table(compare(given.systems, sequences, data, given.frames, given.rounds)))
    except DvoError as error:
        print(f"speed: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
