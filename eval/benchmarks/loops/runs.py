"""One run of the benchmark of loops: a system on a sequence, with its loops judged and its memory watched."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from multiprocessing.synchronize import Semaphore
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.threads import settle_threads
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.metrics import associate, evaluate
from dvo.metrics.segment_metrics import worlds_of
from dvo.odometry.protocol import Estimate, Odometry, Result, Segment
from eval.benchmarks.interruptions.trials import image_without_view
from eval.execution.predict import drive
from eval.scoring.score import score
from eval.suites.suite import Sequence as Recording
from eval.suites.suite import Suite, open_sequence
from eval.systems.registry import find_system

DARK = 2.0
"""Seconds without a view, in the middle of a sequence."""
WARM = 0.25
"""Share of the frames after which the growth of memory is watched."""
SPANS = 12
"""Spans of equal length that a run is divided in to find the growth of memory."""
BLACK = 1
"""Variant of the dark images: black with noise, see :func:`image_without_view`."""


@dataclass(frozen=True)
class Task:
    """Sequence, system and settings of a run.

    Attributes:
        mode: ``revisit`` or ``blackout``.
        system: name as for ``python -m eval run --systems``, without the setting ``loops``.
        sequence: rendered.
        loops: setting of the system.
        dark: take the view away for :data:`DARK` seconds.
        seed, device: of the system.
        frames: most frames that are fed; None for all.
    """

    mode: str
    system: str
    sequence: Recording
    loops: bool = True
    dark: bool = False
    seed: int = 0
    device: str = "cpu"
    frames: int | None = None

    @property
    def key(self) -> list[Any]:
        """Values that identify the run in a file of results."""
        options = dict(self.sequence.rendered or ())
        return [self.mode, self.system, self.sequence.name, options.get("version"), options.get("seed"), self.loops,
                self.dark, self.seed, self.device, self.frames]  # fmt: skip


@dataclass(frozen=True)
class Run:
    """Outcome of a task; nan where a value has no meaning.

    Attributes:
        key: of the task.
        mode, system, sequence, loops, dark, seed: of the task.
        status: as in results.csv: ``ok``, ``lost``, ``failed``, ...
        frames, keyframes: numbers; keyframes as the system counts them.
        ate_percent: as in results.csv, every world aligned on its own.
        joined: the world that has most of the frames before the middle has at least half of those after it, the dark
            ones left out.
        joined_ate: root mean square error of that world, in metres, over the frames outside of the middle.
        found, false, revisit_s, recall: loops, see :class:`eval.scoring.loops.LoopErrors`.
        p95_ms, fps: time of ``track``, frames in a second.
        archive_kb: kilobytes of the archive at the end, a kept keyframe.
        resident_kb: growth of the resident memory of the process for each keyframe, kilobytes, see
            :meth:`Watched.growth_kb`.
    """

    key: list[Any] = field(default_factory=list)
    mode: str = ""
    system: str = ""
    sequence: str = ""
    loops: bool = True
    dark: bool = False
    seed: int = 0
    status: str = ""
    frames: int = 0
    keyframes: int = 0
    ate_percent: float = math.nan
    joined: bool = False
    joined_ate: float = math.nan
    found: float = math.nan
    false: float = math.nan
    revisit_s: float = math.nan
    recall: float = math.nan
    p95_ms: float = math.nan
    fps: float = math.nan
    archive_kb: float = math.nan
    resident_kb: float = math.nan


class Turns:
    """Alternation of two runs in two processes: one frame of each, so that the machine is the same for both.

    Args:
        own: semaphore that lets this run go on.
        other: that of the other run.
    """

    LIMIT = 600.0  # seconds after which the other run is given up

    def __init__(self, own: Semaphore, other: Semaphore) -> None:
        self.own, self.other = own, other

    def take(self) -> None:
        """Wait for the turn of this run."""
        self.own.acquire(timeout=self.LIMIT)

    def give(self) -> None:
        """Let the other run go on."""
        self.other.release()


class Watched:
    """Odometry whose resident memory is read after every frame.

    Args:
        inner: the odometry.
        turns: given to the other run after every frame; None for a run by itself.

    Attributes:
        resident: bytes after every frame.
        keyframes: keyframes that were kept by then; none of an odometry without a graph.
        archive_kb: see :class:`Run`.
    """

    def __init__(self, inner: Odometry, turns: Turns | None = None) -> None:
        self.inner, self.name, self.turns = inner, inner.name, turns
        self.resident: list[int] = []
        self.keyframes: list[int] = []
        self.archive_kb = math.nan

    def track(self, frame: Frame) -> Estimate:
        """Track a frame."""
        estimate = self.inner.track(frame)
        self.resident.append(resident_bytes())
        log = getattr(getattr(self.inner, "graph", None), "log", None)
        if log is not None:
            self.keyframes.append(log.keyframes)
        if self.turns is not None:
            self.turns.give()
        return estimate

    def finish(self) -> Result:
        """Finish; the archive is measured before the final adjustment."""
        archive = getattr(getattr(self.inner, "graph", None), "archive", None)
        if archive is not None:
            kept = sum(keyframe.anchor is None for keyframe in archive)
            self.archive_kb = archive.nbytes / 1000 / kept if kept else math.nan
        return self.inner.finish()

    def growth_kb(self, keyframes: int) -> float:
        """Growth of the resident memory of the process for each keyframe.

        Memory that is in use for a while (by a search for loops, for instance) comes and goes: of each of the
        :data:`SPANS` spans of the run the frame after which it was least counts. The growth is the slope of the
        straight line through these, without those of the first quarter, when caches fill.

        Args:
            keyframes: of the whole run, spread evenly over it if the odometry does not tell when they were kept.

        Returns:
            Kilobytes; nan for a run without enough frames or keyframes.
        """
        if len(self.resident) < SPANS:
            return math.nan
        resident = np.array(self.resident) / 1000
        kept = np.array(self.keyframes, float) if self.keyframes else np.linspace(0, keyframes, len(resident))
        spans = np.array_split(np.arange(len(resident)), SPANS)[int(WARM * SPANS) :]
        least = [int(span[resident[span].argmin()]) for span in spans]
        return float(np.polyfit(kept[least], resident[least], 1)[0]) if np.ptp(kept[least]) >= 1 else math.nan


class Fed:
    """Frames of a source, the first ones only, dark for a while.

    Args:
        source: frames in order of time.
        count: largest number of frames; None for all.
        dark: begin and end of the dark, seconds; None for none.
        seed: of the noise in the dark.
        turns: taken before a frame is read; None for a run by itself.
    """

    def __init__(
        self,
        source: Iterable[Frame],
        count: int | None,
        dark: tuple[float, float] | None,
        seed: int,
        turns: Turns | None = None,
    ) -> None:
        self.source, self.count, self.dark, self.seed, self.turns = source, count, dark, seed, turns

    def __iter__(self) -> Iterator[Frame]:
        rng, frames = np.random.default_rng([self.seed, 7704]), islice(self.source, self.count)
        while True:
            if self.turns is not None:
                self.turns.take()
            frame = next(frames, None)
            if frame is None:
                if self.turns is not None:
                    self.turns.give()
                return
            if self.dark is None or not self.dark[0] < frame.timestamp < self.dark[1]:
                yield frame
            else:
                yield replace(frame, image=image_without_view("black", BLACK, frame.image.shape, rng))


def carry_out(task: Task, turns: Turns | None = None) -> Run:
    """Run a task in this process.

    Args:
        task: to run.
        turns: with another run; None for a run by itself.

    Raises:
        DvoError: a system that is not there or has no setting ``loops``, or a sequence that cannot be rendered.
    """
    settle_threads()
    suite = Suite("loops", "benchmark of loops", (task.sequence,))
    source, truth = open_sequence(task.sequence, Path(), 1)
    fed = truth.timestamps[: task.frames]
    middle = float(fed[0] + fed[-1]) / 2
    span = middle - DARK / 2, middle + DARK / 2
    system = find_system(f"{task.system}+loops={str(task.loops).lower()}")
    reason = system.missing()
    if reason:
        raise DvoError(reason, field="--systems", remedy="choose a system that is there")
    watched = Watched(system.build(task.seed, task.device), turns)
    frames = Fed(source, task.frames, span if task.dark else None, task.seed, turns)
    prediction, segments = drive(watched, frames)  # type: ignore[arg-type]  # it is only iterated
    row = score(prediction, segments, truth, system=task.system, suite=suite, sequence=task.sequence, seed=task.seed)
    lit = fed[(fed <= span[0]) | (fed >= span[1])]
    joined, error = joined_world(segments, truth, lit, middle)
    keyframes = int(prediction.info.get("keyframes", 0))
    return Run(
        key=task.key, mode=task.mode, system=task.system, sequence=task.sequence.name, loops=task.loops, dark=task.dark,
        seed=task.seed, status=row.status, frames=row.frames, keyframes=keyframes, ate_percent=row.ate_percent,
        joined=joined, joined_ate=error, found=row.loops, false=row.false_loops, revisit_s=row.revisit_s,
        recall=row.loop_recall, p95_ms=row.latency_p95_ms, fps=row.fps, archive_kb=watched.archive_kb,
        resident_kb=watched.growth_kb(keyframes),
    )  # fmt: skip


def joined_world(
    segments: tuple[Segment, ...], truth: Trajectory, stamps: np.ndarray, middle: float
) -> tuple[bool, float]:
    """Find out if a run goes on in the same world after the middle, and the error of that world.

    Args:
        segments: of the run.
        truth: camera to world, metres.
        stamps: of the frames that count, seconds.
        middle: time between before and after, seconds.

    Returns:
        Whether the world of most of the frames before has half of those after it or more; its error in metres, see
        :class:`Run`.
    """
    worlds = []
    for numbers in worlds_of(segments):
        parts = [segments[number].trajectory for number in numbers]
        times = np.concatenate([part.timestamps for part in parts])
        keep = np.isclose(times[:, None], stamps[None], atol=1e-6).any(1)
        worlds.append(Trajectory(times[keep], np.concatenate([part.poses_wc for part in parts])[keep]))
    if not worlds:
        return False, math.nan
    main = max(worlds, key=lambda world: int((world.timestamps < middle).sum()))
    after = int((main.timestamps > middle).sum())
    rows = associate(main, truth)[0]
    error = evaluate(main, truth).ate_rmse if len(rows) >= 3 else math.nan
    return bool(after >= 0.5 * (stamps > middle).sum()), error


def resident_bytes() -> int:
    """Resident memory of this process without pages of files, which the system drops at will; 0 if it is not told."""
    status = Path("/proc/self/statm")
    if not status.is_file():
        return 0
    _, resident, of_files = (int(pages) for pages in status.read_text().split()[:3])
    return (resident - of_files) * os.sysconf("SC_PAGE_SIZE")
