"""Common parts of the wrappers: images of the size and kind that the peers need, and the result."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.geometry.poses import poses_from_matrices
from dvo.geometry.undistort import Undistorter
from dvo.metrics.segment_metrics import worlds_of
from dvo.odometry.protocol import Result, Segment, SparseMap

WIDE = 560  # smaller images are doubled: these systems expect VGA, and do not even start on 320x240


class Pictures:
    """Turns frames into grey images of a pinhole camera, of VGA size or more.

    Attributes:
        camera: of the images that come out; None before the first.
    """

    def __init__(self, smallest: int = WIDE) -> None:
        self.camera: Camera | None = None
        self._smallest = smallest
        self._undistorter: Undistorter | None = None

    def __call__(self, frame: Frame) -> np.ndarray:
        """``(H, W)`` uint8, contiguous."""
        if self._undistorter is None:
            self._undistorter = Undistorter(frame.camera)
        image, camera = self._undistorter(frame.image), self._undistorter.camera
        if camera.width < self._smallest:
            camera = camera.resized(2 * camera.width, 2 * camera.height)
            image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
        self.camera = camera
        return np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))

    def facts(self) -> dict[str, Any]:
        """For ``Result.info``."""
        if self.camera is None:
            return {"working_size": [0, 0], "working_intrinsics": []}
        size = [self.camera.width, self.camera.height]
        return {"working_size": size, "working_intrinsics": self.camera.intrinsics.tolist()}


@dataclass
class Row:
    """One frame that a system placed.

    Attributes:
        timestamp: seconds.
        T_wc: ``(4, 4)`` camera to world.
        part: number of the map in whose world that is.
    """

    timestamp: float
    T_wc: np.ndarray
    part: int


def result(rows: list[Row], frames: int, info: dict[str, Any], worlds: Mapping[int, int] | None = None) -> Result:
    """A result without points, one segment for each map that holds frames: each has a world and a scale of its own.

    Args:
        rows: frames with a pose, in order of time.
        frames: number of frames fed.
        info: for :class:`dvo.odometry.protocol.Result`.
        worlds: number of the world of a map; maps of the same world are joined to its first one. One that is not named
            has its own.
    """
    parts = list(dict.fromkeys(row.part for row in rows))
    first: dict[Any, int] = {}
    segments = []
    for number, part in enumerate(parts):
        one = _trajectory([row for row in rows if row.part == part])
        world = (worlds or {}).get(part, ("own", part))
        joined_to = first.get(world)
        first.setdefault(world, number)
        segments.append(Segment(one, float(one.timestamps[0]), float(one.timestamps[-1]), joined_to))
    joined = [{parts[number] for number in numbers} for numbers in worlds_of(segments)]
    longest = max(([row for row in rows if row.part in world] for world in joined), key=len, default=[])
    return Result(_trajectory(longest), SparseMap(), frames, frames - len(rows), info, tuple(segments))


def _trajectory(rows: list[Row]) -> Trajectory:
    matrices = np.array([row.T_wc for row in rows]).reshape(-1, 4, 4)
    return Trajectory(np.array([row.timestamp for row in rows], np.float64), poses_from_matrices(matrices))


def version_of(package: str) -> Callable[[], str]:
    """Gives the version of a package, ``-`` if it is not installed."""

    def version() -> str:
        try:
            return importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            return "-"

    return version


def missing_module(module: str, remedy: str) -> str | None:
    """Reason why a peer cannot run, or None if its module is installed; does not import it."""
    return None if find_spec(module) is not None else f"{module} is not installed; {remedy}"
