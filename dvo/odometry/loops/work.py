"""Work in progress of loop closure, and the frame that takes its result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from dvo.odometry.loops.finder import Loop
from dvo.odometry.maintenance.adjuster import Adjusting
from dvo.odometry.maintenance.background import Steps, Task


@dataclass
class Searching:
    """Search in progress.

    Attributes:
        task: gives the loop, or None: in steps, some with each frame, or in a thread in real time.
    """

    task: Steps[Loop | None] | Task[Loop | None]


@dataclass
class Correcting:
    """Correction in progress, by the last loop.

    Attributes:
        task: gives the similarities ``(N, 8)``.
        left: frames until its result is taken.
        identifiers: ``(N,)`` of the keyframes.
    """

    task: Task[Tensor]
    left: int
    identifiers: np.ndarray


def is_due(work: Searching | Correcting | Adjusting, steps: int, real_time: bool) -> bool:
    """Find out if the result of a work is taken with this frame. A search in steps takes its next ones.

    Args:
        work: in progress; one frame less is left afterwards.
        steps: of a search, at most.
        real_time: results are taken as soon as they are there.
    """
    if isinstance(work, Searching):
        return any(work.task.step() for _ in range(steps)) if isinstance(work.task, Steps) else work.task.done
    work.left -= 1
    return work.task.done if real_time else work.left <= 0
