"""Table of malformed inputs: ``python -m tests.fuzz --cases 10000``.

``--case READER:SEED`` runs one case again and prints what happened. The exit code is 1 if any case failed.
"""

from __future__ import annotations

import gc
import importlib
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from dvo.core.command_line import OneLineParser
from dvo.core.errors import DvoError
from tests.fuzz.target import Target
from tests.fuzz.worker import Outcome, run_cases, warm

ROOMS = ("data", "files", "settings", "models", "maps", "scenes", "frames")


def all_targets() -> list[Target]:
    """Readers of every room, in the order of the table."""
    modules = [importlib.import_module(f"tests.fuzz.readers_{room}") for room in ROOMS]
    return [target for module in modules for target in module.TARGETS]


def choose(targets: list[Target], names: Iterable[str]) -> list[Target]:
    """Targets by the beginnings of their names.

    Args:
        targets: to choose from.
        names: names or their beginnings; none for all targets.

    Raises:
        DvoError: a name that no target has.
    """
    names = list(names)
    for name in names:
        if not any(target.name.startswith(name) for target in targets):
            known = ", ".join(target.name for target in targets)
            raise DvoError(f"no reader '{name}'", field="--readers", remedy=f"choose from {known}")
    return [target for target in targets if not names or any(target.name.startswith(name) for name in names)]


def cases_of(targets: list[Target], count: int, first: int) -> Iterator[tuple[Target, int]]:
    """Cases in turn over the targets, after the valid input of each.

    Args:
        targets: readers.
        count: of mutated inputs, all readers together.
        first: seed of the first mutation of each reader.

    Yields:
        Targets with seeds; -1 for the valid input.
    """
    yield from ((target, -1) for target in targets)
    yield from ((targets[i % len(targets)], first + i // len(targets)) for i in range(count))


def checked(outcome: Outcome) -> Outcome:
    """The outcome, as a failure if a valid input was refused: its mutations would test nothing.

    Args:
        outcome: of any case.
    """
    if outcome.seed >= 0 or outcome.verdict != "refused":
        return outcome
    return Outcome(outcome.target, outcome.seed, "failed", f"valid input refused: {outcome.reason}")


def table(outcomes: list[Outcome], names: list[str]) -> str:
    """Counts by reader and in total, then the failures with their seeds.

    Args:
        outcomes: of all cases.
        names: of the readers, in the order of the rows.
    """
    count: Counter[tuple[str, str]] = Counter()
    for outcome in outcomes:
        for name in (outcome.target, "total"):
            count[name, "tried"] += outcome.seed >= 0
            count[name, outcome.verdict] += outcome.seed >= 0 or outcome.verdict == "failed"
    columns = ("tried", "refused", "accepted", "failed")
    rows = [f"{'reader':20s}" + "".join(f"{column:>10s}" for column in columns)]
    for name in [*names, "total"]:
        rows.append(f"{name:20s}" + "".join(f"{count[name, column]:10d}" for column in columns))
    for outcome in sorted((o for o in outcomes if o.verdict == "failed"), key=lambda o: (o.target, o.seed)):
        rows.append(f"failed {outcome.target}:{outcome.seed}  {outcome.reason[:160]!r}  [{outcome.mutation[:120]}]")
    return "\n".join(rows)


def main(arguments: list[str] | None = None) -> int:
    """Try the cases and print the table.

    Args:
        arguments: of the command line; None for those of this process.

    Returns:
        Exit code: 0, or 1 if a case failed.
    """
    parser = OneLineParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=1000, help="number of mutated inputs (1000)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first mutation of each reader (0)")
    parser.add_argument("--readers", nargs="*", default=[], metavar="NAME", help="only readers that begin so (all)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at a time (all cores)")
    parser.add_argument("--case", metavar="READER:SEED", help="one case, with its traceback")
    parser.add_argument("--list", action="store_true", help="print the names of the readers")
    given = parser.parse_args(arguments)
    targets = all_targets()
    if given.list:
        print("\n".join(target.name for target in targets))
        return 0
    if given.case:
        name, _, seed = given.case.rpartition(":")
        targets = [target for target in targets if target.name == name]
        if not targets:
            raise DvoError("no such case", field="--case", remedy="give READER:SEED, see --list")
        cases = iter([(targets[0], int(seed))])
    else:
        targets = choose(targets, given.readers)
        cases = cases_of(targets, given.cases, given.seed)
    begin = time.perf_counter()
    warm(targets)
    ready = time.perf_counter()
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="malformed-") as folder:
        for outcome in run_cases(cases, Path(folder), jobs=given.jobs):
            outcomes.append(checked(outcome))
            if given.case:
                _describe(outcomes[-1])
            elif outcomes[-1].verdict == "failed":
                print(f"failed {outcome.target}:{outcome.seed} {outcomes[-1].reason[:200]!r}", file=sys.stderr)
    gc.unfreeze()
    if not given.case:
        print(table(outcomes, [target.name for target in targets]))
        took, tried = time.perf_counter() - ready, max(len(outcomes), 1)
        print(f"{took:.0f} s for the cases, {1000 * took / tried:.0f} ms each, {ready - begin:.0f} s to import; "
              f"most memory {max(o.resident for o in outcomes) / 1e9:.2f} GB, "
              f"longest {max(o.seconds for o in outcomes):.1f} s")  # fmt: skip
    return int(any(outcome.verdict == "failed" for outcome in outcomes))


def _describe(outcome: Outcome) -> None:
    print(f"{outcome.target}:{outcome.seed} {outcome.verdict} after {outcome.seconds:.2f} s of the processor and "
          f"{outcome.resident / 1e9:.2f} GB")  # fmt: skip
    print("\n".join(text for text in (outcome.mutation, outcome.reason, outcome.trace) if text))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except DvoError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
