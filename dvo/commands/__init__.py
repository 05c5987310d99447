"""The commands of the CLI and what they answer to the shell."""

OK = 0
NOTHING_TRACKED = 1
BAD_INPUT = 2
INTERRUPTED = 130
