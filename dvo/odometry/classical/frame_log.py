"""Log of a classical baseline: poses by keyframe, measured rotations, and the result made of both."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import poses_from_matrices
from dvo.map.keyframe_log import KeyframeLog
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status


class FrameLog:
    """Frames of the sequence in order, in a :class:`dvo.map.keyframe_log.KeyframeLog` of ``(4, 4)`` matrices.

    Frames before the start of a map have no pose of their own; they get one in :meth:`result` from the rotations
    between frames.

    Attributes:
        keyframes: the poses.
        turns: ``(3, 3)`` rotation from the frame before to each frame; None where it is not known.
    """

    def __init__(self) -> None:
        self.keyframes = KeyframeLog()
        self.turns: list[np.ndarray | None] = []
        self._repeats: list[int] = []  # frames with the image of the one before them
        self._last = Estimate(0.0, None, Status.INITIALISING)  # of the newest frame

    def begin(self, timestamp: float) -> int:
        """Append a frame without a pose.

        Returns:
            Its position.
        """
        self.keyframes.add(timestamp)
        self.turns.append(None)
        return len(self.turns) - 1

    def repeat(self, timestamp: float) -> Estimate:
        """Append a frame with the image of the one before it, which has its pose and state.

        Returns:
            Its estimate.
        """
        index = self.begin(timestamp)
        self.turns[index] = np.eye(3)
        self._repeats.append(index)
        self.keyframes.frames[index].follow(self.keyframes.frames[index - 1])
        self._last = replace(self._last, timestamp=timestamp)
        return self._last

    def lose(self, index: int, reason: str) -> Estimate:
        """Keep a frame without a pose, unless it is given one later; its estimate, with a reason if there is one."""
        self.mark_lost(index)
        self._last = replace(self.estimate(Status.LOST), reason=reason)
        return self._last

    def set_pose(self, index: int, T_cw: np.ndarray) -> None:
        """Give a frame a pose ``(4, 4)`` that is final unless set again: the frame is its own keyframe."""
        self.keyframes.set_pose(index, T_cw)
        record = self.keyframes.frames[index]
        record.anchor, record.relative, record.lost = index, None, False

    def mark_lost(self, index: int) -> None:
        """Keep a frame without a pose, unless it is given one later."""
        self.keyframes.frames[index].lost = True

    def is_lost(self, index: int) -> bool:
        """Return True if a frame is marked as lost."""
        return self.keyframes.frames[index].lost

    def pose(self, index: int) -> np.ndarray | None:
        """``T_cw (4, 4)`` of a frame, or None."""
        return self.keyframes.pose(index)

    def last_pose(self, before: int | None = None) -> np.ndarray:
        """Pose of the newest frame that has one, a copy; identity if none has.

        Args:
            before: position after the last frame that counts; None for the end.
        """
        found = (self.keyframes.pose(index) for index in reversed(range(len(self.turns))[:before]))
        return next((T.copy() for T in found if T is not None), np.eye(4))

    def estimate(self, status: Status, confidence: float = 0.0) -> Estimate:
        """Estimate of the newest frame; a lost one has no pose."""
        T = None if status is Status.LOST else self.keyframes.pose(-1)
        pose = None if T is None else poses_from_matrices(np.linalg.inv(T))
        self._last = Estimate(self.keyframes.frames[-1].timestamp, pose, status, confidence)
        return self._last

    def poses(self) -> list[np.ndarray | None]:
        """``T_cw (4, 4)`` of every frame, None where there is none."""
        return [self.keyframes.pose(index) for index in range(len(self.turns))]

    def result(self, points: SparseMap, info: dict[str, Any]) -> Result:
        """Result with the frames before each start filled in (see :func:`back_fill`)."""
        frames = self.keyframes.frames
        lost = {index for index, record in enumerate(frames) if record.lost}
        poses = back_fill(self.poses(), self.turns, lost)
        for index in self._repeats:
            poses[index] = poses[index - 1]
        rows = [index for index, pose in enumerate(poses) if pose is not None]
        matrices = np.array([np.linalg.inv(poses[index]) for index in rows]).reshape(-1, 4, 4)  # type: ignore[arg-type]
        trajectory = Trajectory(np.array([frames[index].timestamp for index in rows]), poses_from_matrices(matrices))
        return Result(trajectory, points, len(frames), len(frames) - len(rows), info)


def back_fill(
    T_cw: list[np.ndarray | None], turns: list[np.ndarray | None], lost: Collection[int]
) -> list[np.ndarray | None]:
    """Fill missing poses from their neighbours by measured rotations; the camera is taken to stand meanwhile.

    Args:
        T_cw: ``(4, 4)`` world to camera, None where there is none. Without any, the first frame that is not lost is the
            world.
        turns: ``(3, 3)`` rotation from the frame before to each frame, None where it is not known.
        lost: positions that stay empty.

    Returns:
        The poses; still None where no chain of turns leads to a known one.
    """
    poses = list(T_cw)
    seen = [index for index in range(len(poses)) if index not in lost]
    if seen and all(T is None for T in poses):
        poses[seen[0]] = np.eye(4)
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
    """One map from pieces of points ``(n, 3)`` and colours ``(n, 3)``.

    Args:
        parts: points and RGB colours of each piece.
    """
    points, colors = (np.concatenate(part) for part in zip(*parts, strict=True)) if parts else ((), ())
    return SparseMap(np.array(points, np.float32).reshape(-1, 3), np.array(colors, np.uint8).reshape(-1, 3))
