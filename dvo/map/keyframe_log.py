"""Log of a keyframe tracker: frames relative to keyframes, poses of keyframes, points."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import poses_from_matrices


@dataclass
class FrameRecord:
    """Frame of the sequence.

    Attributes:
        timestamp: seconds.
        anchor: keyframe that carries the frame, which may have been removed since
            (:meth:`KeyframeLog.reanchor`); None while the frame has no pose.
        relative: pose of the frame relative to its anchor, ``T_cw = relative T_cw[anchor]``; None for the identity.
        lost: tracking was lost; the frame gets no row in the trajectory.
        segment: number of the segment of the frame; means nothing for a lost frame.
        reason: cause of a loss, or of a break before the frame.
        inertial: it has no pose by its image: the one that it has, or will have, is predicted from inertial samples.
    """

    timestamp: float
    anchor: int | None
    relative: np.ndarray | None = None
    lost: bool = False
    segment: int = 0
    reason: str = ""
    inertial: bool = False

    def place(self, anchor: int, segment: int, reason: str = "") -> None:
        """Give the frame the pose of a keyframe.

        Args:
            anchor: the keyframe.
            segment: its segment.
            reason: cause of a break before the frame.
        """
        self.anchor, self.lost, self.segment, self.reason = anchor, False, segment, reason
        self.inertial = False

    def follow(self, other: FrameRecord) -> None:
        """Take the pose and the state of another frame.

        Args:
            other: record of a frame with the same image.
        """
        self.anchor, self.relative, self.lost, self.segment = other.anchor, other.relative, other.lost, other.segment
        self.reason = other.reason if other.lost else ""


class KeyframeLog:
    """Every frame relative to an anchor keyframe, so that a keyframe that moves takes its frames with it.

    Keyframes are numbered by the caller. A pose is ``T_cw``, world to camera, either ``(7,)`` or a ``(4, 4)`` matrix,
    float64; one log keeps to one of the two. A keyframe without a pose yet is one that is still being optimised: give
    its pose with :meth:`set_pose` at any time before the trajectory is read, as often as it changes.

    Attributes:
        frames: record of every frame that was read, in order of time.

    Example:
        >>> log = KeyframeLog()
        >>> _ = log.add(0.0, anchor=0)
        >>> log.set_pose(0, np.array([0.0, 0, 0, 0, 0, 0, 1]))
        >>> len(log.trajectory())
        1
    """

    def __init__(self) -> None:
        self.frames: list[FrameRecord] = []
        self._poses: dict[int, np.ndarray] = {}
        self._removed: dict[int, tuple[int, np.ndarray]] = {}  # anchor and relative pose of removed keyframes
        self._points: list[np.ndarray] = []
        self._colors: list[np.ndarray] = []

    def copy(self) -> KeyframeLog:
        """Log with the same content, which changes on its own; poses and points are shared."""
        new = KeyframeLog()
        new.frames = [replace(record) for record in self.frames]
        new._poses, new._removed = dict(self._poses), dict(self._removed)
        new._points, new._colors = list(self._points), list(self._colors)
        return new

    def add(self, timestamp: float, anchor: int | None = None) -> FrameRecord:
        """Append a frame with the pose of keyframe ``anchor``, or without a pose.

        Args:
            timestamp: seconds.
            anchor: keyframe; None for a frame whose pose is not known yet, see :meth:`place`.

        Returns:
            The record, which may be edited.
        """
        self.frames.append(FrameRecord(timestamp, anchor))
        return self.frames[-1]

    def place(self, frame: int, anchor: int, T_cw: np.ndarray) -> None:
        """Give a frame its pose, relative to a keyframe that has one, or to the one that carries it if it was removed.

        Args:
            frame: position in :attr:`frames`.
            anchor: keyframe.
            T_cw: pose of the frame.
        """
        record, (kept, _) = self.frames[frame], self._carrier(anchor)
        record.anchor, record.relative = kept, _compose(T_cw, _inverse(self._poses[kept]))
        record.lost = False

    def rows(self, segment: int, first: int = 0, last: float = math.inf) -> list[FrameRecord]:
        """Frames of a segment that are not lost.

        Args:
            segment: its number.
            first, last: keyframes, from one number to another, that the frames belong to.

        Returns:
            Their records, in order of time.
        """
        mine = (record for record in self.frames if not record.lost and record.segment == segment)
        return [record for record in mine if record.anchor is not None and first <= record.anchor <= last]

    def lose(self, keyframe: int, reason: str) -> None:
        """Mark the frames of a keyframe that is given up as lost.

        Args:
            keyframe: its number; the keyframes after it may still have frames.
            reason: cause.
        """
        for record in reversed(self.frames):
            if record.anchor is not None and self._carrier(record.anchor)[0] == keyframe:
                record.anchor, record.relative, record.lost, record.reason = None, None, True, reason
            elif record.anchor is not None and record.anchor < keyframe:
                break
        self._poses.pop(keyframe, None)

    def reanchor(self, gone: int, anchor: int, relative: np.ndarray | None = None) -> None:
        """Remove keyframe ``gone``, or move one that is removed: from now on it is relative to ``anchor``.

        Args:
            gone, anchor: keyframes.
            relative: pose of ``gone`` relative to ``anchor``; None takes the poses of both from the log.
        """
        if relative is None:
            relative = _compose(self._poses[gone], _inverse(self._poses[anchor]))
        self._removed[gone] = anchor, relative
        self._poses.pop(gone, None)

    def set_pose(self, keyframe: int, T_cw: np.ndarray) -> None:
        """Set or change the pose of a keyframe.

        Args:
            keyframe: its number.
            T_cw: ``(7,)`` or ``(4, 4)``.
        """
        self._poses[keyframe] = T_cw

    def rescale(self, scales: Mapping[int, float]) -> None:
        """Divide the lengths of frames relative to keyframes whose scale has changed.

        Args:
            scales: by keyframe; those that are not named keep theirs.
        """
        for record in self.frames:
            scale = scales.get(record.anchor, 1.0) if record.anchor is not None else 1.0
            if record.relative is not None and scale != 1.0:
                record.relative = record.relative.copy()
                if _is_matrix(record.relative):
                    record.relative[:3, 3] /= scale
                else:
                    record.relative[:3] /= scale

    def keyframe_pose(self, keyframe: int) -> np.ndarray:
        """Pose of a keyframe that has one.

        Args:
            keyframe: its number.

        Returns:
            ``T_cw`` in the form that it was given in.

        Raises:
            KeyError: a keyframe without a pose.
        """
        return self._poses[keyframe]

    def add_points(self, points: np.ndarray, colors: np.ndarray) -> None:
        """Append world points.

        Args:
            points: ``(N, 3)`` float32, in the unit of the poses.
            colors: ``(N, 3)`` uint8 RGB.
        """
        self._points.append(points)
        self._colors.append(colors)

    @property
    def poses(self) -> Mapping[int, np.ndarray]:
        """``T_cw`` of the keyframes that have a pose."""
        return self._poses

    @property
    def removed(self) -> Mapping[int, tuple[int, np.ndarray]]:
        """Anchor of each removed keyframe, and its pose relative to the anchor."""
        return self._removed

    @property
    def keyframes(self) -> int:
        """Number of keyframes that have a pose."""
        return len(self._poses)

    def pose(self, frame: int) -> np.ndarray | None:
        """Pose of a frame.

        Args:
            frame: position in :attr:`frames`; negative counts from the end.

        Returns:
            ``T_cw`` in the form of the keyframes' poses (not a copy where the frame is at its keyframe), or None while
            the frame or its keyframe has none.
        """
        record = self.frames[frame]
        if record.anchor is None:
            return None
        kept, relative = self._carrier(record.anchor)
        if kept not in self._poses:
            return None
        carrier = self._poses[kept] if relative is None else _compose(relative, self._poses[kept])
        return _compose(record.relative, carrier)

    def _carrier(self, keyframe: int) -> tuple[int, np.ndarray | None]:
        """Keyframe that carries another one, which may have been removed, and the pose relative to it."""
        relative: np.ndarray | None = None
        while keyframe in self._removed:
            keyframe, further = self._removed[keyframe]
            relative = further if relative is None else _compose(relative, further)
        return keyframe, relative

    def trajectory(
        self,
        segment: int | None = None,
        poses: Mapping[int, np.ndarray] | None = None,
        frames: Sequence[FrameRecord] | None = None,
    ) -> Trajectory:
        """Trajectory of every frame that has a pose and was not lost, camera to world.

        Args:
            segment: frames of this segment only; None for all.
            poses: ``T_cw`` by keyframe, in place of those of the log or in addition to them.
            frames: some of the log; None for all.

        Returns:
            The trajectory.
        """
        known = {**self._poses, **(poses or {})}
        chosen = self.frames if frames is None else frames
        placed = [r for r in chosen if not r.lost and r.anchor is not None and segment in (None, r.segment)]
        carriers = {r.anchor: self._carrier(r.anchor) for r in placed}  # type: ignore[arg-type]
        kept = [record for record in placed if carriers[record.anchor][0] in known]
        rows = np.zeros((0, 7))
        if kept:
            anchors = np.stack([known[carriers[record.anchor][0]] for record in kept])
            identity = _identity(anchors)
            removed = np.stack([_or(carriers[record.anchor][1], identity) for record in kept])
            relative = np.stack([_or(record.relative, identity) for record in kept])
            rows = _rows(_inverse(_compose(relative, _compose(removed, anchors))))
        return Trajectory(np.array([record.timestamp for record in kept], dtype=np.float64), rows)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """World points ``(M, 3)`` float32 and their colours ``(M, 3)`` uint8 RGB."""
        points = np.concatenate([np.zeros((0, 3), np.float32), *self._points])
        return points, np.concatenate([np.zeros((0, 3), np.uint8), *self._colors])


def _is_matrix(pose: np.ndarray) -> bool:
    return pose.shape[-1] == 4


def _identity(pose: np.ndarray) -> np.ndarray:
    """Identity in the form of ``pose``."""
    return np.eye(4) if _is_matrix(pose) else np.array([0.0, 0, 0, 0, 0, 0, 1])


def _or(relative: np.ndarray | None, identity: np.ndarray) -> np.ndarray:
    return identity if relative is None else relative


def _compose(a: np.ndarray | None, b: np.ndarray) -> np.ndarray:
    """``a b`` of two poses of one form; None stands for the identity."""
    if a is None:
        return b
    if _is_matrix(b):
        return a @ b
    se3, tensor = _se3()
    return se3.compose(tensor(a), tensor(b)).numpy()


def _inverse(pose: np.ndarray) -> np.ndarray:
    if _is_matrix(pose):
        return np.linalg.inv(pose)
    se3, tensor = _se3()
    return se3.inverse(tensor(pose)).numpy()


def _rows(poses: np.ndarray) -> np.ndarray:
    """``(N, 7)`` with unit quaternions."""
    if _is_matrix(poses):
        return poses_from_matrices(poses)
    se3, tensor = _se3()
    return se3.normalise(tensor(poses)).numpy()


def _se3() -> tuple[Any, Any]:
    """Group operations, imported when needed: a log of matrices does without torch and its memory."""
    import torch

    from dvo.geometry import se3

    return se3, torch.from_numpy
