"""Figures of a trajectory without ground truth, and what is expected of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.yaml_files import read_yaml
from dvo.data.trajectory import Trajectory
from dvo.metrics import evaluate

PARTS = 5
"""Equal parts of a clip whose mean speeds are compared."""
COUNTS = {"frames": 1, "calib": 4, "straightness": 2, "turn": 2, "even": 2, "seeds": 1, "first_pose": 1}
"""Numbers of each entry of :class:`Expected`."""


@dataclass(frozen=True)
class Measures:
    """Figures of one trajectory.

    Attributes:
        rows: number of poses.
        straightness: distance from the first to the last pose over the length of the path, 0 without motion.
        turn: largest angle to the first pose, degrees.
        even: smallest and largest of the mean speeds of :data:`PARTS` equal parts, over the mean of all.
    """

    rows: int = 0
    straightness: float = math.nan
    turn: float = math.nan
    even: tuple[float, float] = (math.nan, math.nan)


def measure(trajectory: Trajectory) -> Measures:
    """Figures of a trajectory.

    Args:
        trajectory: ``T_wc``, in any scale.
    """
    poses = trajectory.poses_wc
    if len(poses) <= PARTS:
        return Measures(len(poses))
    steps = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    path = float(steps.sum())
    cosines = np.abs(poses[:, 3:] @ poses[0, 3:]) / np.linalg.norm(poses[:, 3:], axis=1) / np.linalg.norm(poses[0, 3:])
    turn = float(np.degrees(2 * np.arccos(np.clip(cosines, 0, 1)).max()))
    if path == 0:
        return Measures(len(poses), 0.0, turn)
    speeds = [float(part.mean()) / float(steps.mean()) for part in np.array_split(steps, PARTS)]
    return Measures(len(poses), float(np.linalg.norm(poses[-1, :3] - poses[0, :3])) / path, turn,
                    (min(speeds), max(speeds)))  # fmt: skip


def difference(one: Trajectory, other: Trajectory) -> float:
    """RMS distance of two trajectories of the same frames after a similarity, in percent of the path of the second.

    Args:
        one, other: ``T_wc``.

    Returns:
        NaN where they share too few frames or one stands still.
    """
    try:
        return float(evaluate(one, other).ate_percent)
    except DvoError:
        return math.nan


def backward(trajectory: Trajectory, length: float) -> Trajectory:
    """Trajectory of a clip that was tracked from its end to its start, in the times of the clip.

    Args:
        trajectory: whose times are ``length`` minus those of the clip.
        length: sum of the first and the last time of the clip.
    """
    return Trajectory(length - trajectory.timestamps[::-1], trajectory.poses_wc[::-1])


@dataclass(frozen=True)
class Expected:
    """What is right for a video: intervals of :class:`Measures`, and what has to come.

    Attributes:
        video: file, relative to the list.
        must: ``good`` (right), ``told`` (right, or not good), or ``still`` (a camera that does not move: no pose).
        frames: first frames that are tracked; None for all.
        calib: ``fx fy cx cy``; None: NAME.calib.txt beside the video, or none.
        straightness, turn, even: intervals, see :class:`Measures`; None: any.
        seeds: largest difference of two seeds, percent of the path; None: any.
        first_pose: number of the frame that has a measured pose at the latest; None: any.
    """

    video: str
    must: str = "told"
    frames: int | None = None
    calib: tuple[float, ...] | None = None
    straightness: tuple[float, float] | None = None
    turn: tuple[float, float] | None = None
    even: tuple[float, float] | None = None
    seeds: float | None = None
    first_pose: int | None = None

    def faults(self, measures: Measures, first: int | None) -> list[str]:
        """What is not as expected in one run; empty if it is right.

        Args:
            measures: of its trajectory.
            first: number of the first frame with a measured pose; None if there is none.
        """
        found = [] if measures.rows else ["no poses"]
        for name in ("straightness", "turn"):
            wanted, value = getattr(self, name), getattr(measures, name)
            if wanted is not None and not wanted[0] <= value <= wanted[1]:
                found.append(f"{name} {value:.3g}")
        if self.even is not None and not (self.even[0] <= measures.even[0] and measures.even[1] <= self.even[1]):
            found.append("even {:.2f} to {:.2f}".format(*measures.even))
        if self.first_pose is not None and (first is None or first > self.first_pose):
            found.append(f"first pose {first}")
        return found


def read_expected(file: Path) -> dict[str, Expected]:
    """Read a list of videos with what is right.

    Args:
        file: YAML, a mapping from names to the attributes of :class:`Expected`.

    Raises:
        DvoError: no such file, an unknown or missing entry.
    """
    known = {field.name for field in fields(Expected)}
    found = {}
    entries = read_yaml(file)
    if not isinstance(entries, Mapping):
        raise DvoError("no list of videos", file=file, remedy="give NAME: {video: FILE, must: good|told|still}")
    for name, entry in entries.items():
        if not isinstance(entry, Mapping) or "video" not in entry:
            raise DvoError("names no video", file=file, field=name, remedy="give {video: FILE, must: good|told|still}")
        if unknown := sorted(set(entry) - known):
            raise DvoError("unknown entry", file=file, field=f"{name}.{unknown[0]}", remedy=f"use {', '.join(known)}")
        values: dict[str, Any] = {key: tuple(x) if isinstance(x, list) else x for key, x in entry.items()}
        if values.get("must", "told") not in ("good", "told", "still"):
            raise DvoError("unknown value", file=file, field=f"{name}.must", remedy="use good, told or still")
        for key, count in COUNTS.items():
            value = values.get(key)
            numbers = value if isinstance(value, tuple) else (value,)
            plain = all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in numbers)
            if value is not None and not (plain and len(numbers) == count):
                remedy = f"give {count} numbers" if count > 1 else "give a number"
                raise DvoError("not understood", file=file, field=f"{name}.{key}", remedy=remedy)
        found[str(name)] = Expected(**values)
    return found
