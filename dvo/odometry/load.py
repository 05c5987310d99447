"""Construction of odometries from weights, or of a system without, by name: ``dvo.load``."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from dvo.core.arguments import checked_arguments
from dvo.core.context import in_own_context
from dvo.core.errors import DvoError
from dvo.core.registry import resolve_target
from dvo.core.settings import check_seed
from dvo.core.threads import settle_threads
from dvo.models.weights import FOLDER, LoadedWeights, architecture_of, load_weights
from dvo.odometry.patch.config import PRESETS, TRACKER_PRESETS, TrackerConfig, with_changes
from dvo.odometry.protocol import Odometry
from dvo.odometry.registry import SETTINGS, SYSTEMS, build_system, odometry_builder

if TYPE_CHECKING:
    import torch

    from dvo.odometry.patch.tracker import PatchOdometry


@partial(checked_arguments, skip=("seed",))
@in_own_context
def load(
    weights: str = "small",
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    config: Any = None,
    **overrides: Any,
) -> Odometry:
    """Load weights and build their odometry, or build a classical one, for one sequence.

    The architecture in the metadata of the file selects the odometry, see :data:`dvo.odometry.registry.ODOMETRIES`. The
    first call in a process sets the number of threads, see :func:`dvo.core.threads.settle_threads`.

    Args:
        weights: name of weights that ship with dvo, or a file; or name of a system without weights
            (:data:`dvo.odometry.registry.SYSTEMS`): ``keyframe``, ``klt-pnp``, ``direct``, ``monoslam``, ``msckf``.
            Weights that ship with dvo win over a system of their name.
        device: of all computation; a system without weights computes on the CPU.
        seed: of all random numbers of the odometry. The same seed on the same machine gives the same trajectory, bit
            for bit on the CPU with a fixed number of threads.
        config: settings, for ``patch_vo`` a :class:`dvo.odometry.patch.config.TrackerConfig`; None for those of the
            preset.
        overrides: single settings, for ``patch_vo`` by the names of :class:`dvo.odometry.patch.config.TrackerConfig`,
            and ``preset``: ``default``, ``fast`` or ``accurate`` (:data:`dvo.odometry.patch.config.PRESETS`).

    Returns:
        The odometry; its poses are ``T_wc`` in the world of the first keyframe, up to scale.

    Raises:
        DvoError: no such weights, or an invalid file; an architecture without an odometry; an unknown or invalid
            setting.

    Example:
        >>> odometry = dvo.load("small", seed=1, patches=32)
        >>> for frame in dvo.open("video.mp4", calib="calib.txt"):
        ...     estimate = odometry.track(frame)
        >>> result = odometry.finish()
    """
    settle_threads()
    if isinstance(weights, str) and weights in SYSTEMS and not (FOLDER / f"{weights}.safetensors").is_file():
        check_seed(seed)
        return build_system(weights, seed, overrides if config is None else {"config": config, **overrides})
    check_early(weights, config, overrides)
    return build_odometry(load_weights(weights, device), device=device, seed=seed, config=config, **overrides)


@partial(checked_arguments, skip=("seed",))
@in_own_context
def build_odometry(
    weights: LoadedWeights,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    config: Any = None,
    **overrides: Any,
) -> Odometry:
    """Build the odometry of a network in memory.

    Args:
        weights: the network with its name and preset; :meth:`dvo.models.weights.LoadedWeights.of` describes one.
        device: of all computation.
        seed: of all random numbers of the odometry.
        config: settings; None for those of the preset.
        overrides: single settings.

    Returns:
        The odometry, see :func:`load`.

    Raises:
        DvoError: an architecture without an odometry; an unknown or invalid setting or seed.
    """
    check_seed(seed)
    builder = odometry_builder(weights.architecture)
    return builder(weights, device=device, seed=seed, config=config, **overrides)


def check_early(weights: str, config: Any, overrides: Mapping[str, Any]) -> None:
    """Check preset and settings of :func:`load` before the weights are read.

    Args:
        weights: name or file; one that cannot be read is left to :func:`dvo.models.weights.load_weights`.
        config, overrides: of :func:`load`.

    Raises:
        DvoError: no such preset, an unknown or invalid setting.
    """
    try:
        target = SETTINGS.get(architecture_of(weights))
    except DvoError:
        return
    if config is not None or target is None:
        return
    settings = resolve_target(target, "settings")
    changes = dict(overrides)
    with_changes(settings(), changes.pop("preset", "default"), sys.modules[settings.__module__].PRESETS, changes)


@partial(checked_arguments, skip=("preset",))
def patch_odometry(
    weights: LoadedWeights,
    *,
    device: torch.device | str = "cpu",
    seed: int = 0,
    config: TrackerConfig | None = None,
    preset: str = "default",
    **overrides: Any,
) -> PatchOdometry:
    """Build the tracker of a ``patch_vo`` network.

    Args:
        weights: the network, a :class:`dvo.models.patch_vo.PatchVO`.
        device: of all computation.
        seed: of the patch centres.
        config: settings; None for those of the weights.
        preset: settings on top of these, a name in :data:`dvo.odometry.patch.config.PRESETS`.
        overrides: single settings, by the names of :class:`dvo.odometry.patch.config.TrackerConfig`; they win.

    Returns:
        The tracker.

    Raises:
        DvoError: an unknown or invalid setting.
    """
    from dvo.models.patch_vo import PatchVO
    from dvo.odometry.patch.tracker import PatchOdometry

    assert isinstance(weights.model, PatchVO), "the registry gave the builder of another architecture"
    config = config or TRACKER_PRESETS.get(weights.preset, TrackerConfig())
    settings = with_changes(config, preset, PRESETS, overrides)
    name, origin = f"dvo-{weights.name}", source_of(weights)
    return PatchOdometry(weights.model, settings, seed=seed, device=device, name=name, weights=origin)


def source_of(weights: LoadedWeights) -> str:
    """Name or file by which weights can be loaded again.

    Args:
        weights: the network with its origin.

    Returns:
        The name of weights that ship with dvo, the absolute path of another file, or nothing for a network from
        elsewhere.
    """
    if weights.info is None:
        return ""
    path = weights.info.path.resolve()
    return weights.name if path.parent == FOLDER else str(path)
