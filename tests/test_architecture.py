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

# A room may import these rooms, itself, and dvo.core.
ARROWS: dict[str, set[str]] = {
    "core": set(),
    "geometry": set(),
    "data": {"geometry"},
    "boards": {"data", "geometry"},
    "ba": {"geometry"},
    "map": {"ba", "data", "geometry"},
    "nets": {"geometry", "map"},
    "models": {"nets", "map", "ba", "data", "geometry"},
    "losses": {"geometry"},
    "synth": {"geometry", "data"},
    "odometry": {"models", "map", "nets", "ba", "data", "geometry"},
    "metrics": {"odometry", "data", "geometry"},
    "session": {"odometry", "map", "data", "geometry"},
    "export": {"session", "odometry", "map", "nets", "data", "geometry"},
    "viz": {"session", "boards", "data", "geometry", "odometry"},
}
# Inside of these two a room, or a file between rooms, may import those that stand before it.
FLOORS: dict[str, tuple[str, ...]] = {
    "data": (
        "files", "images", "interval", "frame", "trajectory", "extrinsics", "calibration", "sensors", "recording",
        "mask", "frame_checks", "readers", "opening", "source", "companions", "streams", "open",
    ),
    "odometry": (
        "quality", "protocol", "exclusive", "registry", "segments", "frames", "window", "uncertainty", "depth",
        "global_ba", "maintenance", "loops", "scale", "checks", "patch", "two_frame", "droid", "classical", "load",
        "load_map", "merging", "calibration",
    ),
}  # fmt: skip
TOP = {"cli", "commands", "demo", "moved", "__main__", "__init__"}  # these know everything, nobody below knows them


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
            assert parts[1:] in ([], ["__version__"]), f"{name(file)}:{line} imports {module}"
            continue
        allowed = ARROWS[room] | {room, "core"}
        assert target in allowed, f"{name(file)}:{line}: {room} must not know {target}"


def floor_of(room: str, parts: tuple[str, ...]) -> int:
    """Floor of a file or module by the parts of its name within a room; above all of them for the room's own face."""
    place = parts[0].removesuffix(".py") if parts else "__init__"
    return len(FLOORS[room]) if place == "__init__" else FLOORS[room].index(place)


@pytest.mark.parametrize("room", FLOORS)
def test_inside_of_a_room_imports_go_down(room: str) -> None:
    for file in sorted((ROOT / "dvo" / room).rglob("*.py")):
        floor = floor_of(room, file.relative_to(ROOT / "dvo" / room).parts)
        for line, module in imports(file):
            parts = tuple(module.split("."))
            if parts[:2] == ("dvo", room) and len(parts) > 2 and is_module("/".join(parts[1:3])):
                assert floor_of(room, parts[2:]) <= floor, f"{name(file)}:{line} imports {module}, which stands above"


def test_no_file_stands_in_a_circle() -> None:
    """Local imports and those for types alone are counted too."""
    modules = {".".join(file.relative_to(ROOT).with_suffix("").parts): file for file in LIBRARY}
    known = {module.removesuffix(".__init__"): module for module in modules}

    def taken_by(module: str, file: Path) -> set[str]:
        found = {target for _, target in imports(file) if target in known}
        # `from package import module` asks for the module alone, whatever else the face of the package hands on.
        found -= {target.rpartition(".")[0] for target in found}
        return {known[target] for target in found} - {module}

    taken = {module: taken_by(module, file) for module, file in modules.items()}
    while free := [module for module, others in taken.items() if not others & taken.keys()]:
        for module in free:
            del taken[module]
    assert not taken, f"these import each other: {sorted(taken)}"


@pytest.mark.parametrize("file", TESTS, ids=name)
def test_tests_share_only_what_lies_in_support(file: Path) -> None:
    programs = (room for room in ("fuzz", "faults") if (ROOT / "tests" / room) in file.parents)
    own = f"tests.{next(programs, 'support')}"
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
