"""The README's Python is run, its commands and files exist."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

from dvo.cli import build_parser
from dvo.models.weights import list_weights

README = Path(__file__).resolve().parent.parent / "README.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def test_python_block_runs(image_folder, monkeypatch):
    """On twenty small images of noise: the program must end, not track."""
    (block,) = blocks("python")
    assert len([line for line in block.splitlines() if line.strip()]) <= 10
    monkeypatch.chdir(image_folder.parent.parent)
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(block, str(README), "exec"), {})
    assert len(re.findall(r"initialising|tracking|lost", said.getvalue())) == 20
    assert "parameters" in said.getvalue()


def test_the_weights_that_it_speaks_of_are_shipped():
    assert "small" in [weights.name for weights in list_weights()]


@pytest.mark.parametrize("line", [line for block in blocks("bash") for line in block.splitlines() if "dvo " in line])
def test_commands_parse(line):
    for command in line.split(" && "):
        if command.startswith("dvo "):
            build_parser().parse_args(command.split()[1:])


def test_pictures_exist():
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", README.read_text(encoding="utf-8")):
        assert (README.parent / picture).is_file(), picture


def test_the_ci_runs_the_test_command():
    """``.ci/run`` finds the command in the README by this pattern."""
    assert re.search(r"^pip install -e .* && pytest", README.read_text(encoding="utf-8"), re.MULTILINE)
