"""Extension of griffe for the API page: roles and examples of the docstrings in the form that Markdown shows."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:class|func|meth|mod|data|attr|exc):`~?([^`]+)`")
_EXAMPLE = re.compile(r"^( *)Example:\n(?=\s*>>>)", re.MULTILINE)
_LITERAL = re.compile(r"^ *::\n\n?", re.MULTILINE)
_SHARED = re.compile(r"^    (\w+(?:, \w+)+):((?:.*)(?:\n {5,}.*)*)", re.MULTILINE)


class Docstrings(griffe.Extension):
    """Rewriting of docstrings when they are loaded."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of an object.

        Args:
            obj: module, class, function or attribute.
        """
        if obj.docstring is None:
            return
        text = _ROLE.sub(r"`\1`", obj.docstring.value)
        text = _LITERAL.sub("", _EXAMPLE.sub(r"\1Examples:\n", text))
        # One text for several parameters, such as "ii, jj, kk: ...", is repeated for each, with its type.
        obj.docstring.value = _SHARED.sub(
            lambda match: "\n".join(f"    {name}:{match[2]}" for name in match[1].split(", ")), text
        )
