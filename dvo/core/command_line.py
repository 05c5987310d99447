"""Parser of command lines whose errors are one line, and types of arguments that several commands have."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NoReturn

from dvo.core.text import printable

BAD_ARGUMENT = 2  # exit code


class OneLineParser(argparse.ArgumentParser):
    """ArgumentParser that ends with one line and code 2, which quotes arguments as :func:`printable` has them."""

    def error(self, message: str) -> NoReturn:
        """Print the message and exit."""
        names = [word for word in sys.argv[1:] if word.startswith("-") and Path(word).is_file()]
        if names:
            message += f"; the file {names[0]} is ./{names[0]}, or it would be an option"
        self.exit(BAD_ARGUMENT, printable(f"{self.prog}: error: {message} (see {self.prog} --help)") + "\n")


def whole(text: str) -> int:
    """Whole number; a type of arguments.

    Args:
        text: of the command line.
    """
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, got {text[:60]!r}") from None


def number(text: str) -> float:
    """Number; a type of arguments.

    Args:
        text: of the command line.
    """
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number, got {text[:60]!r}") from None


def positive_int(text: str) -> int:
    """Whole number of at least 1; a type of arguments.

    Args:
        text: of the command line.
    """
    value = whole(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more, got {text}")
    return value


def positive_float(text: str) -> float:
    """Finite number above 0; a type of arguments.

    Args:
        text: of the command line.
    """
    value = number(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be more than 0, got {text}")
    return value


def seed(text: str) -> int:
    """Whole number from 0 to 2^63 - 1; a type of arguments.

    Args:
        text: of the command line.
    """
    value = whole(text)
    if not 0 <= value < 2**63:
        raise argparse.ArgumentTypeError(f"must be 0 or more and below 2^63, got {text[:60]}")
    return value


def names(text: str) -> list[str]:
    """Names separated by commas, each once; a type of arguments.

    Args:
        text: of the command line.
    """
    found = [name.strip() for name in text.split(",")]
    if not all(found):
        raise argparse.ArgumentTypeError(f"expected names separated by commas, got {text[:60]!r}")
    return list(dict.fromkeys(found))
