"""Registries of exchangeable components by name, imported on use.

A registry maps a name to ``"module:attribute"``. A module is imported only when its name is looked up, so a registry
adds nothing to the start-up time, and another package can add a component without a change here:

- by a call, ``READERS.register("mine", "my_package.reader:READER")``;
- by an entry point of the package, in the group of the registry::

      [project.entry-points."dvo.readers"]
      mine = "my_package.reader:READER"
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Any

from dvo.core.errors import DvoError
from dvo.core.text import choice


class Registry:
    """Components of one kind by name, in the order of registration.

    Args:
        kind: noun for messages, for instance ``"reader"``.
        group: group of the entry points by which other packages add components; None for none.
        targets: built-in components, ``name: "module:attribute"``.

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
        """Add a component.

        Args:
            name: key of the component.
            target: ``"module:attribute"``.
            replace: allow a name that is already in use.

        Raises:
            DvoError: a target of another form, or a name in use for another target.
        """
        if not is_target(target):
            raise DvoError(
                f"'{target}' is not 'module:attribute'", field=name, remedy="name a module and its attribute"
            )
        if not replace and self._targets.get(name, target) != target:
            raise DvoError(f"there is another {self.kind} '{name}'", field=name, remedy="choose another name")
        self._targets[name] = target

    def unregister(self, name: str) -> None:
        """Remove a registered component.

        Args:
            name: key of the component; an unknown name is ignored.
        """
        self._targets.pop(name, None)

    @property
    def registered(self) -> dict[str, str]:
        """Built-in and registered components, ``name: "module:attribute"``, without those that packages announce."""
        return dict(self._targets)

    def target(self, name: str) -> str:
        """Look up a target without importing it.

        Args:
            name: key of the component.

        Returns:
            ``"module:attribute"``.

        Raises:
            DvoError: no such name.
        """
        targets = self._all()
        if name not in targets:
            raise DvoError(f"no {self.kind} '{name}'", field=self.kind, remedy=choice(name, targets))
        return targets[name]

    def resolve(self, name: str) -> Any:
        """Import a component.

        Args:
            name: key of the component.

        Returns:
            The attribute that the target names.

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
    """Test for the form ``module:attribute``.

    Args:
        text: any text; neither Windows paths nor URLs have this form.

    Returns:
        True if the text has the form.
    """
    module, separator, attribute = text.partition(":")
    return bool(separator) and attribute.isidentifier() and all(part.isidentifier() for part in module.split("."))


def resolve_target(target: str, kind: str = "part") -> Any:
    """Import ``"module:attribute"``.

    Args:
        target: module and attribute.
        kind: noun for messages.

    Returns:
        The attribute.

    Raises:
        DvoError: the module or the attribute does not exist; an error inside the module is raised unchanged.
    """
    module, _, attribute = target.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # a dependency of the module is missing: the original error names it
        raise DvoError(f"no module '{module}'", field=kind, remedy="install it, or set PYTHONPATH") from error
    except AttributeError as error:
        raise DvoError(f"'{module}' has no '{attribute}'", field=kind, remedy="check the name") from error
