"""One run for :mod:`eval.benchmarks.speed`: ``python -m eval.benchmarks.timed_run JOB.json RESULT.json``.

The images are read and decoded first. A part of them is tracked by an odometry that is thrown away, so that no time
contains the loading of kernels; then all are tracked with a clock, and once more with a counter if that is asked for.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from dvo.core.allocator import reuse_freed_memory
from dvo.core.threads import settle_threads
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.metrics.segment_metrics import evaluate_segments
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.odometry.protocol import Odometry, Result
from eval.execution.predict import process_peak_mb, without_empty
from eval.suites.selection import sequence_from
from eval.suites.suite import Sequence as Recording
from eval.suites.suite import open_sequence, reference_for
from eval.systems.registry import find_system

WARMUP = 30
"""Frames that are tracked before the clock starts, by the package's own odometries."""
KINDS = ("keyframe", "dropped", "aligned")
"""Frames that the network has measured and that stay as keyframes, or do not; and those that it has not measured."""


@dataclass(frozen=True)
class Job:
    """What is run, on one thread.

    Attributes:
        system: as :func:`eval.systems.registry.find_system` takes it.
        sequence, data: on what; see :func:`eval.suites.suite.open_sequence`.
        frames: number of images; None for all.
        count: count the calls of ``track`` too, in a run of its own.
    """

    system: str
    sequence: Recording
    data: str
    frames: int | None = None
    count: bool = False


@dataclass(frozen=True)
class Timed:
    """Outcome of a run.

    Attributes:
        track_ms: time of each call of ``track``, without the time that a peer waits for the camera.
        processor_ms: processor time of the process, all its threads, by ``track``, for a frame.
        finish_ms: time of ``finish``, for a frame.
        peak_mb: largest memory of the process, less the images.
        ate_m, ate_percent: after alignment in Sim(3), each world on its own; nan where nothing was tracked.
        tracked: share of the frames with a pose.
        calls: mean number of aten calls of ``track`` by kind of frame (:data:`KINDS`, ``all`` and ``computing``);
            empty if they were not counted, or the system has no network.
    """

    track_ms: list[float]
    processor_ms: float
    finish_ms: float
    peak_mb: float
    ate_m: float
    ate_percent: float
    tracked: float
    calls: dict[str, float] = field(default_factory=dict)


class CallCounter(TorchDispatchMode):
    """Context that counts calls of aten operators by this thread.

    Attributes:
        calls: number so far.
        computing: those of them that fill memory: no views, and no conversions that give what they were given.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls = self.computing = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        if func.namespace == "aten":
            self.calls += 1
            given = {x.untyped_storage().data_ptr() for x in args if isinstance(x, torch.Tensor)}
            outputs = [
                x for x in (found if isinstance(found, tuple | list) else (found,)) if isinstance(x, torch.Tensor)
            ]
            fills = any(x.untyped_storage().data_ptr() not in given for x in outputs) or not outputs
            self.computing += func._schema.is_mutable or fills
        return found


def timed(odometry: Odometry, frames: Sequence[Frame]) -> tuple[Result, list[float], float, float]:
    """Track frames with a clock.

    Args:
        odometry: a fresh one.
        frames: decoded.

    Returns:
        The result; seconds of each call of ``track``; processor seconds of them together; seconds of ``finish``.
    """
    seconds = []
    processor = time.process_time()
    for frame in frames:
        waited, start = waited_by(odometry), time.perf_counter()
        odometry.track(frame)
        seconds.append(time.perf_counter() - start - (waited_by(odometry) - waited))
    processor, start = time.process_time() - processor, time.perf_counter()
    result = odometry.finish()
    return result, seconds, processor, time.perf_counter() - start


def waited_by(odometry: Odometry) -> float:
    """Seconds that an odometry has slept inside ``track`` so far, to be fed no faster than the camera delivers."""
    return float(getattr(odometry, "waited", 0.0))


def counted(odometry: Odometry, frames: Sequence[Frame]) -> dict[str, float]:
    """Mean number of aten calls of ``track`` by kind of frame.

    Args:
        odometry: a fresh one.
        frames: one or more.

    Returns:
        Of all frames, and of each of :data:`KINDS` that occurs; of all frames those that compute
        (:class:`CallCounter`). Frames that are lost or before the initialisation count among all.
    """
    calls, computing, aligned = [], [], []
    for frame in frames:
        before = aligned_in_a_row(odometry)
        with CallCounter() as counter:
            odometry.track(frame)
        calls.append(counter.calls)
        computing.append(counter.computing)
        aligned.append(aligned_in_a_row(odometry) > before)
    odometry.finish()
    kinds = kinds_of(odometry, aligned) if isinstance(odometry, PatchOdometry) else [""] * len(calls)
    rows = {kind: [number for number, own in zip(calls, kinds, strict=True) if own == kind] for kind in KINDS}
    rows |= {"all": calls, "computing": computing}
    return {kind: float(np.mean(numbers)) for kind, numbers in rows.items() if numbers}


def aligned_in_a_row(odometry: Odometry) -> int:
    """Frames that were aligned since the network has measured one; 0 for a system that aligns none."""
    return odometry.aligner.age if isinstance(odometry, PatchOdometry) and odometry.aligner is not None else 0


def kinds_of(odometry: PatchOdometry, aligned: Sequence[bool]) -> list[str]:
    """Kind of each frame, of :data:`KINDS`; empty for one without a keyframe of its own.

    Args:
        odometry: that is finished.
        aligned: whether each frame was aligned.
    """
    graph, taken, kinds = odometry.graph, set(), []
    for record, was_aligned in zip(graph.log.frames, aligned, strict=True):
        if record.lost or record.anchor is None or record.anchor in taken:  # lost, or the image of the frame before it
            kinds.append("")
            continue
        taken.add(record.anchor)
        kept = graph.archive[record.anchor].anchor is None
        kinds.append("aligned" if was_aligned else "keyframe" if kept else "dropped")
    return kinds


def measure(job: Job) -> Timed:
    """Run a job in this process.

    Args:
        job: what is run.

    Raises:
        DvoError: no such system, no data, or no frames.
    """
    settle_threads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    reuse_freed_memory()
    source, groundtruth = open_sequence(job.sequence, Path(job.data), 1)
    frames, system = list(islice(source, job.frames)), find_system(job.system)
    if system.target.split(":")[0].split(".")[0] == "dvo":
        timed(system.build(0, "cpu"), frames[:WARMUP])
    result, seconds, processor, finish = timed(system.build(0, "cpu"), frames)
    peak = (process_peak_mb() or float("nan")) - sum(frame.image.nbytes for frame in frames) / 1e6
    calls: dict[str, float] = {}
    if job.count and hasattr(odometry := system.build(0, "cpu"), "model"):
        calls = counted(odometry, frames)
    error = errors_of(result, groundtruth, frames)
    return Timed(
        track_ms=[1e3 * value for value in seconds],
        processor_ms=1e3 * processor / len(frames),
        finish_ms=1e3 * finish / len(frames),
        peak_mb=peak,
        ate_m=error.ate_rmse,
        ate_percent=error.ate_percent,
        tracked=result.frames_tracked / len(frames),
        calls=calls,
    )


def errors_of(result: Result, groundtruth: Trajectory, frames: Sequence[Frame]) -> Any:
    """Errors against the ground truth of the frames, each world aligned in Sim(3)."""
    reference = reference_for(groundtruth, np.array([frame.timestamp for frame in frames]))
    return evaluate_segments(without_empty(result.segments), reference).metrics


def main(job: str, result: str) -> None:
    """Do the job in one file, and write the outcome to another.

    Args:
        job: JSON form of a :class:`Job`.
        result: file for that of a :class:`Timed`.
    """
    entry = json.loads(Path(job).read_text(encoding="utf-8"))
    found = measure(Job(**{**entry, "sequence": sequence_from(entry["sequence"])}))
    Path(result).write_text(json.dumps(asdict(found)), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
