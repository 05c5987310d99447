"""Evaluation of systems on suites of sequences: ``python -m eval run``, ``score``, ``report``, ``list``, ``prepare``,
``vocabulary``. Without a command it is ``run``.
"""

from __future__ import annotations

import os
import sys

from dvo.core.errors import DvoError
from dvo.core.limits import limit_error
from dvo.core.text import print_line
from eval.commands import VERBS, parser


def main(arguments: list[str] | None = None) -> int:
    """Run the program.

    Args:
        arguments: of the command line; None takes those of the process.

    Returns:
        Exit code: 0; 2 for an input that the user can fix, told in one line; 130 after Ctrl-C.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if "--list" in given:
        given = ["list"]
    if not given or (given[0] not in VERBS and given[0] not in ("-h", "--help")):
        given.insert(0, "run")
    try:
        options = parser().parse_args(given)
        VERBS[options.verb](options)
    except DvoError as error:
        print_line(f"eval: error: {error}", error=True)
        return 2
    except KeyboardInterrupt:
        print_line("eval: stopped; the same command goes on from here", error=True)
        return 130
    except BrokenPipeError:  # the reader of stdout has seen enough; the interpreter flushes it again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as error:
        limited = limit_error(error)
        if limited is None:
            raise
        print_line(f"eval: error: {limited}", error=True)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
