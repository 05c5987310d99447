"""Networks by the name of their architecture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Self, cast

from torch import nn

from dvo.core.errors import DvoError
from dvo.core.registry import Registry

DEFAULT_ARCHITECTURE = "patch_vo"
"""Architecture of weights files and training states that name none: they are older than the name."""

ARCHITECTURES = Registry(
    "architecture",
    "dvo.architectures",
    {
        "patch_vo": "dvo.models.patch_vo:PatchVO",
        "deepvo": "dvo.models.deepvo:DeepVO",
        "tartanvo": "dvo.models.tartanvo:TartanVO",
        "droid": "dvo.models.droid:DroidVO",
    },
)
"""Architecture name to ``"module:Class"`` of the network, a :class:`Network`."""


class NetworkConfig(Protocol):
    """Sizes of a network: a frozen dataclass that converts to and from plain values."""

    def to_dict(self) -> dict[str, Any]:
        """Values that JSON can hold."""
        ...

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Build from the values of :meth:`to_dict`.

        Raises:
            DvoError: an unknown setting.
        """
        ...


class Network(Protocol):
    """Class of a network: an ``nn.Module`` whose constructor takes its configuration alone.

    Attributes:
        architecture: name in :data:`ARCHITECTURES`; weights files and training states carry it.
        config_type: class of the configuration.
        presets: configurations with a name.
        config: configuration of this network.

    Example:
        >>> class Regressor(nn.Module):
        ...     architecture = "regressor"
        ...     config_type = RegressorConfig
        ...     presets = {"tiny": RegressorConfig(channels=8)}
        ...
        ...     def __init__(self, config: RegressorConfig) -> None:
        ...         super().__init__()
        ...         self.config = config
    """

    architecture: ClassVar[str]
    config_type: ClassVar[type[NetworkConfig]]
    presets: ClassVar[Mapping[str, NetworkConfig]]
    config: NetworkConfig

    def __init__(self, config: Any) -> None: ...


def network_class(architecture: str, file: object | None = None) -> type[Network]:
    """Network class of an architecture.

    Args:
        architecture: a registered name. ``"module:Class"`` is not accepted: the name may come from a file, and a file
            must not choose which code is imported.
        file: where the name was read, for the message.

    Raises:
        DvoError: no such architecture, or its module cannot be imported.
    """
    try:
        return cast(type[Network], ARCHITECTURES.resolve(architecture))
    except DvoError as error:
        remedy = f"{error.remedy}, or install the package that registers it"
        raise DvoError(error.message, file=file, field=error.field, remedy=remedy) from error


def build_network(architecture: str, config: NetworkConfig) -> nn.Module:
    """New network of an architecture, with random weights.

    Raises:
        DvoError: see :func:`network_class`.
    """
    return cast(nn.Module, network_class(architecture)(config))


def as_network(model: nn.Module) -> Network:
    """The same object, typed by what the registry requires of it.

    Raises:
        DvoError: a module that does not name its architecture and sizes.
    """
    for name in ("architecture", "config_type", "presets", "config"):
        if not hasattr(model, name):
            raise DvoError(
                f"a network needs the attribute '{name}'", field=type(model).__name__, remedy="see dvo.models.registry"
            )
    return cast(Network, model)


def preset_name(network: type[Network] | Network, config: NetworkConfig) -> str:
    """Name of the preset with these sizes, ``custom`` if there is none."""
    return next((name for name, known in network.presets.items() if known == config), "custom")
