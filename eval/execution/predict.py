"""First half of an evaluation: run a system on a sequence and store its trajectory, without the ground truth.

Each run has its own process (:func:`predict`), so that peak memory is its own, a hang meets the time limit, and a crash
of native code stays outside; its folder then holds ``trajectory.txt`` and ``prediction.json``. The trajectory holds the
rows of all segments in order, a TUM file like any other; the record, which is written last, says where it is cut. With
inertial samples the estimates as they came are kept too (:mod:`eval.execution.streamed`).
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.processes import bound, run_limited
from dvo.core.threads import process_environment
from dvo.data.files.output import write_text
from dvo.data.frame import Frame
from dvo.data.source import Source
from dvo.data.trajectory import Trajectory, read_tum, write_tum
from dvo.metrics.segment_metrics import worlds_of
from dvo.odometry.protocol import Estimate, Odometry, Segment
from dvo.session.results import jsonable, peak_memory_mb
from dvo.session.session import run
from eval.execution.streamed import StreamLog
from eval.scoring.blackout import dark_spans, is_dark, without_view
from eval.suites.suite import ROOT, open_sequence
from eval.suites.suite import Sequence as Recording
from eval.systems.registry import find_system

RECORD, TRAJECTORY, LOG = "prediction.json", "trajectory.txt", "log.txt"


@dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        system, weights, seed, device, threads: what runs, and how.
        sequence, data, stride: on what.
        folder: where the prediction is written.
        time_limit: seconds.
        parallel: runs at the same time on the machine; above 1, timings are those of a machine that is shared.
    """

    system: str
    sequence: Recording
    data: str
    folder: str
    seed: int = 0
    stride: int = 1
    weights: str | None = None
    device: str = "cpu"
    threads: int = 2
    time_limit: float = 1800.0
    parallel: int = 1


@dataclass
class Prediction:
    """Record of a run.

    Attributes:
        status: ``ok``, ``crashed``, ``timeout``, ``invalid`` (poses that are not finite), ``unavailable`` (the system),
            ``no data`` (the sequence).
        reason: message, where the status is not ok.
        version: of the system.
        stamps: times of the frames that were fed, seconds.
        tracked: rows of the trajectory, all segments together.
        resolution: size at which the system worked, else of the images: ``WIDTHxHEIGHT``.
        fps: frames fed per second inside ``track`` and ``finish``; reading is not counted.
        latency_p95_ms: 95th percentile of the time of one ``track``.
        peak_memory_mb: of the whole process.
        threads, device, parallel, time_limit: of the job, under which the resources were measured.
        dark: stretches of frames that show nothing, between lit ones: first and last stamp of each.
        unseen: stamps of the frames without a view, see :func:`eval.scoring.blackout.without_view`, seconds.
        segments: ``rows`` and ``joined_to`` of each segment; empty for a trajectory of one.
        breaks: :attr:`dvo.odometry.protocol.Result.breaks` of the system.
        info: :attr:`dvo.odometry.protocol.Result.info` of the system.
        verdict: of :attr:`dvo.odometry.protocol.Result.quality`, without a second run; empty from systems that judge
            nothing.
        doubt: its reason.
    """

    status: str
    reason: str = ""
    version: str = ""
    stamps: list[float] = field(default_factory=list)
    tracked: int = 0
    resolution: str = ""
    fps: float | None = None
    latency_p95_ms: float | None = None
    peak_memory_mb: float | None = None
    threads: int = 0
    device: str = ""
    parallel: int = 1
    time_limit: float | None = None
    dark: list[list[float]] = field(default_factory=list)
    unseen: list[float] = field(default_factory=list)
    segments: list[dict[str, Any]] = field(default_factory=list)
    breaks: list[dict[str, Any]] = field(default_factory=list)
    info: dict[str, Any] = field(default_factory=dict)
    verdict: str = ""
    doubt: str = ""


def predict(job: Job) -> Prediction:
    """Run a job in a process of its own and wait for it. Never raises on a run that fails.

    Args:
        job: its folder is emptied first.

    Returns:
        The record; ``unavailable``, ``timeout`` or ``crashed`` where the system did not come to an end.
    """
    folder = Path(job.folder)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    system = find_system(job.system, job.weights)
    reason = system.missing()
    if reason is not None:
        return write_prediction(job, Prediction("unavailable", reason))
    (folder / "job.json").write_text(json.dumps(asdict(job), indent=1), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "eval.execution.worker", str(folder / "job.json")]
    ending = run_limited(bound(command), process_environment(job.threads, environment), job.time_limit, folder / LOG)
    if ending.code is None:
        late = Prediction("timeout", f"not done after {job.time_limit:g} s", system.version())
        return write_prediction(job, late)
    if not (folder / RECORD).is_file():
        return write_prediction(job, Prediction("crashed", str(ending), system.version()))
    return read_prediction(folder)


def predict_here(job: Job) -> Prediction:
    """Run a job in this process: what the worker does.

    Args:
        job: its folder exists.

    Returns:
        The record, which is written too.
    """
    folder = Path(job.folder)
    system = find_system(job.system, job.weights)
    version = ""
    try:
        source, _ = open_sequence(job.sequence, Path(job.data), job.stride)
    except DvoError as error:
        return write_prediction(job, Prediction("no data", str(error)))
    try:
        version = system.version()
        log = StreamLog()
        prediction, segments = drive(system.build(job.seed, job.device), source, log)
    except Exception as error:  # an error of a system is its result, and becomes a row
        return write_prediction(job, Prediction("crashed", f"{type(error).__name__}: {error}", version))
    prediction.version = version
    if prediction.status == "ok":
        write_segments(folder, segments)
        if job.sequence.inertial is not None:
            log.streamed().write(folder)
    return write_prediction(job, prediction)


def drive(odometry: Odometry, source: Source, log: StreamLog | None = None) -> tuple[Prediction, tuple[Segment, ...]]:
    """Feed every frame of a source to an odometry, with a clock.

    Args:
        odometry: a fresh one; whatever it raises is passed on.
        source: of the sequence.
        log: is given every estimate as it comes; None for none.

    Returns:
        The record, and the segments of the trajectory, camera to world.
    """
    stamps: list[float] = []
    dark: list[bool] = []
    unseen: list[float] = []
    resolution = ""

    def look(frame: Frame, estimate: Estimate | None) -> None:
        nonlocal resolution
        if log is not None and estimate is not None:
            log.take(estimate)
        stamps.append(frame.timestamp)
        dark.append(is_dark(frame.image))
        if without_view(frame.image):
            unseen.append(frame.timestamp)
        resolution = f"{frame.camera.width}x{frame.camera.height}"

    done = run(odometry, source, on_frame=look, strict=True)
    result, seconds = done.result, done.frame_seconds
    predicted = set(result.inertial)  # poses that do not claim to come from images
    segments = without_empty(result.segments)
    total = done.seconds["tracking"] + done.seconds["finishing"]
    worked = result.info.get("working_size")
    prediction = Prediction(
        status="ok",
        stamps=stamps,
        tracked=result.frames_tracked,
        resolution=f"{worked[0]}x{worked[1]}" if worked else resolution,
        fps=len(stamps) / max(total, 1e-9),
        latency_p95_ms=1000 * float(np.percentile(seconds, 95)) if seconds else None,
        peak_memory_mb=process_peak_mb(),
        dark=[list(span) for span in dark_spans(np.array(stamps), np.array(dark, dtype=bool))],
        unseen=[time for time in unseen if time not in predicted],
        segments=[{"rows": len(segment), "joined_to": segment.joined_to} for segment in segments],
        breaks=[asdict(gap) for gap in result.breaks],
        info=result.info,
        verdict="" if result.quality is None else result.quality.verdict,
        doubt="" if result.quality is None else result.quality.reason,
    )
    broken = sum(int((~np.isfinite(segment.trajectory.poses_wc)).any(axis=1).sum()) for segment in segments)
    rows = _all_rows(segments).timestamps
    twice = len(rows) - len(np.unique(rows))
    if broken:
        prediction.status, prediction.reason = "invalid", f"{broken} poses are not finite"
    elif twice:
        prediction.status, prediction.reason = "invalid", f"{twice} frames have more than one pose"
    elif (np.diff(rows) < 0).any():
        prediction.status, prediction.reason = "invalid", "its segments are not in order of time"
    return prediction, segments


def read_prediction(folder: Path | str) -> Prediction:
    """Read a record.

    Args:
        folder: of a run.

    Raises:
        DvoError: there is none.
    """
    path = Path(folder) / RECORD
    if not path.is_file():
        raise DvoError("no such prediction", file=path, remedy="run the evaluation first")
    return Prediction(**json.loads(path.read_text(encoding="utf-8")))


def without_empty(segments: Sequence[Segment]) -> tuple[Segment, ...]:
    """Segments that have rows; those that share a world are joined to the first of it.

    Args:
        segments: of a result.
    """
    kept = [number for number, segment in enumerate(segments) if len(segment)]
    if len(kept) == len(segments):
        return tuple(segments)
    first = {
        number: min(n for n in world if n in kept)
        for world in worlds_of(segments)
        for number in world
        if number in kept
    }
    joined = {number: None if first[number] == number else kept.index(first[number]) for number in kept}
    return tuple(replace(segments[number], joined_to=joined[number]) for number in kept)


def write_segments(folder: Path | str, segments: Sequence[Segment]) -> None:
    """Write the rows of all segments in order; :attr:`Prediction.segments` says where they are cut.

    Args:
        folder: of a run.
        segments: of its trajectory.
    """
    write_tum(Path(folder) / TRAJECTORY, _all_rows(segments))


def read_segments(folder: Path | str) -> tuple[Segment, ...]:
    """Segments of the trajectory of a run; none where it left no rows. A record of one segment need not name it.

    Args:
        folder: of a run.

    Raises:
        DvoError: the record and the trajectory do not agree, or name a segment that is not there.
    """
    path = Path(folder) / TRAJECTORY
    if not path.is_file() or path.read_text(encoding="utf-8").count("\n") < 2:
        return ()
    rows = read_tum(path)
    record = Path(folder) / RECORD
    parts = read_prediction(folder).segments if record.is_file() else []
    parts = parts or [{"rows": len(rows), "joined_to": None}]
    ends = np.cumsum([part["rows"] for part in parts])
    if ends[-1] != len(rows):
        raise DvoError(
            f"{len(rows)} rows, but the record has {ends[-1]}", file=path, remedy="remove the folder and run it again"
        )
    starts = [0, *ends[:-1]]
    return tuple(
        Segment(
            Trajectory(rows.timestamps[first:end], rows.poses_wc[first:end]),
            float(rows.timestamps[first]),
            float(rows.timestamps[end - 1]),
            part["joined_to"],
        )
        for first, end, part in zip(starts, ends, parts, strict=True)
    )


def process_peak_mb() -> float | None:
    """Largest resident memory of this program in MB.

    ``ru_maxrss`` survives exec on Linux, so a child would report its parent's peak; VmHWM does not.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) * 1024 / 1e6, 1)
    return peak_memory_mb()


def write_prediction(job: Job, prediction: Prediction) -> Prediction:
    """Write a record into the job's folder, whole or not at all.

    Args:
        job: its folder and circumstances.
        prediction: record; the circumstances are filled in.

    Returns:
        The record.
    """
    prediction.threads, prediction.device = job.threads, job.device
    prediction.parallel, prediction.time_limit = job.parallel, job.time_limit
    write_text(Path(job.folder) / RECORD, json.dumps(jsonable(prediction), indent=1, allow_nan=False) + "\n")
    return prediction


def _all_rows(segments: Sequence[Segment]) -> Trajectory:
    return Trajectory(
        np.concatenate([np.zeros(0), *(segment.trajectory.timestamps for segment in segments)]),
        np.concatenate([np.zeros((0, 7)), *(segment.trajectory.poses_wc for segment in segments)]),
    )
