"""Tables of disturbed runs: ``python -m tests.faults writers|signals|soak``.

``writers --seconds 30``: two processes with two threads each write every kind of output to one place, while it is read.
``signals --count 40``: SIGTERM, SIGHUP and SIGKILL at random times of `dvo run --save-map --export colmap`.
``soak --minutes 30``: tracking, maps, exports and errors in one process; memory, descriptors and threads.

The exit code is 1 if anything failed.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from dvo.core.command_line import OneLineParser
from tests.faults import signals, soak, writers


def main(given: list[str] | None = None) -> int:
    """Run a trial and print its table.

    Args:
        given: of the command line; None for those of this process.

    Returns:
        Exit code.
    """
    parser = OneLineParser(prog="python -m tests.faults", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("trial", choices=("writers", "signals", "soak"))
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--count", type=int, default=40, help="of each signal")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(given)
    with tempfile.TemporaryDirectory(prefix="dvo-faults-") as folder:
        place = Path(folder)
        if options.trial == "writers":
            text, failed = writers.trial(place, options.seconds)
        elif options.trial == "signals":
            text, failed = signals.trial(place, options.count, options.seed)
        else:
            text, failed = soak.trial(place, options.minutes)
    print(text)
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
