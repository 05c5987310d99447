"""Commands of the CLI, and their exit codes."""

OK = 0
NOTHING_TRACKED = 1
NOT_RECOGNISED = 1  # of dvo merge
BAD_INPUT = 2  # or results that cannot be written
INTERRUPTED = 130
TERMINATED = 143


class Terminated(KeyboardInterrupt):
    """SIGTERM, at a time when it ends the program at once."""
