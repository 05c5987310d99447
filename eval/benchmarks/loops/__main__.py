"""Loop closure on long sequences and after darkness: `python -m eval.benchmarks.loops [revisit|blackout]`.

- `revisit`: laps of two minutes through scenes of held-out families (suites `revisit` and `revisit/test`), tracked
  without and with loop closure. Columns: ATE, loops, false ones, seconds of revisits and their recall, 95th percentile
  of the time of `track`, memory of a keyframe. `eval/scoring/loops.py` defines right and false loops and recall.
- `blackout`: walks that are dark for two seconds and then go back over the way they came, tracked with and without the
  darkness. Columns: whether the frames after the dark got the world of those before it, loops, errors and their ratio.

Every run has a process of its own. With `--alternate` both runs of a sequence are made at the same time, one frame of
each after the other, so that other load of the machine meets both alike. With `--out FILE` each is appended as a line
of JSON, and the same command goes on from there; the file alone gives the tables again with `--tables`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from dvo.session.results import jsonable
from eval.benchmarks.loops.processes import Alternating, alone
from eval.benchmarks.loops.runs import Run, Task
from eval.benchmarks.loops.tables import blackout_table, revisit_table
from eval.suites.selection import load_suites
from eval.suites.suite import Sequence

FAMILIES = ("hall", "courtyard", "gallery")  # families that training never draws
FIRST_SEED = 4_300_000_000
BLACKOUT = {"kind": "return", "frames": 300, "fps": 15.0, "apart": True, "height": 240, "width": 320, "version": 1}


def blackout_sequences(count: int) -> list[Sequence]:
    """Walks there and back, 20 s at 15 Hz, 320x240, of held-out families.

    Args:
        count: number of sequences.
    """
    options = [{**BLACKOUT, "seed": FIRST_SEED + k, "family": FAMILIES[k % len(FAMILIES)]} for k in range(count)]
    return [
        Sequence(f"return_{one['family']}_{k}", rendered=tuple(sorted(one.items()))) for k, one in enumerate(options)
    ]


def tasks(arguments: argparse.Namespace) -> Iterator[Task]:
    """Tasks of the command line, both of a pair one after the other.

    Args:
        arguments: of the command line.

    Raises:
        DvoError: no such suite, or a recorded one.
    """
    common = {"device": arguments.device, "frames": arguments.frames}
    for system in arguments.systems:
        for seed in range(arguments.seeds):
            if arguments.mode == "revisit":
                for suite in load_suites(arguments.suites, arguments.sequences):
                    for sequence in suite.sequences:
                        if sequence.rendered is None:
                            raise DvoError("recorded", field=sequence.name, remedy="give suites that are rendered")
                        for loops in (False, True):
                            yield Task("revisit", system, sequence, loops, seed=seed, **common)
            else:
                for sequence in blackout_sequences(arguments.count):
                    if arguments.sequences is None or sequence.name in arguments.sequences:
                        for dark in (False, True):
                            yield Task("blackout", system, sequence, True, dark, seed, **common)


def read_runs(file: Path | None) -> list[Run]:
    """Runs that were made before; a line that was cut off is left out.

    Args:
        file: of JSON lines; None or one that is not there for none.

    Raises:
        DvoError: a file that cannot be read, or of something else.
    """
    if file is None or not file.is_file():
        return []
    known = {part.name for part in fields(Run)}
    runs = []
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
        for number, text in enumerate(lines):
            try:
                entry = json.loads(text)
            except json.JSONDecodeError:
                if number + 1 < len(lines):
                    raise
                break  # the process was killed while it wrote
            # JSON has no nan; a value without a meaning is null.
            given: dict[str, Any] = {k: float("nan") if entry[k] is None else entry[k] for k in known & set(entry)}
            runs.append(Run(**given))
    except (OSError, ValueError, TypeError) as error:
        raise DvoError(f"not runs of this benchmark ({error})", file=file, remedy="give another --out") from error
    return runs


def run_all(
    wanted: Iterable[Task], out: Path | None, do: Callable[[Task], Run], say: Callable[[str], None] = print
) -> list[Run]:
    """Carry out the tasks that the file does not have yet.

    Args:
        wanted: tasks.
        out: file of JSON lines, which is added to; None for none.
        do: carries out a task.
        say: called with a line for each run.

    Returns:
        Runs of all tasks, in their order.
    """
    done = {json.dumps(run.key): run for run in read_runs(out)}
    runs = []
    for task in wanted:
        key = json.dumps(task.key)
        if key not in done:
            done[key] = do(task)
            if out is not None:
                _append(out, done[key])
            say(line(done[key]))
        runs.append(done[key])
    return runs


def check_out(out: Path) -> None:
    """Check that runs can be kept, before the first one is made.

    Args:
        out: file to add to; its folder is made if need be.

    Raises:
        DvoError: it cannot be written.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.open("a", encoding="utf-8").close()
    except OSError as error:
        raise DvoError(error.strerror or str(error), file=out, field="--out", remedy="give another file") from error


def _append(out: Path, run: Run) -> None:
    """Add a line; the rest of one that was cut off is removed."""
    whole = out.read_text(encoding="utf-8") if out.is_file() else ""
    if whole and not whole.endswith("\n"):
        out.write_text(whole[: whole.rfind("\n") + 1], encoding="utf-8")
    with out.open("a", encoding="utf-8") as file:
        file.write(json.dumps(jsonable(run), allow_nan=False) + "\n")


def line(run: Run) -> str:
    """One line for a run.

    Args:
        run: that was made.
    """
    what = f"{'dark' if run.dark else 'bright'}" if run.mode == "blackout" else f"loops {'on' if run.loops else 'off'}"
    return (
        f"{run.system} {run.sequence} seed {run.seed}, {what}: {run.status}, ATE {run.ate_percent:.2f} %, "
        f"{run.found:.0f} loops, {run.false:.0f} false, recall {run.recall:.2f} of {run.revisit_s:.0f} s, "
        f"{'joined' if run.joined else 'not joined'}, p95 {run.p95_ms:.0f} ms, {run.fps:.1f} frames/s"
    )


def main() -> None:
    """Entry point."""
    parser = OneLineParser(prog="python -m eval.benchmarks.loops", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("mode", nargs="?", choices=("revisit", "blackout"), default="revisit")
    parser.add_argument("--systems", nargs="+", default=["dvo-small"], metavar="NAME", help="with a setting `loops`")
    parser.add_argument(
        "--suites", nargs="+", default=["revisit", "revisit/test"], metavar="SUITE", help="of `revisit`"
    )
    parser.add_argument("--sequences", nargs="+", metavar="NAME", help="only these")
    parser.add_argument("--count", type=int, default=20, metavar="N", help="sequences of `blackout` (%(default)s)")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="seeds of a system (%(default)s)")
    parser.add_argument("--frames", type=int, metavar="N", help="first frames of a sequence only")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--alternate", action="store_true", help="both runs of a sequence frame by frame in turns")
    parser.add_argument("--out", type=Path, metavar="FILE", help="runs as JSON lines; go on from those in it")
    parser.add_argument("--tables", action="store_true", help="the tables of FILE alone, nothing is run")
    arguments = parser.parse_args()
    try:
        if arguments.tables and arguments.out is None:
            raise DvoError("no runs", field="--tables", remedy="give the file of the runs with --out")
        if arguments.tables:
            runs = [run for run in read_runs(arguments.out) if run.mode == arguments.mode]
        else:
            if arguments.out is not None:
                check_out(arguments.out)
            do = Alternating() if arguments.alternate else alone
            runs = run_all(tasks(arguments), arguments.out, do, lambda text: print(text, flush=True))
        print("\n" + (revisit_table(runs) if arguments.mode == "revisit" else blackout_table(runs)))
    except DvoError as error:
        raise SystemExit(f"error: {error}") from error
    except KeyboardInterrupt:
        print("stopped; with --out the same command goes on from here", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
