"""``python -m eval``: every system on every sequence of a suite, a table on the terminal, files in a folder."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from dvo.errors import DvoError
from eval.runner import RESULTS, Plan, predict_all, report, score_all
from eval.sequences import data_folder, read_suite
from eval.systems import DEFAULT, list_systems


def parser() -> argparse.ArgumentParser:
    """The command line."""
    line = argparse.ArgumentParser(prog="python -m eval", description=__doc__)
    line.add_argument("--suite", default="validation", help="name in configs/eval, or a YAML file (validation)")
    line.add_argument("--systems", default=",".join(DEFAULT), help=f"names with commas between ({','.join(DEFAULT)})")
    line.add_argument("--sequences", help="names with commas between (all of the suite)")
    line.add_argument("--seeds", type=int, default=1, metavar="N", help="seeds 0 to N-1 (1)")
    line.add_argument("--stride", type=int, metavar="N", help="feed every N-th image (as the suite says)")
    line.add_argument("--data", type=Path, metavar="DIR", help="folder of the recordings ($DVO_DATA, ../shared/data)")
    line.add_argument("--out", type=Path, default=Path("results/eval"), metavar="DIR", help="results (results/eval)")
    line.add_argument("--weights", metavar="FILE", help="weights for dvo-... systems in place of the package's own")
    line.add_argument("--device", default="cpu", help="where networks compute (cpu)")
    line.add_argument("--threads", type=int, default=2, metavar="N", help="threads of one run (2)")
    line.add_argument("--score-only", action="store_true", help="score the predictions that lie in --out, run nothing")
    line.add_argument("--list", action="store_true", help="list the systems and leave")
    return line


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit code: 0, or 2 for an input that the user can mend."""
    given = parser().parse_args(arguments)
    try:
        if given.list:
            for system in list_systems():
                print(f"{system.name:14} {system.licence:10} {system.missing() or 'available'}\n    {system.about}")
            return 0
        print(run(given))
    except DvoError as error:
        print(f"eval: error: {error}", file=sys.stderr)
        return 2
    return 0


def run(given: argparse.Namespace) -> str:
    """Do what the command line says; returns the table."""
    if find_spec("evo") is None:
        raise DvoError("evo is not installed", remedy="pip install -e '.[eval]'")
    for name in ("seeds", "stride", "threads"):
        value = getattr(given, name)
        if value is not None and value < 1:
            raise DvoError(f"must be 1 or more, got {value}", field=f"--{name}", remedy="give a whole number")
    suite = read_suite(given.suite)
    if given.sequences:
        suite = suite.only(_names(given.sequences))
    if given.stride:
        suite = replace(suite, stride=given.stride)
    plan = Plan(
        suite=suite,
        systems=tuple(_names(given.systems)),
        seeds=tuple(range(given.seeds)),
        data=data_folder(given.data),
        out=given.out,
        weights=given.weights,
        device=given.device,
        threads=given.threads,
    )
    if not given.score_only:
        try:
            plan.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DvoError(str(error.strerror), file=plan.out, field="--out", remedy="give another folder") from error
        predict_all(plan, say=lambda text: print(text, file=sys.stderr, flush=True))
    table = report(plan, score_all(plan))
    print(f"results in {plan.out} ({RESULTS}, table.md, one picture per sequence)", file=sys.stderr)
    return table


def _names(text: str) -> list[str]:
    return list(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


if __name__ == "__main__":
    sys.exit(main())
