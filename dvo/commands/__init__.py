"""Commands of the CLI, and their exit codes."""

import signal

OK = 0
NOTHING_TRACKED = 1
NOT_RECOGNISED = 1  # of dvo merge
BAD_INPUT = 2  # or results that cannot be written
HUNG_UP = 129
INTERRUPTED = 130
TERMINATED = 143


class Terminated(KeyboardInterrupt):
    """A signal that asks the program to end, at a time when it ends at once.

    Args:
        number: of the signal: SIGTERM, or SIGHUP when the terminal is closed.

    Attributes:
        code: exit code.
    """

    def __init__(self, number: int = signal.SIGTERM) -> None:
        super().__init__(signal.Signals(number).name)
        self.code = 128 + number


def ending_signals() -> tuple[signal.Signals, ...]:
    """Signals that ask a program to end, Ctrl-C aside: SIGTERM, and SIGHUP where there is one."""
    return tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
