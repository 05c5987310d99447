"""Metric scale in ``dvo run``: depth or right images of the source, settings of the odometry, and fused cloud."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from dvo.commands.observers import GuardedObserver
from dvo.core.errors import DvoError
from dvo.data.companions.depth_source import with_depth
from dvo.data.companions.right_source import with_right
from dvo.data.source import Source
from dvo.session import results
from dvo.session.depth_fusion import DepthCloud
from dvo.session.observer import Observer


def scaled_source(source: Source, arguments: argparse.Namespace) -> Source:
    """Give a source the depth of ``--depth``, or the right images of ``--right``.

    Args:
        source: newly opened.
        arguments: of the command line.

    Returns:
        The source, with depth or right images if they were asked for.

    Raises:
        DvoError: no such images, or options of images that are not asked for.
    """
    if arguments.right is None and arguments.baseline is not None:
        raise DvoError("there are no right images", field="--baseline", remedy="give --right too")
    if arguments.depth is None:
        given = {
            "--depth-scale": arguments.depth_scale,
            "--depth-calib": arguments.depth_calib,
            "--tsdf": arguments.tsdf,
        }
        for name, value in given.items():
            if value:
                raise DvoError("there are no depth images", field=name, remedy="give --depth too")
        if arguments.right is not None:
            return with_right(source, arguments.right or None, arguments.baseline)
        return source
    return with_depth(source, arguments.depth or None, arguments.depth_scale, arguments.depth_calib)


def scale_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Setting ``scale`` of the odometry.

    Args:
        arguments: of the command line; of ``dvo demo`` without these options.

    Returns:
        The setting; none without an option.
    """
    given = vars(arguments)
    if given.get("depth") is not None:
        return {"scale": {"depth": True}}
    if given.get("right") is not None:
        return {"scale": {"stereo": True}}
    if given.get("height") is not None:
        return {"scale": {"height": given["height"]}}
    return {"scale": {"distances": given["distance"]}} if given.get("distance") else {}


def scale_observers(arguments: argparse.Namespace, folder: Path) -> list[Observer]:
    """Observer that fuses the depth images of ``--depth`` to a cloud.

    Args:
        arguments: of the command line.
        folder: of the results.

    Returns:
        None or one.

    Raises:
        DvoError: Open3D is not installed, for ``--tsdf``.
    """
    if arguments.depth is None:
        return []
    mesh = folder / results.MESH if arguments.tsdf else None
    return [GuardedObserver(DepthCloud(folder / results.CLOUD, mesh), "--depth")]
