"""From what a classical baseline knows of its frames to the result, frames before the start of a map included."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import poses_from_matrices
from dvo.odometry.protocol import Result, SparseMap


def back_fill(
    T_cw: list[np.ndarray | None], turns: list[np.ndarray | None], lost: Collection[int]
) -> list[np.ndarray | None]:
    """Fill missing poses from their neighbours by measured rotations; the camera is taken to stand meanwhile.

    Args:
        T_cw: ``(4, 4)`` world to camera, None where there is none. Without any, the first frame is the world.
        turns: ``(3, 3)`` rotation from the frame before to each frame, None where it is not known.
        lost: positions that stay empty.

    Returns:
        The poses; still None where no chain of turns leads to a known one.
    """
    poses = list(T_cw)
    if poses and all(T is None for T in poses):
        poses[0] = np.eye(4)
    # First backwards: what precedes the start of a map belongs to that map.
    for order, towards in ((range(len(poses) - 2, -1, -1), 1), (range(1, len(poses)), -1)):
        for i in order:
            neighbour = poses[i + towards]
            turn = turns[max(i, i + towards)]
            if poses[i] is None and i not in lost and neighbour is not None and turn is not None:
                step = np.eye(4)
                step[:3, :3] = turn.T if towards > 0 else turn
                poses[i] = step @ neighbour
    return poses


def map_of(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> SparseMap:
    """One map from pieces of points ``(n, 3)`` and colours ``(n, 3)``."""
    points, colors = (np.concatenate(part) for part in zip(*parts, strict=True)) if parts else ((), ())
    return SparseMap(np.array(points, np.float32).reshape(-1, 3), np.array(colors, np.uint8).reshape(-1, 3))


def result_of(
    times: list[float],
    T_cw: list[np.ndarray | None],
    turns: list[np.ndarray | None],
    lost: Collection[int],
    points: SparseMap,
    info: dict[str, Any],
) -> Result:
    """Everything, with the frames before each start filled in (see :func:`back_fill`)."""
    poses = back_fill(T_cw, turns, lost)
    rows = [index for index, pose in enumerate(poses) if pose is not None]
    matrices = np.array([np.linalg.inv(poses[index]) for index in rows]).reshape(-1, 4, 4)  # type: ignore[arg-type]
    trajectory = Trajectory(np.array([times[index] for index in rows]), poses_from_matrices(matrices))
    return Result(trajectory, points, len(times), len(times) - len(rows), info)
