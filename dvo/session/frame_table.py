"""Table of the frames of a run (frames.csv): state of the tracker, time, keyframes, true positions."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from dvo.core.errors import DvoError
from dvo.data.files.files import MAX_NUMBER
from dvo.data.frame import Frame
from dvo.odometry.protocol import Estimate, Odometry, Result, Status
from dvo.session.observer import graph_of
from dvo.session.session import Run

SKIPPED = "skipped"  # status of a frame that the stride leaves out
STATUSES = (*(status.value for status in Status), SKIPPED)
_DIGITS = {"timestamp": 9, "confidence": 4, "seconds": 4, "true_x": 6, "true_y": 6, "true_z": 6}
_SIGMAS = {"position_sigma": 4, "rotation_sigma": 4}  # significant digits; tables of older versions have no sigmas
_MAX_ROWS = 10_000_000  # of a table to read


@dataclass(frozen=True)
class FrameRow:
    """Frame of a run.

    Attributes:
        timestamp: seconds.
        status: state of the tracker right after the frame: ``tracking``, ``initialising`` or ``lost``; ``skipped`` for
            a frame that the stride leaves out.
        segment: number of the segment that the final pose of the frame belongs to; None without a pose.
        keyframe: True for a keyframe that was kept; None if the odometry does not tell.
        confidence: of the estimate right after the frame, in [0, 1].
        seconds: time of tracking the frame; None if it was not tracked.
        reason: cause of the status ``lost``.
        true_x, true_y, true_z: true position of the camera in the world, metres; None without ground truth.
        position_sigma, rotation_sigma: standard deviations of the estimate right after the frame, relative to its
            reference, units of the segment and degrees (:class:`dvo.odometry.protocol.Estimate`); None without one.
    """

    timestamp: float
    status: str
    segment: int | None = None
    keyframe: bool | None = None
    confidence: float | None = None
    seconds: float | None = None
    reason: str = ""
    true_x: float | None = None
    true_y: float | None = None
    true_z: float | None = None
    position_sigma: float | None = None
    rotation_sigma: float | None = None

    @property
    def true_position(self) -> tuple[float, float, float] | None:
        """True position of the camera, metres; None without ground truth."""
        if self.true_x is None or self.true_y is None or self.true_z is None:
            return None
        return self.true_x, self.true_y, self.true_z

    def at(self, position: np.ndarray) -> FrameRow:
        """Row with another true position.

        Args:
            position: ``(3,)`` metres; nan for an unknown one.

        Returns:
            The row.
        """
        x, y, z = position.tolist() if np.isfinite(position).all() else (None, None, None)
        return replace(self, true_x=x, true_y=y, true_z=z)


class FrameTable:
    """Record of the estimates of a run, made while it goes on."""

    def __init__(self) -> None:
        self._rows: list[FrameRow] = []

    def update(self, frame: Frame, estimate: Estimate | None) -> None:
        """Record a frame; callback of :func:`dvo.session.session.run`.

        Args:
            frame: the frame.
            estimate: of the frame; None if it was skipped.
        """
        if estimate is None:
            self._rows.append(FrameRow(frame.timestamp, SKIPPED))
        else:
            row = FrameRow(frame.timestamp, estimate.status.value, None, None, float(estimate.confidence))
            row = replace(row, position_sigma=estimate.position_sigma, rotation_sigma=estimate.rotation_sigma)
            self._rows.append(replace(row, reason=estimate.reason))

    def rows(self, run: Run, keyframes: Collection[float] | None, truth: np.ndarray | None = None) -> list[FrameRow]:
        """Complete the rows with what is known at the end of a run.

        Args:
            run: record of the session.
            keyframes: timestamps of the kept keyframes, seconds; None if they are not known.
            truth: ``(N, 3)`` true positions of the frames, nan where there is none; None without ground truth.

        Returns:
            A row for every frame of the source, in order of time.
        """
        times = np.array([row.timestamp for row in self._rows])
        owner = owners(times, run.result)
        keys = None if keyframes is None else near(times, np.array(sorted(keyframes)))
        seconds = iter(run.frame_seconds)
        rows = []
        for k, row in enumerate(self._rows):
            if row.status == SKIPPED and k == len(self._rows) - 1:  # the session tracks the last frame after all
                row = replace(row, status=Status.TRACKING if owner[k] >= 0 else Status.LOST)
            row = replace(
                row,
                segment=int(owner[k]) if owner[k] >= 0 else None,
                keyframe=None if keys is None else bool(keys[k]),
                seconds=None if row.status == SKIPPED else next(seconds, None),
            )
            rows.append(row if truth is None else row.at(truth[k]))
        return rows

    @property
    def timestamps(self) -> np.ndarray:
        """``(N,)`` times of the frames so far, seconds."""
        return np.array([row.timestamp for row in self._rows])


def near(times: np.ndarray, wanted: np.ndarray, tolerance: float = 1e-6) -> np.ndarray:
    """Find times that also stand in another list.

    Args:
        times: ``(N,)`` seconds.
        wanted: ``(M,)`` seconds, increasing.
        tolerance: largest difference of equal times, seconds; files round them.

    Returns:
        ``(N,)`` bool.
    """
    if not len(wanted):
        return np.zeros(len(times), bool)
    above = np.searchsorted(wanted, times).clip(max=len(wanted) - 1)
    gap = np.minimum(np.abs(wanted[above] - times), np.abs(wanted[np.maximum(above - 1, 0)] - times))
    return gap <= tolerance


def owners(times: np.ndarray, result: Result) -> np.ndarray:
    """Segment of each frame.

    Args:
        times: ``(N,)`` of the frames, seconds.
        result: of the run.

    Returns:
        ``(N,)`` number of the segment with a pose for the frame; -1 for none.
    """
    owner = np.full(len(times), -1)
    for number, segment in enumerate(result.segments):
        owner[near(times, segment.trajectory.timestamps)] = number
    return owner


def keyframe_times(odometry: Odometry, result: Result) -> list[float] | None:
    """Times of the keyframes that were kept.

    Args:
        odometry: that has tracked the sequence.
        result: of the odometry.

    Returns:
        Seconds, increasing; None if the odometry does not tell.
    """
    graph = graph_of(odometry)
    if graph is not None:
        own = (frame for frame in graph.archive if frame.identifier >= graph.recording.keyframe)  # not of its map
        kept = [frame.timestamp for frame in own if frame.anchor is None]
        return sorted({*kept, *(frame.timestamp for frame in graph.window.frames)})
    return sorted(depth.timestamp for depth in result.depth) or None


def write_frames(path: Path, rows: Sequence[FrameRow]) -> None:
    """Write a table of frames: comma-separated values with a header; an empty cell for None.

    Args:
        path: file to write.
        rows: in order of time.
    """
    names = [field.name for field in fields(FrameRow)]
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([_cell(name, getattr(row, name)) for name in names] for row in rows)


def _cell(name: str, value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    if name in _SIGMAS:
        return f"{value:.{_SIGMAS[name]}g}"
    return f"{value:.{_DIGITS[name]}f}" if name in _DIGITS else str(value)


def read_frames(path: Path) -> list[FrameRow]:
    """Read a table of frames.

    Args:
        path: file that :func:`write_frames` has written.

    Returns:
        The rows.

    Raises:
        DvoError: no such file, another header, or a cell that is not of its kind.
    """
    names = [field.name for field in fields(FrameRow)]
    known = names, [name for name in names if name not in _SIGMAS]
    remedy = "remove it, or track again with dvo run"
    try:
        with open(path, encoding="utf-8", newline="") as file:
            reader = csv.reader(file)
            names = next(reader, [])
            if names not in known:
                raise DvoError("not a table of frames", file=path, field="header", remedy=remedy)
            rows = []
            for cells in reader:
                try:
                    rows.append(_row(dict(zip(names, cells, strict=True))))
                except ValueError as error:
                    raise DvoError(
                        str(error)[:120], file=path, field=f"line {reader.line_num}", remedy=remedy
                    ) from None
                if len(rows) > _MAX_ROWS:
                    raise DvoError(f"more than {_MAX_ROWS} rows", file=path, remedy=remedy)
    except OSError as error:
        raise DvoError(error.strerror or str(error), file=path, remedy=remedy) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DvoError(f"not a table of frames ({error})", file=path, remedy=remedy) from None
    return rows


def _row(cells: dict[str, str]) -> FrameRow:
    if cells["status"] not in STATUSES:
        raise ValueError(f"unknown status '{cells['status'][:40]}'")
    values: dict[str, Any] = {"status": cells["status"], "reason": cells["reason"]}
    values["segment"] = int(cells["segment"]) if cells["segment"] else None
    if values["segment"] is not None and not 0 <= values["segment"] <= _MAX_ROWS:
        raise ValueError("no number of a segment")
    values["keyframe"] = cells["keyframe"] == "1" if cells["keyframe"] else None
    for name in (*_DIGITS, *_SIGMAS):
        values[name] = float(cells[name]) if cells.get(name) else None
        if values[name] is not None and not math.isfinite(values[name]):
            raise ValueError(f"{name} is not finite")
        if values[name] is not None and abs(values[name]) > MAX_NUMBER:
            raise ValueError(f"{name} is beyond {MAX_NUMBER:g}")
    if values["timestamp"] is None:
        raise ValueError("no timestamp")
    return FrameRow(**values)
