"""Description of a system, from which odometries are made: a class, its settings, and facts for the tables."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import dvo
from dvo.core.registry import resolve_target
from dvo.odometry.protocol import Odometry
from eval.systems import plugin

_OWN = ("dvo", "eval")


@dataclass(frozen=True)
class System:
    """Description of a system; makes odometries of it.

    Attributes:
        name: in the tables.
        target: ``"module:Class"`` or ``"FILE.py:Class"``; called with the settings, and with ``seed`` and ``device``
            if it accepts them.
        settings: keyword arguments of the class.
        licence: of the code that runs.
        about: one line.
        version_from, missing_from: ``"module:function"`` that returns the version, or the reason why the system cannot
            run here (None if it can); called with those of the settings that it accepts. Empty for the default.
    """

    name: str
    target: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    licence: str = "MIT"
    about: str = ""
    version_from: str = ""
    missing_from: str = ""

    def build(self, seed: int, device: str) -> Odometry:
        """Odometry for one sequence.

        Args:
            seed: of everything random in it.
            device: where networks compute.

        Raises:
            DvoError: there is no such module or class.
        """
        make = plugin.load(self.target) if plugin.is_plugin(self.target) else resolve_target(self.target, "system")
        return plugin.call(make, {"seed": seed, "device": device}, self.settings)

    def version(self) -> str:
        """Version of what would run: of its package, or a hash of the file of a plugin."""
        if self.version_from:
            return str(plugin.call(resolve_target(self.version_from), self.settings))
        if plugin.is_plugin(self.target):
            return plugin.version(self.target)
        top = self.target.split(".")[0].split(":")[0]
        return dvo.__version__ if top in _OWN else package_facts(top).get("version", "-")

    def missing(self) -> str | None:
        """Reason why the system cannot run here, or None."""
        if self.missing_from:
            return plugin.call(resolve_target(self.missing_from), self.settings)
        return plugin.missing(self.target)

    def identity(self) -> dict[str, Any]:
        """Target and settings, JSON-able, for the key of a prediction; a file in the settings counts by its content."""
        return {"target": self.target, "settings": {name: _identity(value) for name, value in self.settings.items()}}


def package_facts(top: str) -> dict[str, str]:
    """Version, licence and summary of the distribution that holds a top-level module; empty if none does."""
    found = metadata.packages_distributions().get(top)
    if not found:
        return {}
    about = metadata.metadata(found[0])
    facts = {
        "version": about["Version"],
        "licence": about["License-Expression"] or about["License"],
        "about": about["Summary"],
    }
    return {name: value for name, value in facts.items() if value}


def _identity(value: Any) -> Any:
    if isinstance(value, str) and Path(value).is_file():
        return f"sha256:{hashlib.sha256(Path(value).read_bytes()).hexdigest()}"
    return value
