"""Names of exchangeable parts, resolved when they are used.

A registry maps a name to ``"module:attribute"``. Nothing is imported before a name is looked up, so a registry costs
nothing at start-up, and a part of another package is added without editing a file of this one:

- by a call, ``READERS.register("mine", "my_package.reader:READER")``;
- by an entry point of the package, in the group that the registry names::

      [project.entry-points."dvo.readers"]
      mine = "my_package.reader:READER"
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Any

from dvo.errors import DvoError


class Registry:
    """Parts of one kind by name, in the order of registration.

    Args:
        kind: noun for messages, for instance ``"reader"``.
        group: group of entry points in which other packages announce parts; None for none.
        targets: the parts that are there from the start, ``name: "module:attribute"``.

    Example:
        >>> models = Registry("architecture", "dvo.architectures", {"patch_vo": "dvo.models.patch_vo:PatchVO"})
        >>> models.resolve("patch_vo").__name__
        'PatchVO'
    """

    def __init__(self, kind: str, group: str | None = None, targets: dict[str, str] | None = None) -> None:
        self.kind, self.group = kind, group
        self._targets: dict[str, str] = {}
        self._announced: dict[str, str] | None = None
        for name, target in (targets or {}).items():
            self.register(name, target)

    def register(self, name: str, target: str, *, replace: bool = False) -> None:
        """Add a part.

        Args:
            name: by which it is looked up.
            target: ``"module:attribute"``.
            replace: allow a name that is taken.

        Raises:
            DvoError: a target of another form, or a name that stands for another target already.
        """
        if not is_target(target):
            raise DvoError(
                f"'{target}' is not 'module:attribute'", field=name, remedy="name a module and its attribute"
            )
        if not replace and self._targets.get(name, target) != target:
            raise DvoError(f"there is another {self.kind} '{name}'", field=name, remedy="choose another name")
        self._targets[name] = target

    def unregister(self, name: str) -> None:
        """Remove a registered part; a name that is not there is no error."""
        self._targets.pop(name, None)

    def target(self, name: str) -> str:
        """``"module:attribute"`` of a name.

        Raises:
            DvoError: no such name.
        """
        targets = self._all()
        if name not in targets:
            raise DvoError(f"no {self.kind} '{name}'", field=self.kind, remedy=f"use one of {', '.join(targets)}")
        return targets[name]

    def resolve(self, name: str) -> Any:
        """The part of that name.

        Raises:
            DvoError: no such name, or its module or attribute cannot be imported.
        """
        return resolve_target(self.target(name), self.kind)

    def __contains__(self, name: object) -> bool:
        return name in self._all()

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def _all(self) -> dict[str, str]:
        if self._announced is None:
            from importlib.metadata import entry_points  # slow to import

            found = entry_points(group=self.group) if self.group else ()
            self._announced = {entry.name: entry.value for entry in found if is_target(entry.value)}
        return {**self._announced, **self._targets}


def is_target(text: str) -> bool:
    """Whether a text has the form ``module:attribute`` (and is neither a Windows path nor a URL)."""
    module, separator, attribute = text.partition(":")
    return bool(separator) and attribute.isidentifier() and all(part.isidentifier() for part in module.split("."))


def resolve_target(target: str, kind: str = "part") -> Any:
    """Import ``"module:attribute"``.

    Raises:
        DvoError: the module or the attribute is not there; an error inside the module is passed on as it is.
    """
    module, _, attribute = target.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # a dependency of the module is missing: its name says more than ours
        raise DvoError(f"no module '{module}'", field=kind, remedy="install it, or set PYTHONPATH") from error
    except AttributeError as error:
        raise DvoError(f"'{module}' has no '{attribute}'", field=kind, remedy="check the name") from error
