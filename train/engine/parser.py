"""Parser of training configurations whose errors are one line."""

from __future__ import annotations

import re
from typing import NoReturn

from lightning.pytorch.cli import LightningArgumentParser

from dvo.core.text import printable

PROGRAM = "train"
BAD_INPUT = 2
NOISE = re.compile(
    r"Subtypes:|Errors:|Given value type:|Given value: NestedArg|Does not validate against any|"
    r"(- )?Expected a (path but|dot import path|<class 'NoneType'>)|- Does not validate against any"
)


class OneLineParser(LightningArgumentParser):
    """LightningArgumentParser that ends with one line and code 2, without the list of all options."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Print the message and exit."""
        if not self.exit_on_error:
            super().error(message, ex)
        text = f"{PROGRAM}: error: {in_one_line(message)} (see python -m train fit --help)"
        self.exit(BAD_INPUT, printable(text) + "\n")


def in_one_line(message: str) -> str:
    """Message of jsonargparse without the alternatives that it tried.

    Args:
        message: text of several lines.
    """
    lines = [line.strip() for line in message.splitlines()]
    kept = [line.removeprefix("- ") for line in lines if line and not NOISE.match(line)]
    text = " ".join(kept)
    text = re.sub(r"Problem with given class_path '[^']*':\s*", "", text)
    text = re.sub(r'Parser key "([^"]*)":', r"\1:", text)
    text = re.sub(r"<class '(?:\w+\.)*(\w+)'>", r"\1", text).strip()
    return re.sub(r"^(\S+): Given value: (.*)$", r"\1: does not accept the value \2", text)
