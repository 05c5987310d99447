"""Systems outside the registry: how a file ``FILE.py:NAME`` is loaded, and how a class is called.

NAME is a class, or a function, that makes an :class:`dvo.odometry.protocol.Odometry`.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


def is_plugin(target: str) -> bool:
    """Return True if a target has the form ``FILE.py:NAME``."""
    file, colon, _ = target.rpartition(":")
    return bool(colon) and file.endswith(".py")


def missing(target: str) -> str | None:
    """Reason why a target cannot be loaded, or None; looks for its file or module without running it."""
    place = target.rpartition(":")[0]
    if is_plugin(target):
        return None if Path(place).is_file() else f"no such file: {place}"
    try:
        there = importlib.util.find_spec(place) is not None
    except (ImportError, ValueError):  # a parent package is missing
        there = False
    return None if there else f"no module {place}; install it, or set PYTHONPATH"


def version(target: str) -> str:
    """First eight digits of the hash of a plugin's file."""
    return hashlib.sha256(Path(target.rpartition(":")[0]).read_bytes()).hexdigest()[:8]


def load(target: str) -> Callable[..., Any]:
    """Run the file of a plugin and return the object of its name.

    Args:
        target: ``FILE.py:NAME``.

    Raises:
        ImportError: the file is no Python file.
        AttributeError: it has no such name.
    """
    file, _, attribute = target.rpartition(":")
    spec = importlib.util.spec_from_file_location(f"dvo_eval_{Path(file).stem}", Path(file).resolve())
    if spec is None or spec.loader is None:
        raise ImportError(f"{file} is no Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return getattr(module, attribute)


def call(function: Callable[..., Any], offered: Mapping[str, Any], required: Mapping[str, Any] | None = None) -> Any:
    """Call a function with those of the offered arguments that it names, and with all of the required ones.

    Args:
        function: a class or function.
        offered: arguments by name; one that the function does not name is left out.
        required: arguments by name; one that the function does not take is its own TypeError.

    Returns:
        What the function returns.
    """
    names = inspect.signature(function).parameters
    return function(**{name: value for name, value in offered.items() if name in names} | dict(required or {}))
