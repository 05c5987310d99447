"""Registries of odometries: of networks, by their architecture, and of systems without weights, by name."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, Protocol, cast

from dvo.core.errors import DvoError
from dvo.core.registry import Registry
from dvo.core.text import choice
from dvo.models.weights import LoadedWeights
from dvo.odometry.protocol import Odometry

ODOMETRIES = Registry(
    "odometry",
    "dvo.odometries",
    {
        "patch_vo": "dvo.odometry.load:patch_odometry",
        "deepvo": "dvo.odometry.two_frame.deepvo:deepvo_odometry",
        "tartanvo": "dvo.odometry.two_frame.tartanvo:tartan_odometry",
        "droid": "dvo.odometry.droid.droid:droid_odometry",
    },
)
"""Architecture name to ``"module:function"`` or ``"module:Class"`` of an :class:`OdometryBuilder`."""

SETTINGS = {
    "patch_vo": "dvo.odometry.patch.config:TrackerConfig",
    "droid": "dvo.odometry.droid.config:DenseConfig",
    "deepvo": "dvo.odometry.two_frame.deepvo:RegressionConfig",
    "tartanvo": "dvo.odometry.two_frame.tartanvo:TwoFrameConfig",
}
"""Architecture to the settings of its odometry, whose module has their ``PRESETS``."""

_CLASSICAL = "dvo.odometry.classical"
SYSTEMS = Registry(
    "system",
    "dvo.systems",
    {
        "klt-pnp": f"{_CLASSICAL}.klt_pnp:KltPnp",
        "keyframe": f"{_CLASSICAL}.keyframe.system:KeyframeOdometry",
        "direct": f"{_CLASSICAL}.direct.system:DirectOdometry",
        "monoslam": f"{_CLASSICAL}.monoslam.slam:MonoSlam",
        "msckf": f"{_CLASSICAL}.msckf.system:Msckf",
    },
)
"""Name to ``"module:Class"`` of an odometry without weights, called with its settings and, if it takes it, the seed."""


class OdometryBuilder(Protocol):
    """Interface of a function, or class, that builds an odometry from a network."""

    def __call__(
        self, weights: LoadedWeights, *, device: Any = "cpu", seed: int = 0, config: Any = None, **overrides: Any
    ) -> Odometry:
        """Build an odometry that tracks one sequence.

        Args:
            weights: the network with its name and preset.
            device: of all computation.
            seed: of all random numbers of the odometry.
            config: settings, of a type that the odometry defines; None for those of the preset.
            overrides: single settings.

        Returns:
            The odometry.

        Raises:
            DvoError: an unknown setting.
        """
        ...


def odometry_builder(architecture: str) -> OdometryBuilder:
    """Builder of the odometry for an architecture.

    Args:
        architecture: name of the architecture.

    Returns:
        The builder.

    Raises:
        DvoError: an architecture without an odometry.
    """
    if architecture not in ODOMETRIES:
        raise DvoError(
            f"there is no odometry for networks of the architecture '{architecture}'",
            field="architecture",
            remedy=f"use weights of {', '.join(ODOMETRIES)}, or dvo.load_model for the bare network",
        )
    return cast(OdometryBuilder, ODOMETRIES.resolve(architecture))


def build_system(name: str, seed: int, settings: Mapping[str, Any]) -> Odometry:
    """Build an odometry without weights, for one sequence.

    Args:
        name: in :data:`SYSTEMS`.
        seed: of all random numbers of the odometry.
        settings: by the names of its configuration.

    Returns:
        The odometry.

    Raises:
        DvoError: an unknown or invalid setting.
    """
    build = SYSTEMS.resolve(name)
    taken = inspect.signature(build).parameters
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in taken.values()):
        unknown = sorted(set(settings) - set(taken))
        if unknown:
            raise DvoError(f"unknown setting of {name}", field=unknown[0], remedy=choice(unknown[0], taken))
    return cast(Odometry, build(**({"seed": seed} if "seed" in taken else {}), **settings))
