"""Commands of the CLI, and their exit codes."""

OK = 0
NOTHING_TRACKED = 1
BAD_INPUT = 2
INTERRUPTED = 130
