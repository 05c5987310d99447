"""The engine depends on no network, and the tasks do not depend on studies and validation."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
FORBIDDEN = {
    "engine": (
        "dvo.models.patch_vo",
        "dvo.nets",
        "train.tasks.patch_vo",
        "train.studies",
        "train.validation",
        "train.data",
    ),
    "data": ("dvo.models", "dvo.nets", "train.tasks", "train.studies", "train.validation"),
    "tasks": ("train.studies", "train.validation", "train.engine.program", "train.engine.build", "train.engine.cli"),
    "validation": ("dvo.models.patch_vo", "train.tasks", "train.studies"),
}  # fmt: skip


def imported(file):
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("room", FORBIDDEN)
def test_imports_follow_the_arrows(room):
    forbidden = tuple(f"{name}." for name in FORBIDDEN[room])
    for file in sorted((ROOT / "train" / room).rglob("*.py")):
        for module in imported(file):
            assert not f"{module}.".startswith(forbidden), f"{file} imports {module}"


def file_of(module):
    parts = module.split(".")
    found = [ROOT.joinpath(*parts).with_suffix(".py"), ROOT.joinpath(*parts[:-1]).with_suffix(".py")]
    return next((file for file in found if parts[0] in ("dvo", "train") and file.is_file()), None)


def test_the_engine_does_not_reach_a_network_through_other_modules():
    waiting, seen = list((ROOT / "train" / "engine").glob("*.py")), set()
    while waiting:
        file = waiting.pop()
        if file not in seen:
            seen.add(file)
            waiting += [found for module in imported(file) if (found := file_of(module))]
    names = {str(file.relative_to(ROOT)) for file in seen}
    assert {"train/engine/program.py", "train/tasks/task.py", "dvo/models/registry.py"} <= names
    assert not [name for name in names if "patch_vo" in name]
