"""The README's Python is run, and that of docs/live.md for a loop of one's own; commands and files exist."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from dvo.cli import build_parser
from dvo.models.weights import list_weights

README = Path(__file__).resolve().parent.parent / "README.md"


def blocks(language: str, page: Path = README) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.mark.long
def test_python_block_runs(image_folder, monkeypatch):
    """On twenty small images of noise: the program must end, not track."""
    block = blocks("python")[0]
    assert len([line for line in block.splitlines() if line.strip()]) <= 10
    monkeypatch.chdir(image_folder.parent.parent)
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(block, str(README), "exec"), {})
    assert len(re.findall(r"initialising|tracking|lost", said.getvalue())) == 20
    assert "parameters" in said.getvalue()


def test_live_python_block_runs():
    """On images of noise in place of a camera: it must end, and tell of each frame."""
    block = next(block for block in blocks("python", README.parent / "docs" / "live.md") if "grab()" in block)
    images = np.random.default_rng(0).integers(0, 255, (6, 480, 640, 3), dtype=np.uint8)
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(block, str(README), "exec"), {"grab": lambda: iter(images)})
    assert len(said.getvalue().splitlines()) == 6


def test_bundle_adjustment_block_runs():
    """Gradients arrive at the targets; every Python block has a test here."""
    first, block = blocks("python")
    assert len([line for line in block.splitlines() if line.strip()]) <= 7
    names: dict[str, torch.Tensor] = {}
    exec(compile(block, str(README), "exec"), names)
    assert names["targets"].grad.abs().sum() > 0 and torch.isfinite(names["targets"].grad).all()


def test_it_is_short():
    text = README.read_text(encoding="utf-8")
    assert len(text.split()) <= 1500


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


def rooms_there() -> set[str]:
    return {path.parent.name for path in (README.parent / "dvo").glob("*/__init__.py")}


def test_rooms_named_are_the_rooms_there():
    """The tree on the page lists every folder of the library, and no other."""
    text = (README.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    tree = text[text.index("    dvo/ ") : text.index("      viz/")].splitlines()[1:]
    named = {found.group(1) for line in tree if (found := re.match(r"      (\w+)/ ", line))} | {"viz"}
    assert named | {"commands"} == rooms_there()


def test_the_box_has_the_rooms():
    text = README.read_text(encoding="utf-8")
    box = text[text.index("    core  geometry") : text.index("    eval/")].splitlines()
    named = {name for line in box for name in re.split(r"\s{2,}", line.strip())[:-1]}
    assert named == rooms_there() | {"train/"}


@pytest.mark.parametrize("top", ["train", "eval"])
def test_rooms_of_the_programs_are_named(top):
    text = (README.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line.startswith(f"    {top}/"))
    there = {path.parent.name for path in (README.parent / top).glob("*/__init__.py")}
    assert set(re.findall(r"(\w+)/", line)) - {top} == there


def test_files_that_the_architecture_page_touches_exist():
    """In the table of changes, files without emphasis are there; those to be added are not."""
    text = (README.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = text[text.index("## Where a change goes") :]
    for bold, name in re.findall(r"(\*\*)?`((?:dvo|train|eval|configs)/[\w/]+\.\w+)`", table):
        exists = (README.parent / name).is_file()
        assert exists != bool(bold) or "NAME" in name, name
