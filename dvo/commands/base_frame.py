"""Trajectory of the base frame in the results of ``dvo run --extrinsics``."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dvo.commands.console import warn
from dvo.commands.observers import GuardedObserver
from dvo.data.extrinsics import base_trajectory, read_extrinsics
from dvo.data.files.output import replaced
from dvo.data.frame import Frame
from dvo.data.opening import locate
from dvo.data.trajectory import tum_row
from dvo.odometry.protocol import Estimate, Odometry
from dvo.session.observer import Observer
from dvo.session.results import BASE
from dvo.session.session import Run

_HEADER = "# timestamp tx ty tz qx qy qz qw (base to the first base frame)\n"


class BaseFrame:
    """Observer that writes trajectory_base.txt beside trajectory.txt.

    Args:
        T_base_camera: ``(7,)`` camera to base, metres.
        folder: of the results.

    Attributes:
        warnings: sentences that were printed.
    """

    def __init__(self, T_base_camera: np.ndarray, folder: Path) -> None:
        self.T_base_camera, self.folder = T_base_camera, folder
        self.warnings: list[str] = []

    def begin(self, odometry: Odometry) -> None:
        """See :class:`dvo.session.observer.Observer`."""

    def update(self, frame: Frame, estimate: Estimate | None) -> None:
        """See :class:`dvo.session.observer.Observer`."""

    def finish(self, run: Run) -> None:
        """Write the file, and warn of a scale that does not suit the extrinsics."""
        trajectory = base_trajectory(run.result.trajectory, self.T_base_camera)
        lever, doubt = float(np.linalg.norm(self.T_base_camera[:3])), ""
        if lever > 0 and not is_metric(run.result.info):
            doubt = (
                f"the lever arm of {lever:.3g} m is in metres, but the scale of the trajectory is not known: positions "
                f"in {BASE} are right only if one unit of the trajectory is a metre (rotations are right)"
            )
            self.warnings.append(doubt)
            warn(doubt)
        rows = zip(trajectory.timestamps, trajectory.poses_wc, strict=True)
        with replaced(self.folder / BASE) as part, part.open("w", encoding="utf-8", newline="\n") as file:
            file.write(_HEADER + (f"# {doubt}\n" if doubt else ""))
            file.writelines(tum_row([time, *pose]) for time, pose in rows)

    def close(self) -> None:
        """See :class:`dvo.session.observer.Observer`."""


def base_observers(arguments: argparse.Namespace, folder: Path, source: Path) -> list[Observer]:
    """Observer of ``--extrinsics``, if it is given.

    Args:
        arguments: of the command line.
        folder: of the results.
        source: file or folder that is tracked, beside which the file of the extrinsics is looked up too.

    Raises:
        DvoError: extrinsics that cannot be read, or are not rigid.
    """
    if arguments.extrinsics is None:
        return []
    file = locate(arguments.extrinsics, source, "extrinsics")
    return [GuardedObserver(BaseFrame(read_extrinsics(file), folder), "--extrinsics")]


def is_metric(info: Mapping[str, Any]) -> bool:
    """True if the metadata of a result say that its unit is the metre.

    Args:
        info: of :class:`dvo.odometry.protocol.Result`; its entry ``scale`` is a table with the ``unit`` ``metres``, and
            no entry of its ``segments`` has the source ``none``.
    """
    scale = info.get("scale")
    if not isinstance(scale, Mapping) or scale.get("unit") != "metres":
        return False
    return all(segment.get("source") != "none" for segment in scale.get("segments", ()))
