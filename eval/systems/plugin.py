"""A system of one's own: ``FILE.py:NAME``, where NAME makes an :class:`dvo.odometry.protocol.Odometry`.

NAME is called as ``NAME(seed=seed, device=device)``, with those of the two that it accepts.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
from pathlib import Path
from typing import Any

from dvo.odometry.protocol import Odometry


def is_plugin(name: str) -> bool:
    """Whether a system's name is of this kind."""
    file, colon, _ = name.rpartition(":")
    return bool(colon) and file.endswith(".py")


def missing(name: str) -> str | None:
    """Why it cannot run, or None."""
    file = name.rpartition(":")[0]
    return None if Path(file).is_file() else f"no such file: {file}"


def version(name: str) -> str:
    """A hash of the file; what it imports is not followed."""
    return hashlib.sha256(Path(name.rpartition(":")[0]).read_bytes()).hexdigest()[:8]


def build(name: str, seed: int, device: str) -> Odometry:
    """Load the file and make the odometry."""
    file, _, attribute = name.rpartition(":")
    spec = importlib.util.spec_from_file_location(f"dvo_eval_{Path(file).stem}", Path(file).resolve())
    if spec is None or spec.loader is None:
        raise ImportError(f"{file} is no Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    make: Any = getattr(module, attribute)
    options = {"seed": seed, "device": device}
    accepted = inspect.signature(make).parameters
    return make(**{key: value for key, value in options.items() if key in accepted})
