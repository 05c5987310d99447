"""Runs of systems over videos without ground truth."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import dvo
from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration
from dvo.data.frame import Frame
from dvo.data.source import Source
from dvo.data.trajectory import Trajectory
from dvo.odometry.protocol import Estimate, Odometry
from dvo.session import session
from eval.systems.registry import find_system

PIXELS = 640 * 480
"""Largest images that a clip is held in, which is played backward too."""


@dataclass(frozen=True)
class Video:
    """Clip to track.

    Attributes:
        name: in tables.
        file: video or folder.
        calib: its calibration, or the file of it; None: the focal length is found in the images.
        frames: number of its first frames that are tracked; None for all.
    """

    name: str
    file: Path
    calib: Path | Calibration | None = None
    frames: int | None = None

    def open(self) -> Source:
        """Frames, reduced to :data:`PIXELS`."""
        end = None if self.frames is None else f"{self.frames}f"
        return dvo.open(self.file, calib=self.calib, guess=self.calib is None, end=end, max_pixels=PIXELS)


@dataclass(frozen=True)
class Task:
    """Run to make.

    Attributes:
        video: clip.
        system: name, see :mod:`eval.systems.registry`.
        seed: of the system.
        backward: from the last frame to the first.
    """

    video: Video
    system: str
    seed: int = 0
    backward: bool = False

    @property
    def key(self) -> str:
        """Name of the run, and of its trajectory file without the extension."""
        return f"{self.video.name}-{self.system}-{self.seed}" + "-backward" * self.backward


@dataclass(frozen=True)
class Run:
    """Outcome of a task.

    Attributes:
        key: of the task.
        video: file, calibration and number of frames that were asked for.
        frames: number of frames that were tracked.
        first: number of the first frame with a measured pose; None if there is none.
        segments: number of segments.
        seconds: processor time of tracking and finishing, and of finding the focal length.
        verdict: of the result, see :mod:`dvo.odometry.quality`; of systems that do not judge themselves ``failed``
            without a pose, else ``-``.
        reason: of the verdict.
        error: what ended the run; empty if nothing did.
        poses: ``(N, 8)`` time and ``T_wc`` of the trajectory; not in JSON.
    """

    key: str
    video: str = ""
    frames: int = 0
    first: int | None = None
    segments: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    verdict: str = "-"
    reason: str = ""
    error: str = ""
    poses: np.ndarray = field(default_factory=lambda: np.zeros((0, 8)))

    @property
    def trajectory(self) -> Trajectory:
        """Poses ``T_wc``."""
        return Trajectory(self.poses[:, 0], self.poses[:, 1:])


def reversed_frames(frames: list[Frame]) -> Iterator[Frame]:
    """Frames from the last to the first, in times that increase."""
    length = frames[0].timestamp + frames[-1].timestamp
    for number, frame in enumerate(reversed(frames)):
        yield replace(frame, index=number, timestamp=length - frame.timestamp, inertial=None)


def carry_out(task: Task) -> Run:
    """Carry out a task.

    Args:
        task: run to make.

    Returns:
        The run; one that fails says why.
    """
    first: list[int] = []
    numbers = itertools.count()

    def on_frame(_: Frame, estimate: Estimate | None) -> None:
        number = next(numbers)
        if not first and estimate is not None and estimate.pose_wc is not None:
            first.append(number)

    def build(number: int) -> Odometry:
        return find_system(task.system).build(task.seed + number, "cpu")

    try:
        source = task.video.open()
        seconds: dict[str, float] = {}
        if task.video.calib is None:
            begun = time.process_time()
            found = dvo.calibrate(source, seed=task.seed)
            source = source.recalibrated(found.calibration, found.kept)
            seconds["calibrating"] = time.process_time() - begun
        frames: Any = source
        if task.backward:
            frames = reversed_frames(list(source))
        begun = time.process_time()
        done = session.run(build(0), frames, on_frame=on_frame, again=build)
        seconds["tracking"] = time.process_time() - begun
    except DvoError as error:
        return Run(task.key, str(task.video), verdict="failed", error=str(error))
    rows, quality = done.result.trajectory, done.result.quality
    verdict = quality.verdict if quality is not None else "-" if len(rows) else "failed"
    return Run(
        task.key, str(task.video), done.result.frames_read, first[0] if first else None, len(done.result.segments),
        seconds, verdict, "" if quality is None else quality.reason,
        poses=np.column_stack([rows.timestamps, rows.poses_wc]),
    )  # fmt: skip
