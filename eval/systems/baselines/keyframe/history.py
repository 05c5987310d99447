"""What became of every frame, and the result made of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from dvo.geometry.poses import poses_from_matrices
from dvo.odometry.protocol import Estimate, Result, SparseMap, Status
from eval.systems.baselines.back_fill import result_of
from eval.systems.baselines.keyframe.map import Keyframe


class History:
    """Frames in order. A pose hangs on a keyframe, so that whatever moves the keyframe moves the frame.

    Attributes:
        times: seconds.
        turns: ``(3, 3)`` rotation from the frame before; None where it is not known.
        lost: frames that get no pose.
    """

    def __init__(self) -> None:
        self.times: list[float] = []
        self.turns: list[np.ndarray | None] = []
        self.lost: set[int] = set()
        self._hung: list[tuple[Keyframe, np.ndarray] | None] = []

    def begin(self, time: float) -> int:
        """A new frame; its position."""
        self.times.append(time)
        self.turns.append(None)
        self._hung.append(None)
        return len(self.times) - 1

    def hang(self, index: int, keyframe: Keyframe, T_cw: np.ndarray) -> None:
        """Give a frame its pose ``(4, 4)``, as seen from a keyframe."""
        self._hung[index] = keyframe, T_cw @ np.linalg.inv(keyframe.T_cw)

    def rehang(self, gone: Keyframe, other: Keyframe) -> None:
        """Move all frames of a keyframe to another, where they are."""
        for index, hung in enumerate(self._hung):
            if hung is not None and hung[0] is gone:
                self.hang(index, other, hung[1] @ gone.T_cw)

    def poses(self) -> list[np.ndarray | None]:
        """``(4, 4)`` world to camera of every frame, None where there is none."""
        return [None if hung is None else hung[1] @ hung[0].T_cw for hung in self._hung]

    def estimate(self, status: Status, confidence: float = 0.0) -> Estimate:
        """What is known of the newest frame."""
        hung = self._hung[-1]
        pose = None if hung is None else poses_from_matrices(np.linalg.inv(hung[1] @ hung[0].T_cw))
        return Estimate(self.times[-1], pose, status, confidence)

    def result(self, points: SparseMap, info: dict[str, Any]) -> Result:
        """Everything, with the frames before each start filled in."""
        return result_of(self.times, self.poses(), self.turns, self.lost, points, info)
