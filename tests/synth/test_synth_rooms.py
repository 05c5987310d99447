"""Imports between the rooms of dvo/synth, which point one way."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import dvo.synth

FOLDER = Path(dvo.synth.__file__).parent
# A room may import these rooms, itself, and the files in BASE. Files outside the rooms import what they need.
ARROWS: dict[str, set[str]] = {
    "textures": set(),
    "sensors": set(),
    "meshes": {"textures"},
    "surroundings": set(),
    "scenes": {"textures"},
    "render": {"scenes", "meshes", "textures"},
    "motion": {"render", "scenes"},
}
BASE = {"salts", "protocols"}
FIRST = {"textures": "texture", "sensors": "sensor", "meshes": "mesh", "scenes": "scene", "render": "renderer",
         "motion": "motion", "surroundings": "canvas"}  # fmt: skip


def imported(file: Path) -> Iterator[tuple[int, str]]:
    """Line and first name below ``dvo.synth`` of every import, also inside functions."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno} relative import"
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for module in modules:
            if module.startswith("dvo.synth."):
                yield node.lineno, module.split(".")[2]


def test_every_room_has_its_arrows_and_a_first_file() -> None:
    rooms = {folder.name for folder in FOLDER.iterdir() if (folder / "__init__.py").is_file()}
    assert rooms == set(ARROWS)
    for room, name in FIRST.items():
        assert (FOLDER / room / f"{name}.py").is_file()


def test_arrows_have_no_cycle() -> None:
    placed: set[str] = set()
    while placed != set(ARROWS):
        ready = {room for room, below in ARROWS.items() if below <= placed} - placed
        assert ready, "a cycle"
        placed |= ready


@pytest.mark.parametrize("room", ARROWS)
def test_imports_follow_the_arrows(room: str) -> None:
    for file in sorted((FOLDER / room).rglob("*.py")):
        for line, name in imported(file):
            assert name in ARROWS[room] | {room} | BASE, f"{file}:{line}: {room} must not import {name}"


@pytest.mark.parametrize("name", sorted(BASE))
def test_the_base_imports_no_room(name: str) -> None:
    assert list(imported(FOLDER / f"{name}.py")) == []
