"""Registry of the systems that can be compared, each behind :class:`dvo.odometry.protocol.Odometry`.

A system is a class (or a function that returns an odometry), given as ``"module:Class"``, and its settings. On the
command line it is chosen by

- a name of the registry: the odometries without weights of :mod:`dvo.odometry.registry`, the peers below, and those
  that other packages announce under the entry-point group ``dvo.systems``;
- ``dvo-NAME``, the learned odometry with weights NAME of the package (NAME alone will do where no system has it), or
  ``dvo:FILE`` with a weights file;
- ``package.module:Class``, a class that can be imported;
- ``FILE.py:Class``, a class in a file (:mod:`eval.systems.plugin`).

Any of them may carry settings, passed on as keyword arguments: ``klt-pnp+corners=400``, ``dvo-small+patches=48``.
Nothing of a system is imported before it is built, in a process of its own.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from dvo.core.errors import DvoError
from dvo.core.registry import Registry, is_target
from dvo.core.yaml_files import parse_yaml
from dvo.odometry.registry import SYSTEMS as WITHOUT_WEIGHTS
from eval.systems import plugin
from eval.systems.system import System, package_facts

DEFAULT = ("dvo-small", "klt-pnp", "null")
LEARNED = "dvo:load"

_PEERS = "eval.systems.peers"
_ABOUT = {
    "klt-pnp": "KLT tracks, five-point essential matrix, triangulation, PnP (OpenCV)",
    "keyframe": "two-view start, PnP, keyframes, local bundle adjustment, relocalisation (after PTAM and ORB-SLAM)",
    "direct": "semi-dense: photometric alignment to keyframes with filtered inverse depth (after LSD-SLAM)",
    "monoslam": "filter: EKF over camera and inverse-depth points, active search, one-point RANSAC",
    "msckf": "inertial filter: EKF over past poses (MSCKF with first-estimate Jacobians), in metres",
}
_OWN = WITHOUT_WEIGHTS.registered
CATALOGUE = (
    *(System(name, target, about=_ABOUT.get(name, target)) for name, target in _OWN.items()),
    System("keyframe-loops", _OWN["keyframe"], {"loops": True},
           about="keyframe with loop closure: ORB matches, PnP, pose graph in Sim(3)"),
    System("orbslam3", f"{_PEERS}.orbslam3:OrbSlam3", licence="GPL-3",
           about="ORB-SLAM3 (pyorbslam3), without the official vocabulary; monocular, or in metres with "
           "sensor=stereo, rgbd, imu_monocular or imu_stereo; closes loops, unless loops=false",
           version_from=f"{_PEERS}.orbslam3:version", missing_from=f"{_PEERS}.orbslam3:missing"),
    System("svo", f"{_PEERS}.svo:Svo", licence="GPL-3", about="SVO (svo-cpp)",
           version_from=f"{_PEERS}.svo:version", missing_from=f"{_PEERS}.svo:missing"),
    System("colmap", f"{_PEERS}.colmap:Colmap", licence="BSD-3",
           about="COLMAP (pycolmap), offline, at most 60 frames of a sequence",
           version_from=f"{_PEERS}.colmap:version", missing_from=f"{_PEERS}.colmap:missing"),
    System("null", "eval.systems.null:NullMotion",
           about="straight line at constant speed, no rotation, images unread"),
    System("null-imu", "eval.systems.null_imu:DeadReckoning",
           about="dead reckoning with an inertial sensor, images unread"),
)  # fmt: skip
SYSTEMS = Registry("system", "dvo.systems", {system.name: system.target for system in CATALOGUE})
_described = {system.name: system for system in CATALOGUE}


def add_system(system: System) -> None:
    """Register a system with its description, for this process.

    A package that only announces ``"module:Class"`` under the entry-point group ``dvo.systems`` needs no call, and is
    found by the worker processes too; licence and description are then those of the package.

    Args:
        system: with a name that is free.

    Raises:
        DvoError: the name is taken.
    """
    SYSTEMS.register(system.name, system.target)
    _described[system.name] = system


def remove_system(name: str) -> None:
    """Undo :func:`add_system`."""
    SYSTEMS.unregister(name)
    _described.pop(name, None)


def find_system(text: str, weights: str | None = None) -> System:
    """Look a system up.

    Args:
        text: name or target, with settings or without; see the module.
        weights: weights file for ``dvo-...`` systems in place of the package's own.

    Raises:
        DvoError: no such system.

    Example:
        >>> find_system("klt-pnp+corners=400").settings
        {'corners': 400}
    """
    name, settings = split_settings(text)
    found = _find(name, weights)
    if not settings:
        return found
    label = found.name + text[len(name) :]
    return replace(found, name=label, settings={**found.settings, **settings})


def split_settings(text: str) -> tuple[str, dict[str, Any]]:
    """``NAME+key=value+key=value`` as name and settings; values are read as YAML.

    Args:
        text: as on the command line.

    Raises:
        DvoError: a value that is no YAML.
    """
    name, *pairs = re.split(r"\+(?=[A-Za-z_]\w*=)", text)
    settings = {}
    for key, value in (pair.split("=", 1) for pair in pairs):
        settings[key] = parse_yaml(value, field=f"{name[:60]}+{key}", remedy="write a setting as NAME+key=value")
        try:
            json.dumps(settings[key])
        except TypeError:  # a date, say: the key of a prediction is JSON, so it stays text
            settings[key] = value
    return name, settings


def list_systems() -> list[System]:
    """Everything that has a name: the package's own weights and the registry."""
    from dvo.models.weights import list_weights

    names = dict.fromkeys(["dvo-small", *(f"dvo-{info.name}" for info in list_weights()), *SYSTEMS])
    return [find_system(name) for name in names]


def _find(name: str, weights: str | None) -> System:
    if name in SYSTEMS:
        described, target = _described.get(name), SYSTEMS.target(name)
        return described if described is not None and described.target == target else _announced(name, target)
    if plugin.is_plugin(name):
        return System(Path(name).name, name, licence="the user's", about="a system of one's own")
    if name.startswith("dvo:"):
        return _learned(name.removeprefix("dvo:"))
    if name.startswith("dvo-"):
        return _learned(weights) if weights else _learned(name.removeprefix("dvo-"), name)
    if is_target(name):
        return _announced(name, name)
    if _ships(name):
        return _find(f"dvo-{name}", weights)
    raise DvoError(
        f"no system '{name}'",
        field="--systems",
        remedy=f"choose from {', '.join(SYSTEMS)}, dvo-NAME, dvo:FILE, package.module:Class, FILE.py:Class",
    )


def _ships(name: str) -> bool:
    from dvo.models.weights import list_weights

    return name in {info.name for info in list_weights()}


def _learned(weights: str, name: str | None = None) -> System:
    """The learned odometry; weights from a file are named by it, never by weights of the package."""
    return System(
        name or f"dvo:{Path(weights).stem}",
        LEARNED,
        {"weights": weights},
        about="learned odometry; the weights name the network",
        version_from="eval.systems.learned:version",
        missing_from="eval.systems.learned:missing",
    )


def _announced(name: str, target: str) -> System:
    """System of another package, described by the package's metadata."""
    package = package_facts(target.split(".")[0].split(":")[0])
    return System(name, target, licence=package.get("licence", "the user's"), about=package.get("about", target))
