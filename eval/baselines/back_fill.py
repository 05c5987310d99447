"""Poses for frames that were seen before the map could be started."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np


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
