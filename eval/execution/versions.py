"""Dependencies of a system's result: its source files, found by following imports, and the libraries beneath."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from dvo.core.registry import Registry
from dvo.data.readers.registry import READERS
from eval.suites.suite import ROOT
from eval.systems import plugin
from eval.systems.system import System

LIBRARIES = ("numpy", "opencv-python-headless", "opencv-python", "scipy", "torch")
# Rooms of the library that cannot change a trajectory, or whose output is part of the sequence's own fingerprint.
WITHOUT = (
    "dvo.viz",
    "dvo.synth",
    "dvo.commands",
    "dvo.cli",
    "dvo.demo",
    "dvo.losses",
    "dvo.metrics",
    "dvo.metrics.segment_metrics",
)
TORCH_ROOMS = (ROOT / "dvo" / "ba", ROOT / "dvo" / "nets")
_OWN = ("dvo", "eval")


def source_files(system: System) -> list[Path]:
    """Python files on which a system depends: that of its target and what it imports, as far as that is followed.

    Followed are modules of ``eval`` and ``dvo`` and of the package of the target, imports inside functions and names
    of modules in strings included (parts that are looked up by name count all). Other packages count by their version.
    """
    place = system.target.rpartition(":")[0]
    found: dict[str, Path] = {}
    if plugin.is_plugin(system.target):
        file = Path(place).resolve()
        if file.is_file():
            found[place] = file
            for name in _imports_of(file, "", _OWN):
                _follow(name, found)
    else:
        _follow(place, found, (*_OWN, place.split(".")[0]))
    if "dvo.odometry.load" in found:  # weights name a network, which other packages may bring
        from dvo.models.registry import ARCHITECTURES
        from dvo.nets.update.update import UPDATE_OPERATORS
        from dvo.odometry.registry import ODOMETRIES

        for registry in (ARCHITECTURES, ODOMETRIES, UPDATE_OPERATORS):
            _follow_registered(registry, found)
    return sorted(found.values())


def code_digest(system: System) -> str:
    """Hash of :func:`source_files`.

    Args:
        system: its target need not be importable.

    Returns:
        Sixteen hexadecimal digits.
    """
    return _digest(source_files(system))


def reader_digest() -> str:
    """Hash of the code that turns files into frames."""
    found: dict[str, Path] = {}
    _follow("dvo.data.open", found)
    _follow_registered(READERS, found)
    return _digest(sorted(found.values()))


def library_versions(libraries: tuple[str, ...] = LIBRARIES) -> dict[str, str]:
    """Versions of the libraries on which numbers depend, those that are installed.

    Args:
        libraries: names of distributions.

    Returns:
        Version by name.
    """
    found = {}
    for name in libraries:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def depends_on_threads(system: System) -> bool:
    """Return True if the number of threads may change the trajectory.

    Networks and bundle adjustment on torch sum in an order that depends on it, and so may a system of another package
    that imports torch.
    """
    files = source_files(system)
    return any(
        any(file.is_relative_to(room) for room in TORCH_ROOMS)
        or (not file.is_relative_to(ROOT) and "torch" in _top_imports(file))
        for file in files
    )


def _digest(files: list[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        name = file.relative_to(ROOT) if file.is_relative_to(ROOT) else file.name
        digest.update(str(name).encode() + b"\0" + _content(file) + b"\0")
    return digest.hexdigest()[:16]


def _follow(module: str, found: dict[str, Path], tops: tuple[str, ...] = _OWN) -> None:
    if module in found or module.startswith(WITHOUT):
        return
    file = _file(module, tops)
    if file is None:
        return
    found[module] = file
    for name in _imports_of(file, module, tops):
        _follow(name, found, tops)


def _follow_registered(registry: Registry, found: dict[str, Path]) -> None:
    """Follow the modules of all parts of a registry, those of other packages included."""
    for name in registry:
        module = registry.target(name).partition(":")[0]
        _follow(module, found, (*_OWN, module.split(".")[0]))


def _imports_of(file: Path, module: str, tops: tuple[str, ...]) -> tuple[str, ...]:
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    return _imports_in(_content(file), package, tops)


@cache
def _imports_in(content: bytes, package: str, tops: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(_imported(ast.parse(content), package, tops))


def _imported(tree: ast.AST, package: str, tops: tuple[str, ...]) -> Iterator[str]:
    """Modules that a tree imports, inside functions too, or names in a string: ``"module"``, ``"module:attribute"``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if _file(alias.name, tops))
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            base = ".".join(part for part in (base, node.module) if part)
            if _file(base, tops):
                yield base
            yield from (name for alias in node.names if _file(name := f"{base}.{alias.name}", tops))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            name = node.value.partition(":")[0]
            if "." in name and _file(name, tops):
                yield name


def _top_imports(file: Path) -> frozenset[str]:
    """Top-level packages that a file imports."""
    nodes = list(ast.walk(ast.parse(_content(file))))
    direct = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    direct += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and not node.level]
    return frozenset(name.split(".")[0] for name in direct)


def _file(module: str, tops: tuple[str, ...]) -> Path | None:
    """Source file of a module below one of some top-level packages."""
    parts = module.split(".")
    if parts[0] not in tops or not all(part.isidentifier() for part in parts):
        return None
    base = (ROOT if parts[0] in _OWN else _parent(parts[0])).joinpath(*parts)
    return next((file for file in (base.with_suffix(".py"), base / "__init__.py") if file.is_file()), None)


def _parent(top: str) -> Path:
    """Folder in which a top-level package or module lies."""
    try:
        spec = find_spec(top)
    except ValueError:  # a module made at run time
        spec = None
    if spec is None:
        return ROOT
    if spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations))).parent
    return Path(spec.origin or ROOT).parent


def _content(file: Path) -> bytes:
    return file.read_bytes()
