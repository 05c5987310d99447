"""What the result of a system depends on: its source files, found by following imports, and the libraries beneath."""

from __future__ import annotations

import ast
import hashlib
import inspect
import textwrap
from collections.abc import Iterator
from functools import cache
from importlib import metadata
from pathlib import Path

from dvo.data.registry import READERS
from eval.suites.suite import ROOT
from eval.systems.registry import System

LIBRARIES = ("numpy", "opencv-python-headless", "opencv-python", "scipy", "torch")
# Rooms of the library that cannot change a trajectory, or whose output is part of the sequence's own fingerprint.
WITHOUT = ("dvo.viz", "dvo.synth", "dvo.commands", "dvo.cli", "dvo.demo", "dvo.losses", "dvo.metrics")
SYSTEMS = ("baselines", "peers")


def source_files(system: System) -> list[Path]:
    """The files of this checkout that a system runs: everything that its ``build`` imports, and what that imports.

    A builder that names no module of ``eval`` or ``dvo`` (it may find its class in another way) depends on all
    baselines and peers: running once too often is the lesser evil.
    """
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(system.build)))
    except (OSError, TypeError, SyntaxError):
        tree = ast.Module([], [])
    starts = [module for module in _imported(tree, "eval") if module != "eval.systems.registry"]
    if any(isinstance(node, ast.Name) and node.id == "dvo" for node in ast.walk(tree)):  # dvo.load(...)
        starts.append("dvo.odometry.tracker")
    found: dict[str, Path] = {}
    for module in starts:
        _follow(module, found)
    if not found:
        return sorted(file for folder in SYSTEMS for file in (ROOT / "eval" / "systems" / folder).rglob("*.py"))
    return sorted(found.values())


def code_digest(system: System) -> str:
    """A hash of :func:`source_files`."""
    return _digest(source_files(system))


def reader_digest() -> str:
    """A hash of the code that turns files into frames."""
    found: dict[str, Path] = {}
    for module in ("dvo.data.source", *(READERS.target(name).partition(":")[0] for name in READERS)):
        _follow(module, found)
    return _digest(sorted(found.values()))


def library_versions(libraries: tuple[str, ...] = LIBRARIES) -> dict[str, str]:
    """Versions of the libraries on which numbers depend, those that are installed."""
    found = {}
    for name in libraries:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def feels_threads(system: System) -> bool:
    """Whether the number of threads may change the trajectory: systems on torch sum in an order of their own."""
    torch_rooms = (ROOT / "dvo" / "ba", ROOT / "dvo" / "nets")
    return any(
        file.is_relative_to(room) for file in source_files(system) for room in torch_rooms
    ) or system.name.startswith("dvo")


def _digest(files: list[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(str(file.relative_to(ROOT)).encode() + b"\0" + _content(file) + b"\0")
    return digest.hexdigest()[:16]


def _follow(module: str, found: dict[str, Path]) -> None:
    if module in found or module.startswith(WITHOUT):
        return
    file = _file(module)
    if file is None:
        return
    found[module] = file
    for name in _imports_of(file, module):
        _follow(name, found)


@cache
def _imports_of(file: Path, module: str) -> tuple[str, ...]:
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    return tuple(_imported(ast.parse(_content(file)), package))


def _imported(tree: ast.AST, package: str) -> Iterator[str]:
    """Modules of this checkout that a tree imports, inside functions too, or names in a string."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if _file(alias.name))
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            base = ".".join(part for part in (base, node.module) if part)
            if _file(base):
                yield base
            yield from (name for alias in node.names if _file(name := f"{base}.{alias.name}"))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            name = node.value.partition(":")[0]
            if name.startswith(("eval.systems.baselines.", "eval.systems.peers.")) and _file(name):
                yield name


def _file(module: str) -> Path | None:
    if module.split(".")[0] not in ("eval", "dvo"):
        return None
    if not all(part.isidentifier() for part in module.split(".")):
        return None
    base = ROOT.joinpath(*module.split("."))
    return next((file for file in (base.with_suffix(".py"), base / "__init__.py") if file.is_file()), None)


@cache
def _content(file: Path) -> bytes:
    return file.read_bytes()
