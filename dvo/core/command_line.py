"""Parser of command lines whose errors are one line."""

from __future__ import annotations

import argparse
from typing import NoReturn

from dvo.core.text import printable

BAD_ARGUMENT = 2  # exit code


class OneLineParser(argparse.ArgumentParser):
    """ArgumentParser that ends with one line and code 2, which quotes arguments as :func:`printable` has them."""

    def error(self, message: str) -> NoReturn:
        """Print the message and exit."""
        self.exit(BAD_ARGUMENT, printable(f"{self.prog}: error: {message} (see {self.prog} --help)") + "\n")
