"""Salts of random streams."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from dvo.synth import salts

FOLDER = Path(salts.__file__).parent
SALTS = {name: value for name, value in vars(salts).items() if name.isupper()}


def test_salts_are_distinct() -> None:
    assert len(SALTS) > 15 and all(isinstance(value, int) for value in SALTS.values())
    assert len(set(SALTS.values())) == len(SALTS)


def test_salts_on_which_stored_renderings_depend() -> None:
    assert (salts.REPAINT, salts.MOVERS, salts.TRACKS) == (7405, 7501, 7601)


def test_every_salt_is_named_and_seeds_one_stream() -> None:
    uses: dict[str, int] = dict.fromkeys(SALTS, 0)
    for file in sorted(FOLDER.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("default_rng"):
                literal = re.search(r"\b7\d{3}\b", ast.unparse(node))
                assert literal is None, f"{file.name}:{node.lineno} has a salt without a name"
        for name in re.findall(r"\bsalts\.([A-Z_]+)", text):
            uses[name] += 1
    assert set(uses.values()) == {1}, uses
