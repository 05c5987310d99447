"""Options of ``dvo run`` for streams, in a module that imports nothing heavy."""

from __future__ import annotations

import argparse

from dvo.core.command_line import whole


def add_stream_options(parser: argparse.ArgumentParser) -> None:
    """Add the options.

    Args:
        parser: of the command.
    """
    parser.add_argument(
        "--queue",
        type=_length,
        metavar="N",
        help="of a stream, frames that may wait, older ones are dropped; 0: none is dropped (default: 1 if live)",
    )


def _length(text: str) -> int:
    value = whole(text)
    if not 0 <= value <= 100_000:
        raise argparse.ArgumentTypeError(f"must be 0 to 100000, got {text[:60]}")
    return value
