"""The arrows between the rooms, and the habits that the linter does not know."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
LIBRARY = sorted((ROOT / "dvo").rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
EVERYTHING = LIBRARY + [file for folder in ("train", "eval") for file in sorted((ROOT / folder).rglob("*.py"))]

# A room may import these rooms, itself, and dvo.core.errors.
ARROWS: dict[str, set[str]] = {
    "errors": set(),
    "allocator": set(),
    "registry": set(),
    "settings": set(),
    "yaml_files": set(),
    "threads": set(),
    "geometry": set(),
    "data": {"geometry"},
    "boards": {"data", "geometry"},
    "ba": {"geometry"},
    "metrics": {"data", "geometry"},
    "segment_metrics": {"metrics", "odometry", "data", "geometry"},
    "relative_pose": {"segment_metrics", "metrics", "odometry", "data", "geometry"},
    "graph": {"ba", "data", "geometry"},
    "nets": {"geometry", "ba", "data", "graph"},
    "models": {"nets", "graph", "ba", "data", "geometry"},
    "synth": {"geometry", "ba", "data"},
    "losses": {"geometry"},
    "odometry": {"models", "graph", "nets", "ba", "data", "geometry", "threads"},
    "export": {"odometry", "graph", "nets", "data", "geometry"},
    "viz": {"boards", "data", "geometry", "odometry"},
}
TOP = {"cli", "commands", "demo", "__main__", "__init__"}  # these know everything, nobody below knows them


def room_of(file: Path) -> str:
    return file.relative_to(ROOT / "dvo").parts[0].removesuffix(".py")


def imports(file: Path) -> Iterator[tuple[int, str]]:
    """Line and full module name of every import, also inside functions."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = file.relative_to(ROOT).parent.parts
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            yield node.lineno, module
            yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)


def name(file: Path) -> str:
    return str(file.relative_to(ROOT))


def test_every_room_has_its_arrows() -> None:
    rooms = {room_of(file) for file in LIBRARY}
    assert {"geometry", "data", "odometry"} <= rooms
    assert rooms - set(ARROWS) <= TOP, "a new room needs a row in ARROWS, here and in the README"


@pytest.mark.parametrize("file", LIBRARY, ids=name)
def test_imports_follow_the_arrows(file: Path) -> None:
    room = room_of(file)
    for line, module in imports(file):
        parts = module.split(".")
        assert parts[0] not in ("train", "eval", "tests"), f"{name(file)}:{line} imports {module}"
        if room in TOP or parts[0] != "dvo":
            continue
        target = parts[1] if len(parts) > 1 else "__init__"
        if target == "__init__" or not is_module(target):
            # `import dvo` or `from dvo import X`: only the package's own names, which need no room
            assert parts[1:] in ([], ["__version__"], ["DvoError"]), f"{name(file)}:{line} imports {module}"
            continue
        allowed = ARROWS[room] | {room, "errors", "registry", "settings", "yaml_files"}
        assert target in allowed, f"{name(file)}:{line}: {room} must not know {target}"


@pytest.mark.parametrize("file", TESTS, ids=name)
def test_tests_share_only_what_lies_in_support(file: Path) -> None:
    own = "tests.fuzz" if (ROOT / "tests" / "fuzz") in file.parents else "tests.support"
    for line, module in imports(file):
        if module.split(".")[0] == "tests":
            assert any(f"{module}.".startswith(f"{room}.") for room in ("tests.support", own)), (
                f"{name(file)}:{line} imports {module}: what tests share belongs into tests/support"
            )
            last = module.rsplit(".", 1)[-1]
            assert not last.startswith("test_"), f"{name(file)}:{line} imports a test's file, {module}"


def is_module(target: str) -> bool:
    return (ROOT / "dvo" / target).is_dir() or (ROOT / "dvo" / f"{target}.py").is_file()


@pytest.mark.parametrize("file", EVERYTHING, ids=name)
def test_habits(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    tree = ast.parse(text)
    asked = {id(part) for node in ast.walk(tree) if isinstance(node, ast.Compare) for part in node.comparators}
    for node in ast.walk(tree):
        where = f"{name(file)}:{getattr(node, 'lineno', 0)}"
        assert not (isinstance(node, ast.ExceptHandler) and node.type is None), f"{where} bare except"
        if isinstance(node, ast.ImportFrom):
            assert all(alias.name != "*" for alias in node.names), f"{where} import *"
        # Asking what a device is (device.type == ...) is fine, choosing one is not.
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in asked:
            assert node.value != "cuda" and not node.value.startswith("cuda:"), f"{where} names a device"
        if isinstance(node, ast.Attribute) and node.attr == "cuda":  # torch.backends.cuda is a setting, not a device
            assert ast.unparse(node.value) == "torch.backends", f"{where} names a device"
