"""Sizes of networks: their plain values in files, checks of lists of sizes, presets by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self, TypeVar, get_origin, get_type_hints

from dvo.core.errors import DvoError
from dvo.core.settings import check_names, shown

C = TypeVar("C")


@dataclass(frozen=True)
class Sizes:
    """Base of the configurations of networks, each a :class:`dvo.models.registry.NetworkConfig`.

    Example:
        >>> @dataclass(frozen=True)
        ... class RegressorConfig(Sizes):
        ...     channels: tuple[int, ...] = (8, 16)
        >>> RegressorConfig.from_dict({"channels": [4, 4]})
        RegressorConfig(channels=(4, 4))
    """

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for the metadata of weights.

        Returns:
            Attribute name to value.
        """
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Build from plain values, for instance of a YAML file or of weights metadata.

        Args:
            values: attribute name to value; attributes that are missing take their defaults, and lists become tuples
                where the attribute is one.

        Returns:
            The configuration.

        Raises:
            DvoError: an unknown attribute, or an invalid size.
        """
        check_names(cls, values)
        hints = get_type_hints(cls)
        lists = {name for name, value in values.items() if isinstance(value, list) and get_origin(hints[name]) is tuple}
        return cls(**{name: tuple(value) if name in lists else value for name, value in values.items()})


def check_sizes(sizes: Any, field: str, count: tuple[int, int], largest: int) -> None:
    """Check a list of sizes, such as the channels of the layers of a network.

    Args:
        sizes: a tuple of whole numbers from 1 on.
        field: its name.
        count: smallest and largest number of sizes, both inclusive.
        largest: size.

    Raises:
        DvoError: anything else, with the name of the field.
    """
    low, high = count
    if not isinstance(sizes, tuple) or not low <= len(sizes) <= high:
        wanted = f"{low}" if low == high else f"{low} to {high}"
        raise DvoError(f"not a list of {wanted} sizes: {shown(sizes)}", field=field, remedy=f"give {wanted} numbers")
    if not all(isinstance(size, int) and not isinstance(size, bool) and 1 <= size <= largest for size in sizes):
        remedy = f"give whole numbers from 1 to {largest}"
        raise DvoError(f"out of range: {shown(sizes)}", field=field, remedy=remedy)


def named_preset(presets: Mapping[str, C], name: Any, field: str = "preset") -> C:
    """Configuration of a preset.

    Args:
        presets: configurations by name.
        name: of the preset.
        field: setting that names it.

    Returns:
        The configuration.

    Raises:
        DvoError: no such preset.
    """
    if not isinstance(name, str) or name not in presets:
        raise DvoError(f"no preset {shown(name)}", field=field, remedy=f"use one of {', '.join(presets)}")
    return presets[name]
