"""The arrows between the rooms, and the habits that the linter does not know."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
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
        "files", "images", "interval", "inertial", "frame", "frame_checks", "positions", "trajectory", "extrinsics",
        "calibration", "inertial_files", "sensors", "recording", "mask", "readers", "opening", "source", "companions",
        "streams", "open",
    ),
    "odometry": (
        "quality", "protocol", "exclusive", "registry", "segments", "frames", "inertial", "window", "uncertainty",
        "depth", "global_ba", "maintenance", "loops", "scale", "checks", "patch", "two_frame", "droid", "classical",
        "load", "load_map", "merging", "calibration",
    ),
}  # fmt: skip
# These know all rooms, and those of them that stand before; no room knows them.
TOP = ("moved", "__init__", "commands", "demo", "cli", "batch_worker", "__main__")


def room_of(file: Path) -> str:
    return file.relative_to(ROOT / "dvo").parts[0].removesuffix(".py")


@cache
def look(file: Path) -> tuple[tuple[tuple[int, str], ...], tuple[str, ...]]:
    """Imports and bad habits of a file."""
    nodes = list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
    return tuple(imported(file, nodes)), tuple(bad_habits(file, nodes))


def imported(file: Path, nodes: list[ast.AST]) -> Iterator[tuple[int, str]]:
    """Line and full module name of every import, also inside functions."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = file.relative_to(ROOT).parent.parts
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            yield node.lineno, module
            yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)


def imports(file: Path) -> tuple[tuple[int, str], ...]:
    return look(file)[0]


def name(file: Path) -> str:
    return str(file.relative_to(ROOT))


def test_every_room_has_its_arrows() -> None:
    rooms = {room_of(file) for file in LIBRARY}
    assert {"geometry", "data", "odometry"} <= rooms
    assert rooms - set(ARROWS) <= set(TOP), "a new room needs a row in ARROWS, here and in the README"
    rows = list(ARROWS)
    for k, room in enumerate(rows):
        assert ARROWS[room] <= set(rows[:k]), f"{room} names rooms that stand after it"


def wrong_import(room: str, module: str) -> bool:
    parts = module.split(".")
    if parts[0] in ("train", "eval", "tests"):
        return True
    if parts[0] != "dvo":
        return False
    target = parts[1] if len(parts) > 1 else "__init__"
    if room in TOP:
        return target in TOP[TOP.index(room) + 1 :]
    if target == "__init__" or not is_module(target):
        # `import dvo` or `from dvo import X`: only the package's own names, which need no room
        return parts[1:] not in ([], ["__version__"])
    return target not in ARROWS[room] | {room, "core"}


@pytest.mark.long
@pytest.mark.parametrize("room", sorted({room_of(file) for file in LIBRARY}))
def test_imports_follow_the_arrows(room: str) -> None:
    wrong = [f"{name(file)}:{line}: {room} must not import {module}" for file in LIBRARY if room_of(file) == room
             for line, module in imports(file) if wrong_import(room, module)]  # fmt: skip
    assert not wrong, "\n".join(wrong)


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


@pytest.mark.long
def test_tests_share_only_what_lies_in_support() -> None:
    wrong = []
    for file in TESTS:
        programs = (room for room in ("fuzz", "faults") if (ROOT / "tests" / room) in file.parents)
        own = f"tests.{next(programs, 'support')}"
        for line, module in imports(file):
            shared = any(f"{module}.".startswith(f"{room}.") for room in ("tests.support", own))
            of_a_test = module.rsplit(".", 1)[-1].startswith("test_")
            if module.split(".")[0] == "tests" and (not shared or of_a_test):
                wrong.append(f"{name(file)}:{line} imports {module}: what tests share belongs into tests/support")
    assert not wrong, "\n".join(wrong)


@cache
def is_module(target: str) -> bool:
    return (ROOT / "dvo" / target).is_dir() or (ROOT / "dvo" / f"{target}.py").is_file()


def bad_habits(file: Path, nodes: list[ast.AST]) -> Iterator[str]:
    """Bare ``except``, ``import *``, temporary folders that may stay, and places that choose a device by its name."""
    asked = {id(part) for node in nodes if isinstance(node, ast.Compare) for part in node.comparators}
    for node in nodes:
        match node:
            case ast.ExceptHandler(type=None):
                fault = "bare except"
            case ast.ImportFrom(names=[ast.alias(name="*")]):
                fault = "import *"
            # Asking what a device is (device.type == ...) is fine, choosing one is not.
            case ast.Constant(value="cuda") if id(node) not in asked:
                fault = "names a device"
            case ast.Constant(value=str(value)) if value.startswith("cuda:") and id(node) not in asked:
                fault = "names a device"
            # torch.backends.cuda is a setting, not a device
            case ast.Attribute(attr="cuda") if ast.unparse(node.value) != "torch.backends":
                fault = "names a device"
            case ast.Attribute(attr="TemporaryDirectory" | "mkdtemp"):
                fault = "a folder that a killed process leaves behind, unlike that of scratch_folder"
            case _:
                continue
        yield f"{name(file)}:{node.lineno} {fault}"


@pytest.mark.long
@pytest.mark.parametrize("folder", ["dvo", "train", "eval"])
def test_habits(folder: str) -> None:
    wrong = [fault for file in EVERYTHING if name(file).startswith(folder) for fault in look(file)[1]]
    assert not wrong, "\n".join(wrong)


def test_bad_habits_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    file = tmp_path / "a.py"
    file.write_text(
        "from os import *\ntry:\n    x.cuda()\nexcept:\n    y = 'cuda:1'\n"
        "z = y == 'cuda' or torch.backends.cuda\nfrom .. import b\nz = tempfile.mkdtemp()\n"
    )
    assert sorted(look(file)[1])[:4] == [f"a.py:{line} {fault}" for line, fault in (
        (1, "import *"), (3, "names a device"), (4, "bare except"), (5, "names a device"))]  # fmt: skip
    assert len(look(file)[1]) == 5 and "a.py:8 a folder that a killed process leaves" in sorted(look(file)[1])[4]
