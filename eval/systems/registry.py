"""The systems that can be chosen by name, each behind :class:`dvo.odometry.protocol.Odometry`.

The classical ones and the peers are here; ``dvo-NAME`` is the learned tracker with weights NAME of the package,
``dvo:FILE`` the same with a weights file, ``FILE.py:NAME`` a system of one's own (:mod:`eval.systems.plugin`). A system
that cannot run says why instead of raising.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import dvo
from dvo.errors import DvoError
from dvo.odometry.protocol import Odometry
from eval.systems import plugin
from eval.systems.peers import colmap, orbslam3, svo


@dataclass(frozen=True)
class System:
    """One entry of the registry.

    Attributes:
        name: as on the command line and in the tables.
        licence: of the code that runs.
        about: one line.
        build: ``build(seed, device)`` gives a fresh odometry for one sequence.
        version: gives the version of what would run.
        missing: gives the reason why it cannot run, or None.
    """

    name: str
    licence: str
    about: str
    build: Callable[[int, str], Odometry]
    version: Callable[[], str]
    missing: Callable[[], str | None]


DEFAULT = ("dvo-small", "klt-pnp", "null")


def find_system(name: str, weights: str | None = None) -> System:
    """Look a system up.

    Args:
        name: see the module.
        weights: weights file for ``dvo-...`` systems in place of the package's own.

    Raises:
        DvoError: no such system.
    """
    if name in _CLASSICAL:
        return _CLASSICAL[name]
    if plugin.is_plugin(name):
        return _own(name)
    if name.startswith("dvo:"):
        return _learned(name, name.removeprefix("dvo:"))
    if name.startswith("dvo-"):
        return _learned(name, weights or name.removeprefix("dvo-"))
    raise DvoError(
        f"no system '{name}'",
        field="--systems",
        remedy=f"choose from {', '.join(_CLASSICAL)}, dvo-NAME, dvo:FILE, FILE.py:NAME",
    )


def list_systems() -> list[System]:
    """Everything that has a name here, the package's own weights included."""
    from dvo.models.weights import list_weights

    names = dict.fromkeys(["dvo-small", *(f"dvo-{info.name}" for info in list_weights())])
    return [find_system(name) for name in names] + list(_CLASSICAL.values())


def _klt_pnp(seed: int, device: str) -> Odometry:
    from eval.systems.baselines.klt_pnp import KltPnp

    return KltPnp(seed=seed)


def _keyframe(seed: int, device: str) -> Odometry:
    from eval.systems.baselines.keyframe.system import KeyframeOdometry

    return KeyframeOdometry(seed=seed)


def _direct(seed: int, device: str) -> Odometry:
    from eval.systems.baselines.direct.system import DirectOdometry

    return DirectOdometry(seed=seed)


def _monoslam(seed: int, device: str) -> Odometry:
    from eval.systems.baselines.monoslam import MonoSlam

    return MonoSlam(seed=seed)


def _orbslam3(seed: int, device: str) -> Odometry:
    return orbslam3.OrbSlam3()


def _svo(seed: int, device: str) -> Odometry:
    return svo.Svo()


def _colmap(seed: int, device: str) -> Odometry:
    return colmap.Colmap(seed=seed)


def _null(seed: int, device: str) -> Odometry:
    from eval.systems.baselines.null import NullMotion

    return NullMotion(seed)


def _own(name: str) -> System:
    return System(
        name,
        "the user's",
        "a system of one's own",
        lambda seed, device: plugin.build(name, seed, device),
        lambda: plugin.version(name),
        lambda: plugin.missing(name),
    )


def _learned(name: str, weights: str) -> System:
    def build(seed: int, device: str) -> Odometry:
        return dvo.load(weights, seed=seed, device=device)

    def version() -> str:
        from dvo.models.weights import weights_info

        return f"{dvo.__version__}+{weights_info(weights).sha256[:8]}"

    def missing() -> str | None:
        from dvo.models.weights import find_weights

        try:
            find_weights(weights)
        except DvoError as error:
            return str(error)
        return None

    return System(name, "MIT", "learned patch flow and differentiable bundle adjustment", build, version, missing)


_CLASSICAL = {
    system.name: system
    for system in (
        System(
            "klt-pnp",
            "MIT",
            "KLT tracks, five-point essential matrix, triangulation, PnP (OpenCV)",
            _klt_pnp,
            lambda: dvo.__version__,
            lambda: None,
        ),
        System(
            "monoslam",
            "MIT",
            "filter: EKF over camera and inverse-depth points, active search, one-point RANSAC",
            _monoslam,
            lambda: dvo.__version__,
            lambda: None,
        ),
        System(
            "keyframe",
            "MIT",
            "two-view start, PnP, keyframes, local bundle adjustment, relocalisation (after PTAM and ORB-SLAM)",
            _keyframe,
            lambda: dvo.__version__,
            lambda: None,
        ),
        System(
            "direct",
            "MIT",
            "semi-dense: photometric alignment to keyframes with filtered inverse depth (after LSD-SLAM)",
            _direct,
            lambda: dvo.__version__,
            lambda: None,
        ),
        System(
            "orbslam3",
            "GPL-3",
            "ORB-SLAM3 monocular (pyorbslam3), without the official vocabulary",
            _orbslam3,
            orbslam3.version,
            orbslam3.missing,
        ),
        System("svo", "GPL-3", "SVO (svo-cpp)", _svo, svo.version, svo.missing),
        System(
            "colmap",
            "BSD-3",
            "COLMAP (pycolmap), offline, at most 60 frames of a sequence",
            _colmap,
            colmap.version,
            colmap.missing,
        ),
        System(
            "null",
            "MIT",
            "straight line at constant speed, no rotation, images unread",
            _null,
            lambda: dvo.__version__,
            lambda: None,
        ),
    )
}
